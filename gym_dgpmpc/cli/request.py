"""What `dgpmpc train` is asked for: by its options, or by the folder of the run that it is to go on with.

A folder's `settings.json` has under "settings" what identifies the run, which nothing may contradict, and under
"options" what else the command was given, which may be given anew.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gym_dgpmpc.cli.common import environment_of
from gym_dgpmpc.formats import FORMATS
from gym_dgpmpc.settings import refuse_unknown

DEFAULT_EPISODES = 15
DEFAULT_AGENT = "dgp-mpc"
DEFAULT_OPTIONS: dict[str, Any] = {
    "threads": 1,
    "video": True,
    "look": False,
    "checkpoint_every": None,
    "formats": [*FORMATS[:1]],
}
"""What is not given, and no folder says; beside ``episodes`` and ``timesteps``, of which one is needed."""


class Request(NamedTuple):
    """A run that is to begin or to go on."""

    env_id: str
    agent: str
    """A name of `options.AGENTS`."""
    arguments: dict[str, Any]
    """Every argument of the agent."""
    options: dict[str, Any]
    """Those of `DEFAULT_OPTIONS`, ``episodes`` and ``timesteps``."""
    folder: Path | None
    """None: one that environment and seed give its name."""


def new_request(
    env_id: str, out: Path | None, agent: str | None, given: Mapping[str, Any], options: Mapping[str, Any]
) -> Request:
    """What the command's options ask for; None stands for one that was not given.

    Args:
        env_id: of the environment.
        out: the folder.
        agent: a name of `options.AGENTS`.
        given: arguments of the agent, its seed among them.
        options: those of a `Request`.

    Raises:
        TypeError: a setting that the agent with this planner does not have was given.
    """
    agent = agent or DEFAULT_AGENT
    arguments = fill_in(env_id, {**given, "seed": given["seed"] or 0}, agent)
    return Request(env_id, agent, arguments, _asked(DEFAULT_OPTIONS, options), out)


def resumed_request(
    folder: Path, env_id: str | None, agent: str | None, given: Mapping[str, Any], options: Mapping[str, Any]
) -> Request:
    """What a folder says of its run, and of the options those that were given anew.

    Args:
        folder: written by `dgpmpc train`.
        env_id, agent, given, options: see `new_request`; the environment may be None too.

    Raises:
        ValueError: there is no such folder, it is of another command, or something that was given contradicts it.
        TypeError: the folder, or what was given, has a setting that there is not.
    """
    from gym_dgpmpc.checkpoints.arguments import decode
    from gym_dgpmpc.runs.folder import read_settings

    content = read_settings(folder)
    settings, known = content["settings"], content.get("options", {})
    if "method" in settings:
        raise ValueError(f"{folder} is of a benchmark: the command that goes on with it is {content.get('command')}")
    _refuse_contradictions(
        folder, settings, {"environment": env_id and env_id.rpartition(":")[-1], "agent": agent, **given}
    )
    own = {name: decode(value) for name, value in settings.items() if name not in ("environment", "agent")}
    env_id = env_id or known.get("env_id") or _environment(folder, settings)
    agent = settings.get("agent", DEFAULT_AGENT)
    arguments = fill_in(env_id, {**given, "planner": own.get("planner"), "seed": own.get("seed")}, agent)
    refuse_unknown(f"an agent {agent} of this version", own, arguments)
    before = {"threads": content.get("machine", {}).get("threads", 1), **known}
    if options["episodes"] is None and options["timesteps"] is None:
        # Where episodes were asked for, the steps are no more than what they take.
        name = "timesteps" if content.get("episodes") is None else "episodes"
        before[name] = content.get(name)
    return Request(env_id, agent, arguments | own, _asked({**DEFAULT_OPTIONS, **before}, options), folder)


def _refuse_contradictions(folder: Path, settings: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Raise a ValueError that names what was given and is otherwise in the folder."""
    differing = [
        f"{name} is {settings[name]} there, {value} was given"
        for name, value in given.items()
        if value is not None and name in settings and json.loads(json.dumps(value)) != settings[name]
    ]
    if differing:
        raise ValueError(
            f"the run in {folder} has other settings ({'; '.join(differing)}): leave them out to go on with it, or "
            "begin another run in another folder"
        )


def _environment(folder: Path, settings: Mapping[str, Any]) -> str:
    """The environment's id in a folder that does not have it among its options: of an older version.

    The agent's file has the module before it, for importing that may be what registers it.
    """
    from gym_dgpmpc.checkpoints.folder import NEWEST

    file = folder / NEWEST
    return environment_of(file, None) if file.is_file() else settings["environment"]


def _asked(known: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    names = dict.fromkeys((*DEFAULT_OPTIONS, "episodes", "timesteps"))
    return {name: known.get(name) if options[name] is None else options[name] for name in names}


def fill_in(env_id: str, asked: dict[str, Any], agent: str = DEFAULT_AGENT) -> dict[str, Any]:
    """Every argument: as given, else from the preset for the environment, else the agent's default.

    Raises:
        TypeError: a setting that the agent with this planner does not have was given.
    """
    from gym_dgpmpc.cli.options import AGENTS

    agent_class, settings_for = AGENTS[agent]
    given, preset = {name: value for name, value in asked.items() if value is not None}, settings_for(env_id)
    planner = given.setdefault("planner", preset.get("planner", "cem"))
    known = {**agent_class.own_settings(), **agent_class.part_settings(planner)}
    others = {"planner", "reward_fn", "terminated_fn"}
    refuse_unknown(f"an agent {agent} that plans by {planner}", given, {*known, *others})
    filled = {name: known[name].default if name in known else None for name in asked if name in {*known, *others}}
    filled |= {name: value for name, value in preset.items() if name in known}
    if "num_candidates" in given and "num_elites" in filled:
        filled["num_elites"] = None  # the preset's elites are a part of the preset's candidates
    return filled | given


def identifying(arguments: Mapping[str, Any], agent: str) -> dict[str, Any]:
    """The arguments that tell one run from another; settings that depend on the machine do not."""
    from gym_dgpmpc.cli.options import AGENTS

    settings = AGENTS[agent].agent_class.part_settings(arguments["planner"])
    return {name: value for name, value in arguments.items() if name not in settings or settings[name].is_saved}
