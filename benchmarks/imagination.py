"""What policies from imagination keep of the planner's return: `python -m benchmarks.imagination`.

An agent learns for a few real episodes; a policy is trained in the worlds of its model; both then play the same
episodes of a new environment. ``--dyna`` instead lets a `DynaAgent`, which acts by its policy from the first planned
episode on, learn for as many. Writes `imagination.md` and `imagination.json`; what is in the latter already is not
done again.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from benchmarks import RESULTS
from benchmarks.report import markdown
from benchmarks.rows import Row, made_by, measure_missing
from benchmarks.tasks import TASKS
from gym_dgpmpc import DGPMPCAgent, DynaAgent
from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.agents.presets import settings_for
from gym_dgpmpc.imagination import imagine
from gym_dgpmpc.runs.provenance import revision

PLAYED = 5
"""Episodes that planner and policy play, the same ones."""

ENV_SEED = 1000
TIMED = 1_000
"""Actions of which the time is taken."""

Player = MPCAgent | BaseAlgorithm


def measure(wanted: Row) -> Row:
    """Returns in the environment and in imagination, and what they cost."""
    found = _dyna(wanted) if wanted["agent"] == "DynaAgent" else _distilled(wanted)
    return found | {"revision": revision()}


def _distilled(wanted: Row) -> Row:
    task, started = TASKS[wanted["task"]], time.process_time()
    agent = DGPMPCAgent(task.make(), **settings_for(task.preset), seed=wanted["seed"])
    agent.learn((1 + wanted["episodes"]) * task.episode_steps)
    learned = time.process_time()
    found = imagine(agent, wanted["algorithm"], wanted["total_timesteps"])
    imagined = time.process_time()
    times = _action_times(found.model, agent)
    return {
        "planner_return": _played(agent, wanted["task"]),
        "policy_return": _played(found.model, wanted["task"]),
        "fresh_return": found.fresh.mean_return,
        "imagined_steps": found.trials[-1].timesteps,
        "action_ms_p50": float(np.quantile(times, 0.5)),
        "action_ms_p95": float(np.quantile(times, 0.95)),
        "learning_cpu_minutes": (learned - started) / 60,
        "imagination_cpu_minutes": (imagined - learned) / 60,
    }


def _dyna(wanted: Row) -> Row:
    task, started = TASKS[wanted["task"]], time.process_time()
    settings = {**settings_for(task.preset), "algorithm": wanted["algorithm"]}
    if wanted["total_timesteps"] is not None:
        settings["imagined_timesteps"] = wanted["total_timesteps"]
    agent = DynaAgent(task.make(), **settings, seed=wanted["seed"])
    agent.learn((1 + wanted["episodes"]) * task.episode_steps)
    returns = np.bincount(agent.store.episodes, agent.store.rewards)
    return {
        "returns": returns[1:].tolist(),
        "learning_cpu_minutes": (time.process_time() - started) / 60,
    }


def _played(player: Player, task: str) -> float:
    """The mean return of the first episodes of a new environment."""
    env = Monitor(TASKS[task].make())
    env.reset(seed=ENV_SEED)
    mean, _ = evaluate_policy(player, env, PLAYED)
    assert isinstance(mean, float)
    return mean


def _action_times(model: BaseAlgorithm, agent: MPCAgent) -> list[float]:
    """Processor time of single actions, in milliseconds."""
    observations = agent.store.transitions().observation.numpy()
    times = []
    for index in range(TIMED):
        started = time.process_time_ns()
        model.predict(observations[index % len(observations)], deterministic=True)
        times.append((time.process_time_ns() - started) / 1e6)
    return times


def page(rows: Sequence[Row]) -> str:
    """What each kind of run earned, mean and lowest over its seeds."""
    lines = [made_by(rows), ""]
    distilled = _by_kind([row for row in rows if row["agent"] != "DynaAgent"])
    header = [
        "task", "episodes", "algorithm", "seeds", "planner", "policy", "lowest", "share kept", "in fresh worlds",
        "imagined steps", "ms an action, p50", "p95", "CPU minutes to learn", "to imagine",
    ]  # fmt: skip
    names = ("planner_return", "policy_return")
    after = ("fresh_return", "imagined_steps", "action_ms_p50", "action_ms_p95")
    cells = []
    for (task, episodes, algorithm), own in distilled.items():
        planner, policy = (float(np.mean([row[name] for row in own])) for name in names)
        lowest = min(row["policy_return"] for row in own)
        share = f"{100 * policy / planner:.0f} %" if planner > 0 else markdown.NOTHING
        means = [float(np.mean([row[name] for row in own])) for name in after]
        minutes = [float(np.mean([row[f"{name}_cpu_minutes"] for row in own])) for name in ("learning", "imagination")]
        cells.append(
            [
                task, str(episodes), algorithm, _seeds(own),
                *(markdown.number(x, 1) for x in (planner, policy, lowest)),
                share, markdown.number(means[0], 1), markdown.number(means[1], 0),
                *(markdown.number(x, 2) for x in means[2:]), *(markdown.number(x, 1) for x in minutes),
            ]
        )  # fmt: skip
    lines += [*markdown.table(header, cells), ""] if cells else []
    dyna = _by_kind([row for row in rows if row["agent"] == "DynaAgent"])
    header = ["task", "algorithm", "seeds", "mean return", "by episode", "CPU minutes"]
    cells = [
        [
            task, algorithm, _seeds(own), markdown.number(float(np.mean([row["returns"] for row in own])), 1),
            ", ".join(markdown.number(each, 0) for each in np.mean([row["returns"] for row in own], axis=0)),
            markdown.number(float(np.mean([row["learning_cpu_minutes"] for row in own])), 1),
        ]
        for (task, _, algorithm), own in dyna.items()
    ]  # fmt: skip
    lines += ["## DynaAgent", "", *markdown.table(header, cells), ""] if cells else []
    return "\n".join(lines)


def _by_kind(rows: Sequence[Row]) -> dict[tuple[str, int, str], list[Row]]:
    kinds: dict[tuple[str, int, str], list[Row]] = {}
    for row in rows:
        kinds.setdefault((row["task"], row["episodes"], row["algorithm"]), []).append(row)
    return kinds


def _seeds(rows: Sequence[Row]) -> str:
    return ", ".join(str(row["seed"]) for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imagination", description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["ModCartPole-v0"], choices=list(TASKS), metavar="TASK")
    parser.add_argument("--algorithms", nargs="+", default=["SAC"], metavar="ALGORITHM", help="gradient, SAC, TQC, ...")
    parser.add_argument("--episodes", type=int, default=5, help="planned episodes of each run, after a random one")
    parser.add_argument("--total-timesteps", type=int, help="imagined steps; default: what suits the algorithm")
    parser.add_argument("--dyna", action="store_true", help="let a DynaAgent learn instead")
    parser.add_argument("--seeds", nargs="+", type=int, default=[20, 21, 22, 23, 24])
    parser.add_argument("--jobs", type=int, default=1, help="measurements at a time, each of one thread")
    parser.add_argument("--results", type=Path, default=RESULTS / "imagination")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    wanted: list[Row] = [
        {
            "agent": "DynaAgent" if arguments.dyna else "DGPMPCAgent", "task": task, "algorithm": algorithm,
            "episodes": arguments.episodes, "total_timesteps": arguments.total_timesteps, "seed": seed,
        }
        for seed in arguments.seeds
        for task in arguments.tasks
        for algorithm in arguments.algorithms
    ]  # fmt: skip
    print(measure_missing("imagination", arguments.results, wanted, measure, page=page, jobs=arguments.jobs))


if __name__ == "__main__":
    main()
