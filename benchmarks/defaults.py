"""Whether a default may change: `python -m benchmarks.defaults VARIANT ...`, the protocol of docs/planning.md.

A variant is given by its settings, "kernel=rbf,planner=icem"; the present defaults are measured beside the variants.
All pass three stages: forecasts of recorded episodes, the first five planned episodes of the cart-pole, and the first
four of the half-cheetah; ``--stages`` has more tasks, some without their presets, as a user's own. Writes
`defaults.md` and `defaults.json`; what is in the latter already, with the same settings, is not done again. A row names
all settings of its agent, so that rows of former defaults stay what they are.
"""

import argparse
import ast
import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats

from benchmarks import RESULTS
from benchmarks.calibration.episodes import SEEDS
from benchmarks.calibration.episodes import TASKS as RECORDED
from benchmarks.calibration.measure import measure as forecast_recorded
from benchmarks.methods import PlanningMethod
from benchmarks.report import markdown
from benchmarks.rows import Row, made_by, measure_missing
from benchmarks.tasks import TASKS
from gym_dgpmpc.agents import DGPMPCAgent, presets
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.runs.provenance import revision
from gym_dgpmpc.settings import settings_of

METHOD = PlanningMethod("DGP-MPC", DGPMPCAgent, lambda task: presets.settings_for(task.preset))

LEARNING: Mapping[str, tuple[int, tuple[int, ...]]] = {
    "ModCartPole-v0": (5, SEEDS),
    "RiskSensitiveHalfCheetah-v0": (4, SEEDS[:3]),
    "Pendulum-v1": (3, SEEDS),
    "BiasedReacher-v0": (3, SEEDS),
    "OutsideCartPole-v0": (4, SEEDS),
    "ModCartPole-v0:no presets": (5, SEEDS),
    "Pendulum-v1:no presets": (4, SEEDS),
    "Reacher-v5:no presets": (10, SEEDS),
}
"""Planned episodes and seeds of the stages that learn."""

KNOWING = tuple(RECORDED)
"""Recorded tasks, whose forecasts a variant of the planner has in common with the defaults."""


PROTOCOL = ("cartpole", "cheetah", "ModCartPole-v0", "RiskSensitiveHalfCheetah-v0")
"""The stages that each default has to pass; the others are for those that concern every task."""


def variant(text: str) -> dict[str, Any]:
    """The settings that "kernel=rbf,horizon=20" names; none of "default".

    Raises:
        argparse.ArgumentTypeError: it is neither.
    """
    if text == "default":
        return {}
    settings = {}
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if not equals or not name.isidentifier():
            raise argparse.ArgumentTypeError(f"expected default, or settings as in kernel=rbf,horizon=20, got {text!r}")
        try:
            settings[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):  # a word
            settings[name] = value
    return settings


def wanted_rows(
    changed: Mapping[str, Any], seeds: Sequence[int] | None, stages: Sequence[str], episodes: int | None = None
) -> list[Row]:
    """What is to be measured of a variant; its settings are in each row.

    Raises:
        ValueError: a setting has an unknown name.
    """
    rows: list[Row] = []
    for stage in stages:
        about: Row = {"stage": stage, "settings": _settings(stage, changed)}
        own_seeds: tuple[int, ...] = SEEDS
        if stage in LEARNING:
            count, own_seeds = LEARNING[stage]
            about["episodes"] = episodes or count
        rows += [about | {"seed": seed} for seed in seeds or own_seeds]
    return rows


def _settings(stage: str, changed: Mapping[str, Any]) -> dict[str, Any]:
    """All of an agent's on a task, or those of its model where recorded episodes are forecast."""
    of_agent = METHOD.settings(TASKS[RECORDED.get(stage, stage)], **changed)
    names = settings_of(DeepGPDynamics) if stage in KNOWING else of_agent
    return {name: of_agent[name] for name in sorted(names) if name in of_agent}


def measure(wanted: Row) -> Row:
    """Forecasts of a recorded learning run, or the returns of a run of its own."""
    stage, settings, seed = (wanted[name] for name in ("stage", "settings", "seed"))
    started, about = time.process_time(), {"revision": revision()}
    if stage in KNOWING:
        rows = forecast_recorded(partial(DeepGPDynamics), stage, seed, **settings)
        found: Row = {name: float(np.mean([row[name] for row in rows])) for name in ("nll", "coverage_90", "rmse")}
        found["z2"] = float(np.median([row["z2"] for row in rows]))
    else:
        task = TASKS[stage]
        agent = METHOD.make(task.make(), settings, seed)
        explored = math.ceil((settings["learning_starts"] or 1) / task.episode_steps)
        played = range(explored, explored + wanted["episodes"])
        agent.learn(played.stop * task.episode_steps)
        arrays = agent.to_arrays()
        returns = [float(arrays["reward"][arrays["episode"] == episode].sum()) for episode in played]
        found = {"returns": returns, "return": float(np.mean(returns))}
    return found | {"cpu_minutes": (time.process_time() - started) / 60} | about


