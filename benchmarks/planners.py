"""Which planner earns most in the same time, by the same model: `python -m benchmarks.planners`.

Each planner plans the first steps of an episode, with several numbers of candidates and iterations: with the true
dynamics, or (``--dynamics learned``) with a deep GP that was trained on four recorded episodes, those of
`calibration.episodes`. What a plan costs is its processor time, the simulator's or the draw's included. Writes
`planners.md` and `planners.json`; what is in the latter already, with the same settings, is not done again.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.calibration.episodes import TASKS, load
from benchmarks.report import markdown
from benchmarks.rows import Row, made_by, measure_missing
from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.agents.presets import settings_for
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.settings import settings_of

VARIANTS: dict[str, dict[str, Any]] = {
    "CEM": {"planner": "cem"},
    "iCEM": {"planner": "icem"},
    "iCEM, beta 1": {"planner": "icem", "noise_beta": 1.0},
    "iCEM, beta 2": {"planner": "icem", "noise_beta": 2.0},
    "MPPI": {"planner": "mppi"},
    "MPPI, beta 1": {"planner": "mppi", "noise_beta": 1.0},
    "gradient": {"planner": "gradient"},
    "gradient, Adam": {"planner": "gradient", "optimiser": "adam"},
    "gradient from CEM": {"planner": "gradient", "start_from": "cem"},
}
"""Arguments of `MPCAgent` beside the paper's horizon and actions per plan for the task."""

OF_VALUES = [name for name, arguments in VARIANTS.items() if arguments["planner"] != "gradient"]
"""Those that plan with the true dynamics too, which have no gradients."""

SETTINGS = argparse.ArgumentParser(add_help=False)
SETTINGS.add_argument("--steps", type=int, default=200, help="planned steps")
SETTINGS.add_argument("--dynamics", choices=("true", "learned"), default="true", help="what plans are made with")

RECORDED = {**{env_id: task for task, env_id in TASKS.items()}, "RiskSensitiveHalfCheetah-v0": "cheetah"}
"""The recorded episodes of an environment, by its id."""

NUM_RECORDED = 4
"""Episodes that a learned model has seen."""

KIND = ("environment", "dynamics", "steps", "planner", "num_candidates", "num_iterations")
"""What rows have in common that are averaged over their seeds."""


def budget(text: str) -> tuple[int, int]:
    """Candidates and iterations of "300x5"."""
    num_candidates, num_iterations = map(int, text.split("x"))
    return num_candidates, num_iterations


def measure(wanted: Row) -> Row:
    """The return of the first steps of an episode, and what its plans cost."""
    agent = _knowing_the_dynamics(wanted) if wanted["dynamics"] == "true" else _with_a_learned_model(wanted)
    known, watch = len(agent.store), _Stopwatch(agent.planner.plan)
    setattr(agent.planner, "plan", watch)  # noqa: B010  # a method, which mypy lets nobody assign
    agent.learn(wanted["steps"], reset_num_timesteps=False)
    return {"return": float(agent.store.rewards[known:].sum()), "plan_cpu_ms": 1e3 * watch.seconds / watch.calls}


def _knowing_the_dynamics(wanted: Row) -> MPCAgent:
    """In an episode that a random step begins, since planning agents need something to learn from."""
    env_id, steps = wanted["environment"], wanted["steps"]
    env = gymnasium.make(env_id, max_episode_steps=steps + 1)
    planning = {name: value for name, value in settings_for(env_id).items() if name in ("horizon", "actions_per_plan")}
    agent = MPCAgent(
        env, TrueDynamics(env), **_planner(wanted), **planning, num_particles=1, learning_starts=1, seed=wanted["seed"]
    )
    agent.learn(1)
    return agent


def _with_a_learned_model(wanted: Row) -> MPCAgent:
    """Trained on the first episodes of the recorded run of this seed, with the settings for the task."""
    env_id, seed = wanted["environment"], wanted["seed"]
    env = gymnasium.make(env_id, max_episode_steps=wanted["steps"])
    names = {*settings_of(DeepGPDynamics), "horizon", "num_particles", "actions_per_plan"}
    settings = {name: value for name, value in settings_for(env_id).items() if name in names}
    agent = DGPMPCAgent(env, seed=seed, **settings, **_planner(wanted))
    data = load(RECORDED[env_id], seed).transitions(range(NUM_RECORDED))
    assert agent.task.functions.reward_fn is not None
    columns = {name: value.numpy() for name, value in data._asdict().items()}
    agent.add_transitions({**columns, "reward": agent.task.functions.reward_fn(*data).numpy()})
    agent.learn(0)
    return agent


