"""How well a model trained on one random episode knows what it does not know: `python -m benchmarks.calibration`.

Trains on the modified cart-pole with and without exact draws of the last layer, and tests H-step predictions on
episodes of smoother random actions, which go elsewhere. Writes `calibration.md` and `calibration.json`.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.inference.mcem import InferenceSettings
from gym_dgpmpc.types import Transitions

ENVIRONMENT, TEST_SEEDS, NUM_PARTICLES, NORMAL_90 = "ModCartPole-v0", range(5000, 5004), 100, 1.645


def episode(env: gymnasium.Env, seed: int, smoothing: float) -> Transitions:
    """200 steps under actions that are uniform (``smoothing`` 0) or follow a bounded autoregression."""
    rng, rows = np.random.default_rng(seed), []
    observation, _ = env.reset(seed=seed)
    level = 0.0
    for _ in range(200):
        level = np.clip(smoothing * level + (rng.normal(0, 1.2) if smoothing else rng.uniform(-3, 3)), -3, 3)
        after = env.step(np.array([level], dtype=np.float32))[0]
        rows.append((observation, np.array([level]), after))
        observation = after
    return Transitions(*(torch.as_tensor(np.array(column), dtype=torch.float32) for column in zip(*rows, strict=True)))


def score(
    model: DeepGPDynamics, tests: list[Transitions], horizon: int, generator: torch.Generator
) -> dict[str, float]:
    """Coverage of the 90 % interval and negative log likelihood, Gaussian in the particles' moments, H steps ahead."""
    covered, likelihood = [], []
    for test in tests:
        start = torch.arange(0, len(test.action) - horizon, 5)
        sampler = model.draw(NUM_PARTICLES, horizon, generator)
        state = test.observation[start].expand(NUM_PARTICLES, -1, -1).contiguous()
        for step in range(horizon):
            state = sampler(state, test.action[start + step], step)
        mean, std = state.mean(0), state.std(0).clamp_min(1e-4)
        error = test.next_observation[start + horizon - 1] - mean
        covered.append((error.abs() < NORMAL_90 * std).float().mean())
        likelihood.append((0.5 * (error / std).square() + std.log() + 0.5 * np.log(2 * np.pi)).mean())
    return {"coverage_90": float(torch.stack(covered).mean()), "nll": float(torch.stack(likelihood).mean())}


def measure(gibbs_every: int, spacing: int, seed: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """One model on one random episode."""
    env, generator = gymnasium.make(ENVIRONMENT), torch.Generator().manual_seed(seed)
    model = DeepGPDynamics(
        4, 1, env.get_wrapper_attr("observation_spec"), num_layers=arguments.layers, kernel=arguments.kernel,
        first_iterations=arguments.iterations, sample_spacing=spacing,
        inference=InferenceSettings(gibbs_every=gibbs_every),
    )  # fmt: skip
    started = time.perf_counter()
    model.fit(episode(env, seed, 0.0), generator)
    tests = [episode(env, test_seed, 0.8) for test_seed in TEST_SEEDS]
    row = {"gibbs_every": gibbs_every, "spacing": spacing, "seed": seed, "seconds": time.perf_counter() - started}
    for horizon in (1, 15):
        row |= {f"{name}_{horizon}": value for name, value in score(model, tests, horizon, generator).items()}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration", description=__doc__)
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--kernel", default="matern32")
    parser.add_argument("--iterations", type=int, default=4000)
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101])
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/calibration"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = ((0, 50), (20, 10))  # SG-HMC alone gets five times the steps between samples
    rows = [measure(*setting, seed, arguments) for setting in settings for seed in arguments.seeds]
    command = f"python -m benchmarks.calibration {' '.join(sys.argv[1:])}".strip()
    arguments.results.mkdir(parents=True, exist_ok=True)
    facts = {"command": command, "environment": ENVIRONMENT, "torch": torch.__version__, "rows": rows}
    (arguments.results / "calibration.json").write_text(json.dumps(facts, indent=2) + "\n")
    names = [name for name in rows[0] if name != "seconds"]
    lines = [f"Made by `{command}`.", "", f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(f"{row[name]:.2f}".removesuffix(".00") for name in names) + " |" for row in rows]
    (arguments.results / "calibration.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
