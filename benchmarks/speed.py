"""What a plan and a training step cost at the paper's cart-pole settings: `python -m benchmarks.speed`.

Medians and 95th percentiles over repeats after a warm-up, for each number of layers and each draw, in one run. The
model is trained for a few iterations on random data: the cost does not depend on what was learned. Writes
`speed.json` and `speed.md`. Compare figures of one run only, and of an idle machine.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from gym_dgpmpc.agents.presets import PAPER
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.dynamics.deep_gp_start import initial_model
from gym_dgpmpc.inference import mcem, sghmc
from gym_dgpmpc.inference.mcem import Data
from gym_dgpmpc.planning.cem import CEM
from gym_dgpmpc.planning.rollout import rollout_objective
from gym_dgpmpc.types import Transitions

ENVIRONMENT = "ModCartPole-v0"
DRAWS = {
    "pathwise, refresh=step": {"draw": "pathwise", "refresh": "step"},
    "pathwise, refresh=plan": {"draw": "pathwise", "refresh": "plan"},
    "marginal": {"draw": "marginal"},
    "joint": {"draw": "joint"},
}
SLOW = ("marginal", "joint")
"""Draws that factorise at each rollout step; they get fewer repeats."""


def timed(call: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Milliseconds of one call: median and 95th percentile, after two calls that are not counted."""
    call(), call()
    samples = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        samples.append(1e3 * (time.perf_counter() - started))
    return {"p50_ms": float(np.median(samples)), "p95_ms": float(np.quantile(samples, 0.95)), "repeats": repeats}


def transitions(env: gymnasium.Env, num: int) -> Transitions:
    """Observed steps under uniform random actions."""
    env.action_space.seed(0)
    rows, (observation, _) = [], env.reset(seed=0)
    for _ in range(num):
        action = env.action_space.sample()
        after, _, _, truncated, _ = env.step(action)
        rows.append((observation, action, after))
        observation = env.reset()[0] if truncated else after
    return Transitions(*(torch.as_tensor(np.array(column), dtype=torch.float32) for column in zip(*rows, strict=True)))


def measure(num_layers: int, data: Transitions, env: gymnasium.Env, repeats: int) -> list[dict[str, Any]]:
    """The rows of one number of layers: a plan with each draw, and what inference costs."""
    settings = PAPER[ENVIRONMENT]
    generator = torch.Generator().manual_seed(0)
    low, high = (torch.as_tensor(bound) for bound in (env.action_space.low, env.action_space.high))
    planner_settings = {key: settings[key] for key in ("horizon", "num_candidates", "num_elites", "num_iterations")}
    # No early stop: every plan takes all its iterations.
    planner = CEM(action_low=low, action_high=high, min_std=0.0, **planner_settings)
    reward_fn, particles = env.get_wrapper_attr("reward_fn"), settings["num_particles"]
    rows = []
    for name, draw in DRAWS.items():
        model = DeepGPDynamics(
            4, 1, env.get_wrapper_attr("observation_spec"), num_layers=num_layers,
            num_inducing=settings["num_inducing"], first_iterations=30, num_samples=10, sample_spacing=1,
            **draw,
        )  # fmt: skip
        model.fit(data, generator)

        def plan(model: DeepGPDynamics = model) -> None:
            world = model.draw(particles, planner.horizon, generator)
            objective = rollout_objective(world, reward_fn, data.observation[0], particles)
            planner.plan(objective, planner.initial_plan(), generator)

        rows.append({"what": "plan", "L": num_layers, "draw": name} | timed(plan, 3 if name in SLOW else repeats))
    return rows + measure_inference(num_layers, model, data, repeats)


def measure_inference(
    num_layers: int, model: DeepGPDynamics, data: Transitions, repeats: int, steps: int = 10
) -> list[dict[str, Any]]:
    """A training iteration (one SG-HMC and one Adam step) and an SG-HMC step alone, minibatches of 256."""
    generator = torch.Generator().manual_seed(0)
    x = model.encoder.inputs(data.observation, data.action).double()
    y = model.encoder.targets(data.observation, data.next_observation).double()
    standardised = Data(Normaliser.fit(x)(x), Normaliser.fit(y)(y))
    start = initial_model(standardised, num_layers, model.num_inducing, generator)
    chain = sghmc.init(x.new_zeros(start.num_whitened()))
    settings = model.inference

    def train() -> None:
        mcem.train(model.kernel, start, chain, standardised, steps, generator, settings)

    def sample() -> None:
        list(mcem.sample(model.kernel, start, chain, standardised, 1, steps, generator, settings))

    rows = []
    for what, call in (("training iteration", train), ("SG-HMC step", sample)):
        times = timed(call, repeats)
        per_step = {key: times[key] / steps for key in ("p50_ms", "p95_ms")}
        rows.append({"what": what, "L": num_layers, "draw": ""} | per_step | {"repeats": repeats})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--layers", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/speed"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    env = gymnasium.make(ENVIRONMENT)
    data = transitions(env, 400)
    rows = [row for layers in arguments.layers for row in measure(layers, data, env, arguments.repeats)]
    facts = {
        "command": f"python -m benchmarks.speed {' '.join(sys.argv[1:])}".strip(),
        "environment": ENVIRONMENT,
        "settings": dict(PAPER[ENVIRONMENT]),
        "threads": arguments.threads,
        "load_average_1_min": os.getloadavg()[0],
        "versions": {"python": platform.python_version(), "torch": torch.__version__},
    }
    arguments.results.mkdir(parents=True, exist_ok=True)
    (arguments.results / "speed.json").write_text(json.dumps(facts | {"rows": rows}, indent=2) + "\n")
    table = ["| what | L | draw | p50 ms | p95 ms |", "|---|---|---|---|---|"]
    table += [f"| {r['what']} | {r['L']} | {r['draw']} | {r['p50_ms']:.1f} | {r['p95_ms']:.1f} |" for r in rows]
    text = f"Made by `{facts['command']}`; {arguments.threads} thread(s); settings and versions in `speed.json`.\n\n"
    text += "\n".join(table) + "\n"
    (arguments.results / "speed.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
