"""Regression on the UCI sets' standard splits: `python -m benchmarks.calibration.uci FOLDER`.

The folder has one file a set, SET.npz with `x` [N, D], `y` [N] and `test` [splits, n], the rows held out of each split.
Inputs and targets are standardised on the training rows; reported are the test log likelihood and the root mean
squared error in raw units, as published results are.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.calibration.models import MODELS
from benchmarks.rows import Row, measure_missing
from gym_dgpmpc.types import ObservationSpec, Transitions

SETS = ("boston", "concrete", "energy", "kin8nm", "power", "wine_red", "yacht")

SETTINGS = argparse.ArgumentParser(add_help=False)
SETTINGS.add_argument("folder", type=Path, help="where the sets are")

GP_SETTINGS: dict[str, Any] = {"kernel": "rbf", "num_inducing": 100}
"""Of every Gaussian process, as in the published comparisons."""


def transitions(x: np.ndarray, y: np.ndarray) -> Transitions:
    """Rows of a regression as transitions: the inputs are constant, the target is the next value of one number more."""
    inputs, target = torch.as_tensor(x, dtype=torch.float64), torch.as_tensor(y, dtype=torch.float64).unsqueeze(1)
    observation = torch.cat([inputs, torch.zeros_like(target)], dim=1)
    action = inputs.new_zeros(len(inputs), 0)
    return Transitions(observation, action, torch.cat([inputs, target], dim=1))


def spec(num_inputs: int) -> ObservationSpec:
    """That reads them so."""
    return ObservationSpec(absolute=(num_inputs,), not_inputs=(num_inputs,), constant=tuple(range(num_inputs)))


def measure(folder: Path, wanted: Row) -> Row:
    """One model on one split of one set."""
    name, split, label = (wanted[key] for key in ("set", "split", "model"))
    with np.load(folder / f"{name}.npz") as file:
        x, y, held_out = file["x"], file["y"], file["test"][split]
    training = np.setdiff1d(np.arange(len(y)), held_out)
    settings = GP_SETTINGS if "PETS" not in label else {}
    model = MODELS[label](x.shape[1] + 1, 0, spec(x.shape[1]), **settings)
    generator, started = torch.Generator().manual_seed(split), time.process_time()
    model.fit(transitions(x[training], y[training]), generator)
    seconds = time.process_time() - started
    predictive = model.predictive(transitions(x[held_out], y[held_out]), generator)
    error = predictive.mean[:, 0].numpy() - y[held_out]
    return {
        "log_likelihood": float(predictive.log_density.mean()),
        "rmse": float(np.sqrt((error**2).mean())),
        "z2": float((error**2 / predictive.variance[:, 0].numpy()).mean()),
        "fit_cpu_seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.calibration.uci", description=__doc__, parents=[SETTINGS]
    )
    parser.add_argument("--sets", nargs="+", default=SETS, choices=SETS)
    parser.add_argument("--splits", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--models", nargs="+", default=["DGP L=1", "DGP L=2", "DGP L=3"], choices=list(MODELS))
    parser.add_argument("--results", type=Path, default=RESULTS / "uci")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    wanted = [
        {"set": name, "split": split, "model": model}
        for split in arguments.splits
        for name in arguments.sets
        for model in arguments.models
    ]
    print(measure_missing("uci", arguments.results, wanted, lambda row: measure(arguments.folder, row), SETTINGS))


if __name__ == "__main__":
    main()
