"""How well a model trained on one random episode knows what it does not know: `python -m benchmarks.calibration`.

Trains on the modified cart-pole in several ways, and tests H-step predictions on episodes of smoother random actions,
which go elsewhere. Writes `calibration.md` and `calibration.json`; what is in the latter already, with the same
settings, is not done again.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks import RESULTS
from benchmarks.rows import Row, measure_missing
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.types import DynamicsModel, Transitions

VARIANTS: dict[str, dict[str, Any]] = {
    # SG-HMC alone gets five times the steps between samples.
    "SG-HMC alone": {"sample_spacing": 50, "gibbs_every": 0},
    "exact draws of the last layer (default)": {},
    "hyperparameters every 2nd step": {"hyperparameters_every": 2},
    "hyperparameters every 4th step": {"hyperparameters_every": 4},
    "half the iterations": {"first_training_iterations": 2000},
    "stopped early, patience 5": {"patience": 5},
}
"""Ways of training, as arguments of `DeepGPDynamics`."""

SETTINGS = argparse.ArgumentParser(add_help=False)
SETTINGS.add_argument("--layers", type=int, default=2)
SETTINGS.add_argument("--kernel", default="matern32")

ENVIRONMENT, TEST_SEEDS, NUM_PARTICLES, NORMAL_90 = "ModCartPole-v0", range(5000, 5004), 100, 1.645


def random_episode(env: gymnasium.Env, seed: int, smoothing: float) -> Transitions:
    """An episode under actions that are uniform (``smoothing`` 0) or follow a bounded autoregression."""
    rng, rows = np.random.default_rng(seed), []
    assert isinstance(env.action_space, gymnasium.spaces.Box)
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


def measure(wanted: Row) -> Row:
    """One model on one random episode."""
    variant, seed = VARIANTS[wanted["variant"]], wanted["seed"]
    env, generator = gymnasium.make(ENVIRONMENT), torch.Generator().manual_seed(seed)
    model = DeepGPDynamics(
        4, 1, env.get_wrapper_attr("observation_spec"), num_layers=wanted["layers"], kernel=wanted["kernel"],
        **variant,
    )  # fmt: skip
    started = time.process_time()
    metrics = model.fit(random_episode(env, seed, 0.0), generator)
    row = {"cpu_seconds": time.process_time() - started, "iterations": metrics["iterations"]}
    tests = [random_episode(env, test_seed, 0.8) for test_seed in TEST_SEEDS]
    for horizon in (1, 15):
        scores = score(model, tests, horizon, generator)
        row |= {f"{name}_{horizon}": scores[name] for name in ("coverage_90", "nll")}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration", description=__doc__, parents=[SETTINGS])
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101])
    parser.add_argument("--results", type=Path, default=RESULTS / "calibration")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = {"layers": arguments.layers, "kernel": arguments.kernel}
    wanted = [settings | {"variant": variant, "seed": seed} for variant in VARIANTS for seed in arguments.seeds]
    print(measure_missing("calibration", arguments.results, wanted, measure, SETTINGS))


if __name__ == "__main__":
    main()
