"""The result file of a run of the contact study: the model, and how well it predicted.

`study.py` writes these files, `report.py` reads them.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.result_files import ResultError, read_file
from gym_dgpmpc.checkpoints.files import replace_text

SCHEMA = 1

QUANTITIES = ("position", "angle", "velocity", "angular velocity", "change of angular velocity")
"""What is predicted and scored: the state, and the change of its last number in a step, which the paper plots."""

QUANTITY = "angular velocity"
"""The quantity whose scores are reported in full."""

UNITS = ("m", "rad", "m/s", "rad/s", "rad/s")

PHASES = ("before", "after")
"""Steps that end before the true cart has been beyond the end of the rail, and all later ones."""

_FILES = "contact_*_seed*.json"

StepScores = Mapping[str, Mapping[str, Mapping[str, list[float | None]]]]
"""quantity -> phase -> score -> mean over the test's starts at each step; None where no start is in that phase."""


class ContactKey(NamedTuple):
    """Identifies a run; there is one file for each key."""

    case: str
    kernel: str
    num_layers: int
    seed: int

    @property
    def task(self) -> str:
        """The name of the case on the command line."""
        return f"case {self.case}"

    @property
    def method(self) -> str:
        """The name of the model on the command line."""
        return f"DGP L={self.num_layers} {self.kernel}"

    @property
    def file_name(self) -> str:
        return f"contact_{self.case}_{self.kernel}_L{self.num_layers}_seed{self.seed}.json"


@dataclass(frozen=True)
class ContactSettings:
    """How models are trained and tested; the same for all runs of a study.

    Attributes:
        num_inducing: M, inducing points per layer.
        first_iterations: training iterations, at most.
        patience: of early stopping; None trains to the end. See `InferenceSettings`.
        num_samples: posterior samples of the inducing outputs.
        sample_spacing: SG-HMC steps between two of them.
        num_particles: P, trajectories from each start of the test.
        num_starts: K, starts of the test.
        num_paths: trajectories from the mean start that are kept for the figure.
    """

    num_inducing: int = 200
    first_iterations: int = 1000
    patience: int | None = None
    num_samples: int = 50
    sample_spacing: int = 10
    num_particles: int = 199
    num_starts: int = 20
    num_paths: int = 40


@dataclass(frozen=True)
class ContactResult:
    """What a run found, and with what.

    Attributes:
        key: case, kernel, layers and seed.
        settings: of training and test.
        training_contact: share of the training sequences in which the cart went beyond the end of the rail.
        test_contact: the same of the test's true trajectories.
        scores: see `StepScores`.
        counts: phase -> number of starts in it at each step.
        paths: change of the angular velocity in each step along sampled trajectories from the mean start, [n, H].
        truth: the same of the true trajectory, [H].
        training: what `DeepGPDynamics.fit` reported.
        fit_seconds: CPU time of training.
        test_seconds: CPU time of the test.
        facts: revision, versions, machine and when the run started.
    """

    key: ContactKey
    settings: ContactSettings
    training_contact: float
    test_contact: float
    scores: StepScores
    counts: Mapping[str, list[int]]
    paths: list[list[float]]
    truth: list[float]
    training: Mapping[str, float]
    fit_seconds: float
    test_seconds: float
    facts: Mapping[str, Any]

    def mean(self, quantity: str, score: str, phase: str | None = None) -> float:
        """The mean of a score over all steps and starts, or those of a phase; NaN where there are none."""
        steps = self.by_step(quantity, score, phase)
        weights = np.sum([self.counts[p] for p in ([phase] if phase else PHASES)], axis=0)
        return float(np.average(steps[weights > 0], weights=weights[weights > 0])) if weights.any() else float("nan")

    def by_step(self, quantity: str, score: str, phase: str | None = None) -> Float[ndarray, " H"]:
        """The mean over the starts at each step, of both phases or of one; NaN where there are none."""
        phases = [phase] if phase else list(PHASES)
        values = np.array([self.scores[quantity][p][score] for p in phases], dtype=np.float64)
        weights = np.array([self.counts[p] for p in phases], dtype=np.float64)
        with np.errstate(invalid="ignore"):
            return (np.where(weights > 0, values, 0.0) * weights).sum(0) / weights.sum(0)

    def write(self, folder: Path) -> Path:
        """Write the file of this run in ``folder``, whole or not at all.

        Raises:
            ValueError: a number is not finite.
            OSError: it cannot be written.
        """
        content = {"schema": SCHEMA, **asdict(self), "key": self.key._asdict()}
        path = folder / self.key.file_name
        replace_text(path, json.dumps(_rounded(content), allow_nan=False) + "\n")
        return path

    @classmethod
    def read(cls, path: Path) -> "ContactResult":
        """The result in a file.

        Raises:
            ResultError: the file is not a result of the study, or has another schema.
            OSError: it cannot be read.
        """

        def parse(content: dict[str, Any]) -> ContactResult:
            key, settings = ContactKey(**content.pop("key")), ContactSettings(**content.pop("settings"))
            return cls(key=key, settings=settings, **content)

        return read_file(path, SCHEMA, parse, "a result of the contact study")


def holds_contact_study(folder: Path) -> bool:
    """Whether a folder has results of the study, rather than of runs."""
    return any(folder.glob(_FILES))


def read_contact_results(folder: Path) -> list[ContactResult]:
    """All results in a folder, in the order of their names.

    Raises:
        ResultError: a file is damaged, there are no files, or they belong to several studies.
    """
    results = [ContactResult.read(path) for path in sorted(folder.glob(_FILES))]
    if not results:
        raise ResultError(f"{folder} has no results of the contact study: expected files {_FILES}")
    for result in results:
        refuse_other_settings(result, results[0].settings, folder)
    return results


def refuse_other_settings(result: ContactResult, settings: ContactSettings, folder: Path) -> None:
    """Check the settings of a result: runs that were trained or tested in different ways are not compared.

    Raises:
        ResultError: the result has other settings; the message names them.
    """
    differing = [
        f"{field.name} {getattr(result.settings, field.name)} instead of {getattr(settings, field.name)}"
        for field in fields(settings)
        if getattr(result.settings, field.name) != getattr(settings, field.name)
    ]
    if differing:
        raise ResultError(
            f"{folder / result.key.file_name} belongs to a study with other settings: {', '.join(differing)}"
        )


def phase_means(
    scores: Mapping[str, Float[ndarray, "H K Q"]], in_contact: Float[ndarray, "H K"] | ndarray
) -> tuple[StepScores, dict[str, list[int]]]:
    """Means over the starts in each phase, and how many these are: ``scores`` and ``counts`` of a result."""
    masks = {"before": ~in_contact, "after": in_contact}
    counts = {phase: [int(n) for n in mask.sum(axis=1)] for phase, mask in masks.items()}

    def means(values: Float[ndarray, "H K"], mask: ndarray) -> list[float | None]:
        return [float(row[chosen].mean()) if chosen.any() else None for row, chosen in zip(values, mask, strict=True)]

    by_quantity = {
        quantity: {
            phase: {name: means(values[..., index], mask) for name, values in scores.items()}
            for phase, mask in masks.items()
        }
        for index, quantity in enumerate(QUANTITIES)
    }
    return by_quantity, counts


def _rounded(value: Any) -> Any:
    """Numbers to six figures, which is more than a Monte Carlo estimate has, in half the room."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, (list, tuple)) else value