def page(rows: Sequence[Row]) -> str:
    """A table of each stage: every variant beside what the defaults are now, difference by pairs of seeds."""
    lines = [made_by(rows), ""]
    for stage in dict.fromkeys(row["stage"] for row in rows):
        of_stage = [row for row in rows if row["stage"] == stage]
        lines += [f"## {stage}", "", *_stage_table(stage, of_stage), ""]
    return "\n".join(lines)


def _stage_table(stage: str, rows: Sequence[Row]) -> list[str]:
    knows = stage in KNOWING
    value = "nll" if knows else "return"
    others = ["coverage_90", "z2", "rmse"] if knows else []
    variants: dict[str, list[Row]] = {}
    for row in rows:
        variants.setdefault(_difference(stage, row["settings"]), []).append(row)
    base = {row["seed"]: row[value] for row in variants.get("default", [])}
    header = ["variant", "seeds", "mean NLL" if knows else "mean return", "less the default's", *others]
    header += ["CPU minutes"] if knows else ["by episode", "lowest first", "CPU minutes"]
    cells = []
    for name, own in variants.items():
        pairs = [row[value] - base[row["seed"]] for row in own if row["seed"] in base and name != "default"]
        numbers = [_mean(own, value), _interval(pairs), *(_mean(own, other, 2) for other in others)]
        if not knows:
            by_episode = np.mean([row["returns"] for row in own], axis=0)
            numbers.append(", ".join(markdown.number(each, 0) for each in by_episode))
            numbers.append(markdown.number(min(row["returns"][0] for row in own), 0))
        seeds = ", ".join(str(row["seed"]) for row in own)
        cells.append([markdown.cell(name), seeds, *numbers, _mean(own, "cpu_minutes", 1)])
    return markdown.table(header, cells)


def _difference(stage: str, settings: Mapping[str, Any]) -> str:
    """What is not as by default; of a planner's own settings, what is not as by that planner's."""
    planner = {name: settings[name] for name in ("planner",) if name in settings}
    present, with_planner = _settings(stage, {}), _settings(stage, planner)
    changed = {name: value for name, value in planner.items() if value != present[name]}
    changed |= {name: value for name, value in settings.items() if value != with_planner.get(name)}
    return ", ".join(f"{name}={value}" for name, value in changed.items()) or "default"


def _mean(rows: Sequence[Row], name: str, digits: int = 2) -> str:
    return markdown.number(float(np.mean([row[name] for row in rows])), digits)


def _interval(pairs: Sequence[float]) -> str:
    """The mean of the differences and its 95 % interval by Student's t."""
    if len(pairs) < 2:
        return markdown.NOTHING
    mean, error = float(np.mean(pairs)), float(stats.sem(pairs))
    reach = float(stats.t.ppf(0.975, len(pairs) - 1)) * error
    low, high = (markdown.number(each, 2) for each in (mean - reach, mean + reach))
    return f"{markdown.number(mean, 2)} [{low}, {high}]"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.defaults", description=__doc__)
    parser.add_argument(
        "variants", nargs="*", metavar="VARIANT", type=variant, help="default, or settings as in kernel=rbf,horizon=20"
    )
    stages = [*KNOWING, *LEARNING]
    parser.add_argument("--stages", nargs="+", default=PROTOCOL, choices=stages)
    parser.add_argument("--seeds", nargs="+", type=int, help="default: each stage's own")
    parser.add_argument("--episodes", type=int, help="planned episodes of each run; default: each stage's own")
    parser.add_argument("--jobs", type=int, default=2, help="measurements at a time, each of one thread")
    parser.add_argument("--results", type=Path, default=RESULTS / "defaults")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    wanted: list[Row] = []
    for changed in [{}, *arguments.variants]:
        try:
            rows = wanted_rows(changed, arguments.seeds, arguments.stages, arguments.episodes)
        except ValueError as error:
            parser.error(str(error))
        wanted += [row for row in rows if row not in wanted]
    # Seeds outermost, so that an interrupted command has every variant with some seeds.
    wanted.sort(key=lambda row: row["seed"])
    print(measure_missing("defaults", arguments.results, wanted, measure, page=page, jobs=arguments.jobs))


if __name__ == "__main__":
    main()
