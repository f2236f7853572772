"""Regression on the UCI sets' standard splits: `python -m benchmarks.calibration.uci FOLDER`.

The folder has one file a set, SET.npz with `x` [N, D], `y` [N] and `test` [splits, n], the rows held out of each split.
Inputs and targets are standardised on the training rows; reported are the test log likelihood and the root mean
squared error in raw units, as published results are. Writes `uci.json`, a row for each fit, and `uci.md`, means over
the splits beside what was published; what is in the former already is not fitted again.
"""

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.calibration.models import MODELS
from benchmarks.calibration.tables import with_error
from benchmarks.report import markdown
from benchmarks.rows import Row, made_by, measure_missing
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.runs.provenance import revision
from gym_dgpmpc.settings import settings_of
from gym_dgpmpc.types import ObservationSpec, Transitions

SETS = ("boston", "concrete", "energy", "kin8nm", "power", "wine_red", "yacht")

GP_SETTINGS: dict[str, Any] = {"kernel": "rbf", "num_inducing": 128}
"""Of every Gaussian process."""

PASSES = 128
"""Over the training rows, in minibatches of 256: so many iterations, and no fewer than the class's own."""

PUBLISHED = {
    "SG-HMC, L = 2": {
        "boston": (-2.51, 0.07), "concrete": (-2.89, 0.06), "energy": (-0.37, 0.12), "kin8nm": (1.38, 0.01),
        "power": (-2.68, 0.02),
    },
    "DSVI, L = 2": {
        "boston": (-2.43, 0.05), "concrete": (-3.06, 0.03), "energy": (-0.73, 0.02), "kin8nm": (1.30, 0.01),
        "power": (-2.77, 0.01),
    },
}  # fmt: skip
"""Mean and standard error of the test log likelihood over ten splits, 128 inducing points: Lindinger et al. (2020),
"Beyond the Mean-Field: Structured Deep Gaussian Processes Improve the Predictive Uncertainties", table 1."""


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
    model = MODELS[label](x.shape[1] + 1, 0, spec(x.shape[1]), **settings, **_iterations(label, len(training)))
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
        "revision": revision(),
    }


def _iterations(label: str, num_rows: int) -> dict[str, int]:
    """As many as `PASSES` take, for the models that are trained in minibatches of rows."""
    if not label.startswith("DGP"):
        return {}
    batch_size, least = (settings_of(DeepGPDynamics)[n].default for n in ("batch_size", "first_training_iterations"))
    return {"first_training_iterations": max(least, PASSES * num_rows // batch_size)}


def page(rows: Sequence[Row]) -> str:
    """Test log likelihoods, their means and standard errors over the splits, and what was published."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    cells = []
    for name in (name for name in SETS if any(row["set"] == name for row in rows)):
        of_set = [row for row in rows if row["set"] == name]
        shown = [_scores([row for row in of_set if row["model"] == model]) for model in models]
        cells.append([name, *shown, *(_published(figures.get(name)) for figures in PUBLISHED.values())])
    header = ["set", *(f"{model}: log likelihood; RMSE; z²; splits" for model in models), *PUBLISHED]
    revisions = ", ".join(sorted({str(row["revision"]) for row in rows}))
    return "\n".join([f"{made_by(rows)} Revision {revisions}.", "", *markdown.table(header, cells)]) + "\n"


def _scores(rows: Sequence[Row]) -> str:
    if not rows:
        return markdown.NOTHING
    likelihood = with_error([row["log_likelihood"] for row in rows])
    return (
        f"{likelihood}; {fmean(row['rmse'] for row in rows):.3g}; {fmean(row['z2'] for row in rows):.2f}; {len(rows)}"
    )


def _published(figure: tuple[float, float] | None) -> str:
    return markdown.NOTHING if figure is None else f"{figure[0]:.2f} ± {figure[1]:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.uci", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the sets are")
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
    print(measure_missing("calibration.uci", arguments.results, wanted, partial(measure, arguments.folder), page=page))


if __name__ == "__main__":
    main()
