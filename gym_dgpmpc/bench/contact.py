"""The contact study: how deep Gaussian processes of several depths and kernels predict a cart that hits its rail's end.

A run trains a model on a case of `contact_data.py`, rolls it out open-loop beside the truth, and writes scores and a
fan of trajectories to one file; `contact_report.py` makes tables and figures of the files.

    python -m gym_dgpmpc.bench.contact run FOLDER --jobs 2
    python -m gym_dgpmpc.bench.contact report FOLDER OUT
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from itertools import product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gym_dgpmpc.bench.contact_data import (
    CASES,
    ContactTest,
    beyond_the_end,
    contact_test,
    find_case,
    training_data,
    training_sequences,
)
from gym_dgpmpc.bench.contact_report import report_contact_study
from gym_dgpmpc.bench.contact_results import (
    QUANTITY,
    ContactKey,
    ContactResult,
    ContactSettings,
    phase_means,
    refuse_other_settings,
)
from gym_dgpmpc.bench.contact_scores import scores
from gym_dgpmpc.bench.executors import executor
from gym_dgpmpc.bench.jobs import Folders, keep
from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.envs.mod_cartpole import ModCartPoleEnv
from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.gp.kernels import KERNELS, check_kernel
from gym_dgpmpc.inference.mcem import InferenceSettings
from gym_dgpmpc.reporting.circumstances import machine, revision, versions
from gym_dgpmpc.types import DynamicsModel

LAYERS, SEEDS = (1, 2, 3), tuple(range(10))

_ANGULAR_VELOCITY = 3


class ContactStudyError(DGPMPCError, RuntimeError):
    """Runs of the study failed; the others are done."""


@dataclass(frozen=True)
class ContactRun:
    """A `Job`: one piece of the study's work, which depends on its key and the settings alone."""

    key: ContactKey
    settings: ContactSettings

    @property
    def name(self) -> str:
        """On one line, for a person."""
        case, kernel, num_layers, seed = self.key
        return f"contact study, case {case} | {kernel}, L={num_layers} | seed {seed}"

    @property
    def file_name(self) -> str:
        """Of the result."""
        return self.key.file_name

    def is_finished(self, results: Path) -> bool:
        """Whether the folder holds the result.

        Raises:
            ResultError: the file is damaged, or of a study with other settings.
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


def run_contact_study(
    folder: Path,
    cases: Sequence[str] = tuple(CASES),
    kernels: Sequence[str] = KERNELS,
    layers: Sequence[int] = LAYERS,
    seeds: Sequence[int] = SEEDS,
    jobs: int = 1,
    settings: ContactSettings | None = None,
) -> list[Path]:
    """Do all runs whose files are not in ``folder`` yet, and return the files of all.

    It does not matter how often a study was interrupted, nor on how many processes it ran.

    Args:
        folder: one file for each run, and the log of each that failed; made if there is none.
        cases: names of `CASES`.
        kernels: names of `KERNELS`.
        layers: numbers of layers.
        seeds: of data, training and test.
        jobs: processes of one thread each that work at the same time; 1 works in this process.
        settings: of training and test; those of the published study if none are given.

    Raises:
        ValueError: a case, kernel or number is none.
        ResultError: the folder holds a damaged file, or one of a study with other settings.
        ContactStudyError: some runs failed; all others are done.
    """
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1, received {jobs}")
    runs = contact_runs(cases, kernels, layers, seeds, settings or ContactSettings())
    missing = [run for run in runs if not run.is_finished(folder)]
    folders, failures = Folders(folder.resolve(), folder.resolve()), []
    for run, outcome in executor(jobs)(missing, folders):
        keep(run, outcome, folders.results)
        if outcome.content is None:
            failures.append(f"{run.name}: {outcome.told}")
    if failures:
        raise ContactStudyError(f"{len(failures)} of {len(missing)} runs failed: {'; '.join(failures)}")
    return [folder / run.file_name for run in runs]


def contact_runs(
    cases: Sequence[str], kernels: Sequence[str], layers: Sequence[int], seeds: Sequence[int], settings: ContactSettings
) -> list[ContactRun]:
    """The runs of a study, seeds outermost: an interrupted one has all settings with some of the seeds.

    Raises:
        ValueError: a case, kernel or number is none.
    """
    for name in cases:
        find_case(name)
    for kernel in kernels:
        check_kernel(kernel)
    if any(number < 1 for number in layers) or any(seed < 0 for seed in seeds):
        raise ValueError(f"layers must be at least 1 and seeds at least 0, received {list(layers)} and {list(seeds)}")
    combinations = product(seeds, cases, kernels, layers)
    return [ContactRun(ContactKey(name, kernel, layer, seed), settings) for seed, name, kernel, layer in combinations]


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
        kernel=key.kernel,
        num_inducing=settings.num_inducing,
        # The paper's law: candidates of one plan are drawn jointly, but each start of a test stands for itself.
        draw="marginal",
        first_iterations=settings.first_iterations,
        num_samples=settings.num_samples,
        sample_spacing=settings.sample_spacing,
        inference=InferenceSettings(patience=settings.patience),
        dtype=torch.float64,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line: `run` does what is missing, `report` makes tables and figures of what there is."""
    parser = argparse.ArgumentParser(prog="python -m gym_dgpmpc.bench.contact", description=__doc__.split("\n\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="do all runs whose files are not in FOLDER yet")
    run.add_argument("folder", type=Path)
    run.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    run.add_argument("--kernels", nargs="+", default=list(KERNELS), choices=list(KERNELS))
    run.add_argument("--layers", nargs="+", type=int, default=list(LAYERS))
    run.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    run.add_argument("--jobs", type=int, default=1, help="processes of one thread each")
    report = commands.add_parser("report", help="make tables and figures of the files in FOLDER")
    report.add_argument("folder", type=Path)
    report.add_argument("out", type=Path)
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        if given.command == "report":
            written = report_contact_study(given.folder, given.out)
        else:
            written = run_contact_study(given.folder, given.cases, given.kernels, given.layers, given.seeds, given.jobs)
    except (DGPMPCError, ValueError) as error:
        sys.exit(str(error))
    print(f"{written[0]} and {len(written) - 1} other files")


if __name__ == "__main__":
    main()
