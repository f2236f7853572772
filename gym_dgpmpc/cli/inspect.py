"""`dgpmpc inspect PATH`."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from gym_dgpmpc.cli.common import agent_file, one_line_errors

MOST_SHOWN = 4
"""Bounds of a space that are shown one by one."""


def inspect(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Folder written by `dgpmpc train`, or an agent's file.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for programs.")] = False,
) -> None:
    """Show what an agent's file holds: task, settings, data, training, versions. The environment is not needed."""
    with one_line_errors(ValueError, OSError):
        from gym_dgpmpc.runs import inspection

        agent_file(path)  # an error that says what is expected
        content = inspection.inspect(path)
    if as_json:
        typer.echo(json.dumps(content, indent=2, allow_nan=False))
        return
    for line in _lines(content):
        typer.echo(line)


def _lines(content: Mapping[str, Any]) -> Iterator[str]:
    """What a person reads, a section after another."""
    spaces, data, training, settings = (content[name] for name in ("spaces", "data", "training", "settings"))
    yield f"{content['file']}: {content['bytes'] / 1e6:.2f} MB, schema {content['schema']}"
    side_by_side = f" x {content['num_envs']}" if content["num_envs"] > 1 else ""
    yield f"{content['class']} for {content['environment'] or 'an environment without an id'}{side_by_side}"
    yield from _section("Task")
    yield from _pairs(
        {
            "observation": _space(spaces["observation"]),
            "action": _space(spaces["action"]),
            "reward": content["reward"],
            "termination": content["termination"],
        }
    )
    yield from _section("Data and training")
    lengths = sorted({data["shortest_episode"], data["longest_episode"]})
    seen = f"the last training saw {training['num_learned']} of them" if training["num_learned"] else "no training yet"
    running = training["steps_of_running_episode"]
    yield from _pairs(
        {
            "transitions": f"{data['num_transitions']}; {seen}",
            "episodes": f"{data['num_episodes']} of {' to '.join(map(str, lengths))} steps, {data['num_terminated']} "
            f"terminated",
            "environment steps": f"{training['num_timesteps']}",
            **({"running episode": f"after step {running}"} if running else {}),
        }
    )
    if content.get("run"):
        yield from _section("Run")
        yield from _pairs(_run(content["run"]))
    yield from _section("The model's fit")
    yield from _fit(content)
    yield from _section("Settings (* differs from the default)")
    yield from _pairs({f"{_mark(each)} {name}": _value(each) for name, each in settings.items()})
    yield from _section("Versions")
    of_both = {**content["versions"], **content.get("run", {}).get("versions", {})}
    yield from _pairs({name.replace("_", "-"): version for name, version in of_both.items()})


def _section(title: str) -> Iterator[str]:
    yield from ("", title)


def _pairs(pairs: Mapping[str, Any]) -> Iterator[str]:
    width = max(map(len, pairs), default=0)
    for name, value in pairs.items():
        yield f"  {name:{width}}  {value}".rstrip()


def _space(space: Mapping[str, Any]) -> str:
    size = " x ".join(map(str, space["shape"])) + (" number" if space["shape"] == [1] else " numbers")
    bounds = list(zip(_flat(space["low"]), _flat(space["high"]), strict=True))
    if len(set(bounds)) == 1:
        bounds = bounds[:1]
    shown = [f"{low:g} to {high:g}" for low, high in bounds[:MOST_SHOWN]]
    told = ", ".join([*shown, *(["..."] if len(bounds) > MOST_SHOWN else [])])
    parts = [f"{name} [{start}:{stop}]" for name, (start, stop) in space.get("parts", {}).items()]
    read_as = [f"{name} {indices}" for name, indices in space.get("read_as", {}).items() if indices]
    return "; ".join([f"{size}, {space['dtype']}, {told}", *parts, *read_as])


def _flat(values: Any) -> list[float]:
    return [each for value in values for each in _flat(value)] if isinstance(values, list) else [float(values)]


def _run(run: Mapping[str, Any]) -> dict[str, str]:
    returns = run.get("returns")
    asked = run["episodes_asked"]
    planned = f"{run['num_planned_episodes']} planned" + (f" of {asked} asked for" if asked else "")
    about = {
        "episodes": f"{planned}, {run['num_random_episodes']} begun at random; {run['seconds'] / 60:.1f} minutes",
        "started": run.get("started", ""),
        "revision": run.get("revision", ""),
        "machine": ", ".join(f"{name} {value}" for name, value in run.get("machine", {}).items()),
    }
    if returns:
        about["return of planned"] = ", ".join(f"{name} {value:.2f}" for name, value in returns.items())
    return about


def _fit(content: Mapping[str, Any]) -> Iterator[str]:
    settings, behind = content["settings"], content["training"]["num_not_learned"]
    if "diagnostics_missing" in content:
        yield f"  not known here: {content['diagnostics_missing']}"
    elif not content["diagnostics"]:
        yield "  the model says nothing of it"
    sizes = {name: settings[name]["value"] for name in ("num_chains", "num_samples") if name in settings}
    yield from _pairs(sizes | {name: f"{float(value):.4g}" for name, value in content["diagnostics"].items()})
    if content["diagnostics"] and behind:
        yield f"  (now: {behind} transitions came since the training, and samples that follow them are not its chains')"


def _mark(setting: Mapping[str, Any]) -> str:
    return {True: "*", False: " ", None: "?"}[setting["differs"]]


def _value(setting: Mapping[str, Any]) -> str:
    return f"{setting['value']}" + (f"  (default {setting['default']})" if setting["differs"] else "")