def _planner(wanted: Row) -> dict[str, Any]:
    arguments = VARIANTS[wanted["planner"]]
    candidates = "num_starts" if arguments["planner"] == "gradient" else "num_candidates"
    return {**arguments, candidates: wanted["num_candidates"], "num_iterations": wanted["num_iterations"]}


class _Stopwatch:
    """A function whose calls' processor time is added up."""

    def __init__(self, function: Callable[..., Any]):
        self._function, self.calls, self.seconds = function, 0, 0.0

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        started = time.process_time()
        result = self._function(*arguments, **named)
        self.calls, self.seconds = self.calls + 1, self.seconds + time.process_time() - started
        return result


def page(rows: Sequence[Row]) -> str:
    """Means over the seeds, quickest plans first in each task; "best" where no quicker plans earn as much."""
    by_kind: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        by_kind.setdefault(tuple(row[name] for name in KIND), []).append(row)
    lines = [(*kind, *_summary(of_kind)) for kind, of_kind in by_kind.items()]
    lines.sort(key=lambda line: (*line[:3], line[-1]))
    header = ["task", "dynamics", "steps", "planner", "K", "iterations", "seeds", "return", "std", "CPU ms a plan", ""]
    cells, best = [], dict[tuple[Any, ...], float]()
    for line in lines:
        *kind, seeds, mean, std, milliseconds = line
        is_best = mean > best.get(line[:3], -np.inf)
        if is_best:
            best[line[:3]] = mean
        numbers = [markdown.number(each, 1) for each in (mean, std, milliseconds)]
        cells.append([*(markdown.cell(str(each)) for each in (*kind, seeds)), *numbers, "best" if is_best else ""])
    about = '"best" is what no quicker plans by the same dynamics on the task earn as much as.'
    return "\n".join([f"{made_by(rows)} {about}", "", *markdown.table(header, cells)]) + "\n"


def _summary(rows: Sequence[Row]) -> tuple[int, float, float, float]:
    """Seeds, mean return, its standard deviation over them, and the median of what a plan costs."""
    returns = [row["return"] for row in rows]
    std = float(np.std(returns, ddof=1)) if len(rows) > 1 else np.nan
    return len(rows), float(np.mean(returns)), std, float(np.median([row["plan_cpu_ms"] for row in rows]))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planners", description=__doc__, parents=[SETTINGS])
    tasks = ["ModCartPole-v0", "VelocityHalfCheetah-v0"]
    parser.add_argument(
        "--envs",
        nargs="+",
        default=tasks,
        metavar="ENV_ID",
        help="ids of environments, of recorded ones for a learned model",
    )
    parser.add_argument(
        "--planners",
        nargs="+",
        choices=list(VARIANTS),
        metavar="PLANNER",
        help="default: all that can plan with the dynamics",
    )
    budgets = [budget(text) for text in ("30x3", "100x3", "100x5", "300x5", "300x10")]
    parser.add_argument(
        "--budgets", nargs="+", type=budget, default=budgets, metavar="KxI", help="candidates and iterations: 300x5"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101, 102, 103, 104])
    parser.add_argument("--jobs", type=int, default=1, help="measurements at a time")
    parser.add_argument("--results", type=Path, default=RESULTS / "planners")
    arguments = parser.parse_args()
    able = OF_VALUES if arguments.dynamics == "true" else list(VARIANTS)
    unable = set(arguments.planners or able).difference(able)
    if unable:
        parser.error(f"the true dynamics have no gradients: ask for --dynamics learned, or without {sorted(unable)}")
    torch.set_num_threads(1)
    # Seeds outermost, so that an interrupted benchmark has every planner with some seeds.
    wanted: list[Row] = [
        {
            "environment": env_id, "dynamics": arguments.dynamics, "steps": arguments.steps, "planner": planner,
            "num_candidates": num_candidates, "num_iterations": num_iterations, "seed": seed,
        }
        for seed in arguments.seeds
        for env_id in arguments.envs
        for num_candidates, num_iterations in arguments.budgets
        for planner in arguments.planners or able
    ]  # fmt: skip
    print(measure_missing("planners", arguments.results, wanted, measure, SETTINGS, page, arguments.jobs))


if __name__ == "__main__":
    main()
