"""What the benchmarks are made of: pieces of work that leave one result file each, and how one is carried out.

Light to import, so that a process that carries out a job loads what that job needs and nothing else.
"""

import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

from gym_dgpmpc.errors import DGPMPCError


class Folders(NamedTuple):
    """Where jobs leave what they make, as absolute paths."""

    results: Path
    """One file per job, of all suites."""
    work: Path
    """What unfinished jobs go on from."""


@runtime_checkable
class Job(Protocol):
    """One piece of work. It can be pickled, for it may be carried out in another process or on another machine."""

    @property
    def name(self) -> str:
        """On one line, for a person."""

    @property
    def file_name(self) -> str:
        """Of its result, in the folder of results."""

    def is_finished(self, results: Path) -> bool:
        """Whether the result is there already.

        Raises:
            DGPMPCError: there is a file of this name that is the result of something else.
        """

    def perform(self, folders: Folders) -> str:
        """Do the work, or what is left of it, write the result, whole or not at all, and say in a few words how it was.

        Raises:
            Exception: it failed. There is no result then.
        """


class Outcome(NamedTuple):
    """How a job ended."""

    told: str
    """What it said of itself, or in one line what was wrong."""
    content: str | None = None
    """Its result, None if it failed."""
    failure: str | None = None
    """Where and why it failed, in full; None if it did not."""


def failed(error: BaseException) -> Outcome:
    """The outcome of a job that was ended by an exception."""
    text = " ".join(str(error).split())
    return Outcome(f"{type(error).__name__}: {text}"[:500], failure="".join(traceback.format_exception(error)))


def carry_out(job: Job, folders: Folders) -> Outcome:
    """Do a job on one thread, unless it is finished; no failure of it is an exception."""
    import torch  # which takes seconds to import

    # As many jobs run beside each other as there are cores, and sums do not depend on how many these are.
    torch.set_num_threads(1)
    try:
        path = folders.results / job.file_name
        told = "finished already" if job.is_finished(folders.results) else job.perform(folders)
        return Outcome(told, path.read_text())
    except Exception as error:
        return failed(error)


def refusal(job: Job, results: Path) -> Outcome | None:
    """The outcome of a job that must not be done because its file is something else's; None if it may be done."""
    try:
        job.is_finished(results)
    except DGPMPCError as error:
        return failed(error)
    return None


def log_of(job: Job, results: Path) -> Path:
    """Where the failure of a job is kept."""
    return (results / job.file_name).with_suffix(".log")


def keep(job: Job, outcome: Outcome, results: Path) -> None:
    """Leave the result of a job in the folder, if another machine's folder has it, or the log of its failure.

    Raises:
        OSError: it cannot be written.
    """
    from gym_dgpmpc.checkpoints.files import replace_text  # which takes seconds to import

    path, log = results / job.file_name, log_of(job, results)
    if outcome.content is None:
        replace_text(log, outcome.failure or outcome.told)
        return
    if not path.exists() or path.read_text() != outcome.content:
        replace_text(path, outcome.content)
    log.unlink(missing_ok=True)


def unfinished(jobs: Sequence[Job], results: Path) -> list[Job]:
    """Those that are left to do, in their order; one whose file is something else's is among them, to fail."""

    def is_left(job: Job) -> bool:
        try:
            return not job.is_finished(results)
        except DGPMPCError:
            return True

    return [job for job in jobs if is_left(job)]
