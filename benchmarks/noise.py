"""Whether plans know how noisy a plant is: `python -m benchmarks.noise`.

The plant is an autoregression, x' = 0.9 x + a + w, observed as x + e, under actions uniform in [-1, 1]. Each model
learns 220 steps of it; then its 90 % intervals for what will be observed after H steps are tested on fresh episodes:
with draws of the function alone, with all of the fitted noise taken for w (``all``), and with e told apart (``split``).
Writes `noise.md` and `noise.json`; what is in the latter already, with the same settings, is not done again.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.calibration.forecasts import forecast
from benchmarks.rows import Row, measure_missing
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.dynamics.scores import scores
from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics
from gym_dgpmpc.types import DynamicsModel, Transitions

MODELS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "GP": (SparseGPDynamics, {"num_inducing": 30}),
    # An agent trains its networks after each episode; here there is one training.
    "ensemble": (EnsembleDynamics, {"hidden_size": 100, "num_epochs": 50}),
    "deep GP": (DeepGPDynamics, {"num_inducing": 30, "first_training_iterations": 500, "sample_spacing": 5}),
}
"""Smaller and shorter trained than by default, as is enough for a plant so simple."""

NOISES = {"process": (0.2, 0.0), "observation": (0.0, 0.2), "both": (0.2, 0.2)}
"""Standard deviations of w and e."""

DRAWS = {"none": (False, False), "all": (True, False), "split": (True, True)}
"""The settings ``add_noise`` and ``split_noise``."""

SETTINGS = argparse.ArgumentParser(add_help=False)
SETTINGS.add_argument("--steps", type=int, default=220)
SETTINGS.add_argument("--gain", type=float, default=1.0, help="of the action")

DECAY, HORIZONS, TEST_SEEDS = 0.9, (1, 5, 10, 20), range(5000, 5004)


def episode(steps: int, gain: float, process_std: float, observation_std: float, seed: int) -> Transitions:
    """An episode that begins where the plant comes to rest."""
    rng = np.random.default_rng(seed)
    actions, states = rng.uniform(-1, 1, (steps, 1)), np.zeros((steps + 1, 1))
    for step in range(steps):
        states[step + 1] = DECAY * states[step] + gain * actions[step] + process_std * rng.standard_normal(1)
    observed = states + observation_std * rng.standard_normal(states.shape)
    columns = (observed[:-1], actions, observed[1:])
    return Transitions(*(torch.as_tensor(column, dtype=torch.float32) for column in columns))


def coverage(model: DynamicsModel, tests: list[Transitions], generator: torch.Generator) -> dict[int, float]:
    """How often what is observed after H steps lies in the 90 % interval; see `scores`."""
    by_horizon = forecast(model, tests, HORIZONS, generator)
    return {horizon: scores(*ahead)["coverage_90"] for horizon, ahead in by_horizon.items()}


def measure(wanted: Row) -> Row:
    """One model after one episode, with each kind of draw."""
    steps, gain, noise = wanted["steps"], wanted["gain"], NOISES[wanted["noise"]]
    make, settings = MODELS[wanted["model"]]
    model, generator = make(1, 1, add_noise=True, split_noise=True, **settings), torch.Generator()
    fitted = model.fit(episode(steps, gain, *noise, wanted["seed"]), generator.manual_seed(wanted["seed"]))
    unit = model.state_dict().get("targets.std", torch.ones(1)).item()
    row = {f"found_{kind}": fitted[f"{kind}_noise_std"] * unit for kind in ("process", "observation")}
    tests = [episode(steps, gain, *noise, seed) for seed in TEST_SEEDS]
    for draw, (model.add_noise, model.split_noise) in DRAWS.items():
        row |= {f"{draw}_{horizon}": held for horizon, held in coverage(model, tests, generator).items()}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.noise", description=__doc__, parents=[SETTINGS])
    parser.add_argument("--seeds", nargs="+", type=int, default=[100, 101, 102, 103, 104])
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--results", type=Path, default=RESULTS / "noise")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = {"steps": arguments.steps, "gain": arguments.gain}
    wanted = [
        settings | {"model": model, "noise": noise, "seed": seed}
        for model in arguments.models
        for noise in NOISES
        for seed in arguments.seeds
    ]
    print(measure_missing("noise", arguments.results, wanted, measure, SETTINGS))


if __name__ == "__main__":
    main()
