"""Whether a trained agent keeps up with its plant: `python -m benchmarks.real_time AGENT.zip`.

Controls the environment that the agent was trained in with its own planning settings and with the quicker ones of
`presets.REAL_TIME`, on the same starting states, and times every call of `predict`. Writes `real_time.md` and
`real_time.json`.
"""

import argparse
import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.agents.presets import REAL_TIME


def control(agent: DGPMPCAgent, env: gymnasium.Env, seeds: range) -> dict[str, Any]:
    """Returns of one episode per seed, and quantiles of the milliseconds that an action took."""
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
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/speed"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    env, rows, load = gymnasium.make(arguments.env), [], os.getloadavg()[0]
    seeds = range(7000, 7000 + arguments.episodes)
    for path in arguments.agent:
        for name, settings in (("as trained", {}), ("REAL_TIME", dict(REAL_TIME[arguments.env]))):
            agent = DGPMPCAgent.load(path, env=env, **settings)
            names = ("num_layers", "num_candidates", "num_iterations", "horizon", "num_particles")
            about = {"agent": path.parent.name, "settings": name} | {key: getattr(agent, key) for key in names}
            rows.append(about | control(agent, env, seeds))
            print(rows[-1], file=sys.stderr, flush=True)
    facts = {
        "command": f"python -m benchmarks.real_time {' '.join(sys.argv[1:])}",
        "threads": arguments.threads,
        "load_average_1_min_before": load,
        "versions": {"python": platform.python_version(), "torch": torch.__version__},
        "rows": rows,
    }
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "real_time.json").write_text(json.dumps(facts, indent=1) + "\n")
    lines = [
        f"Made by `{facts['command']}`; {arguments.threads} thread(s), {arguments.episodes} episodes each from the "
        "same starting states. One step of the environment is "
        f"{1e3 * env.unwrapped.dt:.0f} ms.",
        "",
        "| agent | L | settings | K | iterations | p50 ms | p95 ms | p99 ms | mean return | std |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['agent']} | {row['num_layers']} | {row['settings']} | {row['num_candidates']} "
            f"| {row['num_iterations']} | {row['p50_ms']:.1f} | {row['p95_ms']:.1f} | {row['p99_ms']:.1f} "
            f"| {np.mean(row['returns']):.1f} | {np.std(row['returns'], ddof=1):.1f} |"
        )
    (arguments.results / "real_time.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
