"""How well a model trained on one random episode knows what it does not know: `python -m benchmarks.calibration`.

Trains on the modified cart-pole in several ways, and tests H-step predictions on episodes of smoother random actions,
which go elsewhere. Writes `calibration.md` and `calibration.json`; what is in the latter already is not done again.
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

VARIANTS: dict[str, dict[str, Any]] = {
    # SG-HMC alone gets five times the steps between samples.
    "SG-HMC alone": {"sample_spacing": 50, "gibbs_every": 0},
    "exact draws of the last layer (default)": {},
    "hyperparameters every 2nd step": {"hyperparameters_every": 2},
    "hyperparameters every 4th step": {"hyperparameters_every": 4},
    "half the iterations": {"first_iterations": 2000},
    "stopped early, patience 5": {"patience": 5},
}
"""Ways of training, as arguments of `DeepGPDynamics` or `InferenceSettings`."""

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


def measure(variant: str, seed: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """One model on one random episode."""
    env, generator = gymnasium.make(ENVIRONMENT), torch.Generator().manual_seed(seed)
    inference = {key: value for key, value in VARIANTS[variant].items() if key in InferenceSettings.__annotations__}
    settings = {key: value for key, value in VARIANTS[variant].items() if key not in inference}
    model = DeepGPDynamics(
        4, 1, env.get_wrapper_attr("observation_spec"), num_layers=arguments.layers, kernel=arguments.kernel,
        inference=InferenceSettings(**inference), **settings,
    )  # fmt: skip
    started = time.process_time()
    metrics = model.fit(episode(env, seed, 0.0), generator)
    row = {"variant": variant, "seed": seed, "cpu_seconds": time.process_time() - started}
    row["iterations"] = metrics["iterations"]
    tests = [episode(env, test_seed, 0.8) for test_seed in TEST_SEEDS]
    for horizon in (1, 15):
        row |= {f"{name}_{horizon}": value for name, value in score(model, tests, horizon, generator).items()}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration", description=__doc__)
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--kernel", default="matern32")
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101])
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/calibration"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    saved = arguments.results / "calibration.json"
    rows = json.loads(saved.read_text())["rows"] if saved.exists() else []
    done = {(row.get("variant"), row["seed"]) for row in rows}
    wanted = [(variant, seed) for variant in VARIANTS for seed in arguments.seeds]
    command = f"python -m benchmarks.calibration {' '.join(sys.argv[1:])}".strip()
    for setting in wanted:
        if setting not in done:
            rows.append(measure(*setting, arguments))
            write(rows, command, arguments.results)
    print((arguments.results / "calibration.md").read_text())


def write(rows: list[dict[str, Any]], command: str, results: Path) -> None:
    """All rows so far, raw and as a table."""
    results.mkdir(parents=True, exist_ok=True)
    facts = {"command": command, "environment": ENVIRONMENT, "torch": torch.__version__, "rows": rows}
    (results / "calibration.json").write_text(json.dumps(facts, indent=2) + "\n")
    names = list(rows[0])
    lines = [f"Made by `{command}`.", "", f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(_cell(row[name]) for name in names) + " |" for row in rows]
    (results / "calibration.md").write_text("\n".join(lines) + "\n")


def _cell(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) and value != int(value) else str(value)


if __name__ == "__main__":
    main()
