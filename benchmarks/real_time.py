"""Whether a trained agent keeps up with its plant: `python -m benchmarks.real_time AGENT.zip`.

Controls the environment that the agent was trained in with its own planning settings and with the quicker ones of
`presets.REAL_TIME`, on the same starting states, and times every call of `predict`. Writes `real_time.md` and
`real_time.json`.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.report import markdown
from benchmarks.rows import Row, command
from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.agents.presets import REAL_TIME
from gym_dgpmpc.checkpoints.files import replace_text
from gym_dgpmpc.runs.provenance import machine, versions


@runtime_checkable
class Controller(Protocol):
    """What chooses the actions, such as an agent."""

    def predict(self, observation: np.ndarray, state: Any = None) -> tuple[np.ndarray, Any]:
        """The next action, and what the next call needs as ``state``."""


def control(agent: Controller, env: gymnasium.Env, seeds: range) -> dict[str, Any]:
    """Returns of one episode per seed, and quantiles of the milliseconds that choosing an action takes."""
    returns, times = [], []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        state, total, done = None, 0.0, False
        while not done:
            started = time.perf_counter()
            action, state = agent.predict(observation, state=state)
            times.append(1e3 * (time.perf_counter() - started))
            observation, reward, terminated, truncated, _ = env.step(action)
            total, done = total + float(reward), terminated or truncated
        returns.append(total)
    p50, p95, p99 = np.quantile(times[2:], [0.5, 0.95, 0.99])  # the first calls warm up
    quantiles = {"p50_ms": p50, "p95_ms": p95, "p99_ms": p99, "max_ms": max(times[2:])}
    return {"returns": returns} | {name: float(value) for name, value in quantiles.items()}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real_time", description=__doc__)
    parser.add_argument("agent", type=Path, nargs="+", help="files of trained agents, of one environment")
    parser.add_argument("--env", default="ModCartPole-v0")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS / "speed")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    env, load = gymnasium.make(arguments.env), os.getloadavg()[0]
    rows: list[Row] = []
    seeds = range(7000, 7000 + arguments.episodes)
    planning: dict[str, dict[str, Any]] = {"as trained": {}, "REAL_TIME": dict(REAL_TIME[arguments.env])}
    for path in arguments.agent:
        for name, settings in planning.items():
            agent = DGPMPCAgent.load(path, env=env, **settings)
            names = ("num_layers", "num_candidates", "num_iterations", "horizon", "num_particles")
            about = {"agent": path.parent.name, "settings": name} | {key: getattr(agent, key) for key in names}
            rows.append(about | control(agent, env, seeds))
            print(rows[-1], file=sys.stderr, flush=True)
    facts: Row = {"command": command("real_time"), "threads": arguments.threads, "load_average_1_min_before": load}
    facts |= {"machine": machine(), "versions": versions(), "rows": rows}
    replace_text(arguments.results / "real_time.json", json.dumps(facts, indent=1) + "\n")
    head = (
        f"Made by `{facts['command']}`; {arguments.threads} thread(s), {arguments.episodes} episodes each from the "
        f"same starting states. One step of the environment is {1e3 * env.get_wrapper_attr('dt'):.0f} ms."
    )
    text = "\n".join([head, "", *table(rows)]) + "\n"
    replace_text(arguments.results / "real_time.md", text)
    print(text)


def table(rows: list[Row]) -> list[str]:
    """Each agent with each of its settings in Markdown."""
    header = ["agent", "L", "settings", "K", "iterations", "p50 ms", "p95 ms", "p99 ms", "mean return", "std"]
    cells = []
    for row in rows:
        names = ("agent", "num_layers", "settings", "num_candidates", "num_iterations")
        numbers = [*(row[f"{name}_ms"] for name in ("p50", "p95", "p99")), np.mean(row["returns"])]
        spread = f"{np.std(row['returns'], ddof=1):.1f}" if len(row["returns"]) > 1 else markdown.NOTHING
        cells.append([*(markdown.cell(str(row[name])) for name in names), *(f"{x:.1f}" for x in numbers), spread])
    return markdown.table(header, cells)


if __name__ == "__main__":
    main()
