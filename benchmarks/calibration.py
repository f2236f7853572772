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
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.inference.mcem import InferenceSettings
from gym_dgpmpc.types import DynamicsModel, Transitions

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


def random_episode(env: gymnasium.Env, seed: int, smoothing: float) -> Transitions:
    """An episode under actions that are uniform (``smoothing`` 0) or follow a bounded autoregression."""
    rng, rows = np.random.default_rng(seed), []
    low, high = env.action_space.low, env.action_space.high
    observation, _ = env.reset(seed=seed)
    level, done = (low + high) / 2, False
    while not done:
        noise = rng.normal(0, 0.2 * (high - low)) if smoothing else rng.uniform(low, high)
        level = np.clip(smoothing * level + noise, low, high)
        after, _, terminated, truncated, _ = env.step(level.astype(np.float32))
        rows.append((observation, level, after))
        observation, done = after, terminated or truncated
    return Transitions(*(torch.as_tensor(np.array(column), dtype=torch.float32) for column in zip(*rows, strict=True)))


def score(
    model: DynamicsModel,
    tests: list[Transitions],
    horizon: int,
    generator: torch.Generator,
    spread: Float[Tensor, " S"] | float = 1.0,
) -> dict[str, float]:
    """How well H-step predictions fit, averaged over tests, starts and dimensions.

    Returns:
        ``error``: root mean square of that of the particles' mean, in units of ``spread``; ``coverage_90``: how often
        the truth lies in the 90 % interval; ``nll``: negative log likelihood. The last two are Gaussian in the
        particles' moments.
    """
    covered, likelihood, squared = [], [], []
    for test in tests:
        start = torch.arange(0, len(test.action) - horizon, 5)
        sampler = model.draw(NUM_PARTICLES, horizon, generator)
        state = test.observation[start].expand(NUM_PARTICLES, -1, -1).contiguous()
        for step in range(horizon):
            state = sampler(state, test.action[start + step], step)
        mean, std = state.mean(0), state.std(0).clamp_min(1e-4)
        error = test.next_observation[start + horizon - 1] - mean
        squared.append((error / spread).square().mean(0))
        covered.append((error.abs() < NORMAL_90 * std).float().mean())
        likelihood.append((0.5 * (error / std).square() + std.log() + 0.5 * np.log(2 * np.pi)).mean())
    return {
        "coverage_90": float(torch.stack(covered).mean()),
        "nll": float(torch.stack(likelihood).mean()),
        "error": float(torch.stack(squared).mean(0).sqrt().mean()),
    }


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
    metrics = model.fit(random_episode(env, seed, 0.0), generator)
    row = {"variant": variant, "seed": seed, "cpu_seconds": time.process_time() - started}
    row["iterations"] = metrics["iterations"]
    tests = [random_episode(env, test_seed, 0.8) for test_seed in TEST_SEEDS]
    for horizon in (1, 15):
        scores = score(model, tests, horizon, generator)
        row |= {f"{name}_{horizon}": scores[name] for name in ("coverage_90", "nll")}
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
    for setting in wanted:
        if setting not in done:
            rows.append(measure(*setting, arguments))
            write_rows(rows, "calibration", ENVIRONMENT, arguments.results)
    print((arguments.results / "calibration.md").read_text())


def write_rows(rows: list[dict[str, Any]], name: str, environment: str, results: Path) -> None:
    """All rows so far, raw and as a table, of the benchmark of that name."""
    results.mkdir(parents=True, exist_ok=True)
    command = f"python -m benchmarks.{name} {' '.join(sys.argv[1:])}".strip()
    facts = {"command": command, "environment": environment, "torch": torch.__version__, "rows": rows}
    (results / f"{name}.json").write_text(json.dumps(facts, indent=2) + "\n")
    names = list(rows[0])
    lines = [f"Made by `{command}`.", "", f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(_cell(row[name]) for name in names) + " |" for row in rows]
    (results / f"{name}.md").write_text("\n".join(lines) + "\n")


def _cell(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) and value != int(value) else str(value)


if __name__ == "__main__":
    main()
