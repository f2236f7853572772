"""The contact study: how deep Gaussian processes of several depths and kernels predict a cart that hits its rail's end.

A run trains a model on a case of `data.py`, rolls it out open-loop beside the truth, and writes scores and a fan of
trajectories to one file; `report.py` makes tables and figures of the files. The study is the suite `contact` of
`dgpmpc bench`.
"""

import time
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from benchmarks.contact.data import (
    ContactTest,
    beyond_the_end,
    contact_test,
    training_data,
    training_sequences,
)
from benchmarks.contact.result_files import (
    QUANTITY,
    ContactKey,
    ContactResult,
    ContactSettings,
    phase_means,
    refuse_other_settings,
)
from benchmarks.contact.scores import scores
from benchmarks.jobs import Folders
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.envs.mod_cartpole import ModCartPoleEnv
from gym_dgpmpc.gp.kernels import KernelName
from gym_dgpmpc.runs.provenance import machine, revision, versions
from gym_dgpmpc.types import DynamicsModel

_ANGULAR_VELOCITY = 3


@dataclass(frozen=True)
class ContactRun:
    """A `Job`: one piece of the study's work, which depends on its key and the settings alone."""

    key: ContactKey
    settings: ContactSettings

    @property
    def name(self) -> str:
        """Shown to the user, on one line."""
        return f"{self.key.task} | {self.key.method} | seed {self.key.seed}"

    @property
    def file_name(self) -> str:
        """Name of the result file."""
        return self.key.file_name

    def is_finished(self, results: Path) -> bool:
        """Whether the folder holds the result.

        Raises:
            ResultError: the file is damaged, or belongs to a study with other settings.
        """
        path = results / self.file_name
        if not path.exists():
            return False
        refuse_other_settings(ContactResult.read(path), self.settings, results)
        return True

    def perform(self, folders: Folders) -> str:
        """Measure and write.

        Raises:
            TrainingError: training diverged however small its steps.
            OSError: the result cannot be written.
        """
        result = self.measure()
        result.write(folders.results)
        return f"CRPS {result.mean(QUANTITY, 'crps'):.3f} rad/s, {result.fit_seconds:.0f} s of training"

    def measure(self) -> ContactResult:
        """Train, roll out, score.

        Raises:
            TrainingError: training diverged however small its steps.
        """
        key, settings = self.key, self.settings
        started = datetime.now(timezone.utc).isoformat(timespec="seconds")
        generator = torch.Generator().manual_seed(key.seed)
        model = _model(key, settings)
        since = time.process_time()
        training = model.fit(training_data(key.case, key.seed), generator)
        fitted = time.process_time()
        test = contact_test(key.case, key.seed, settings.num_starts)
        particles = open_loop(model, test, settings.num_particles, generator)
        predicted, observed = quantities(particles), quantities(test.states)
        step_scores, counts = phase_means(scores(predicted.swapaxes(0, 1), observed), test.in_contact)
        sequences, _ = training_sequences(key.case, key.seed)
        return ContactResult(
            key=key,
            settings=settings,
            training_contact=float(beyond_the_end(sequences[:, 1:]).any(axis=1).mean()),
            test_contact=float(test.in_contact[-1].mean()),
            scores=step_scores,
            counts=counts,
            paths=predicted[:, : settings.num_paths, 0, -1].T.tolist(),
            truth=observed[:, 0, -1].tolist(),
            training=dict(training),
            fit_seconds=fitted - since,
            test_seconds=time.process_time() - fitted,
            facts={"started": started, "revision": revision(), "versions": versions(), "machine": machine()},
        )


def open_loop(
    model: DynamicsModel, test: ContactTest, num_particles: int, generator: torch.Generator
) -> Float[ndarray, "H_plus_1 P K S"]:
    """States of P particles from each of the test's starts, each step predicted from the particle's last state."""
    horizon, starts = len(test.states) - 1, torch.from_numpy(test.states[0])
    action = torch.from_numpy(test.action)
    sampler = model.draw(num_particles, horizon, generator)
    states = [starts.expand(num_particles, -1, -1).contiguous()]
    for step in range(horizon):
        states.append(sampler(states[-1], action, step))
    return torch.stack(states).numpy()


def quantities(states: Float[ndarray, "H_plus_1 *b 4"]) -> Float[ndarray, "H *b 5"]:
    """`QUANTITIES` after each step."""
    change = np.diff(states[..., _ANGULAR_VELOCITY], axis=0)
    return np.concatenate([states[1:], change[..., None]], axis=-1)


def _model(key: ContactKey, settings: ContactSettings) -> DeepGPDynamics:
    return DeepGPDynamics(
        4,
        1,
        ModCartPoleEnv().observation_spec,
        num_layers=key.num_layers,
        kernel=cast(KernelName, key.kernel),
        num_inducing=settings.num_inducing,
        # The paper's law: candidates of one plan are drawn jointly, but each start of a test stands for itself.
        draw="marginal",
        first_training_iterations=settings.first_iterations,
        num_samples=settings.num_samples,
        sample_spacing=settings.sample_spacing,
        patience=settings.patience,
        dtype=torch.float64,
    )
