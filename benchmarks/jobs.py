"""Jobs: pieces of work that leave one result file each, and how one is executed.

Light to import, so that a process that executes a job loads what that job needs and nothing else.
"""

import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

from gym_dgpmpc.errors import DGPMPCError


class Folders(NamedTuple):
    """Folders that jobs write to, as absolute paths."""

    results: Path
    """One file per job, of all suites."""
    work: Path
    """The state of unfinished jobs, which they continue from."""


@runtime_checkable
class Job(Protocol):
    """One piece of work. It can be pickled, for it may be executed in another process or on another machine."""

    @property
    def name(self) -> str:
        """Shown to the user, on one line."""

    @property
    def file_name(self) -> str:
        """Name of its result in the folder of results."""

    def is_finished(self, results: Path) -> bool:
        """Whether the result is there already.

        Raises:
            DGPMPCError: the file of this name is not a result of this job.
        """

    def perform(self, folders: Folders) -> str:
        """Do the work, or what is left of it, and write the result, whole or not at all.

        Returns:
            A summary in a few words.

        Raises:
            Exception: the job failed. Then there is no result.
        """


class Outcome(NamedTuple):
    """How a job ended."""

    message: str
    """The summary of a job that succeeded, or the error of one that failed, on one line."""
    content: str | None = None
    """The result; None if the job failed."""
    failure: str | None = None
    """The traceback of a job that failed; None of any other."""


def failed(error: BaseException) -> Outcome:
    """The outcome of a job that was ended by an exception."""
    text = " ".join(str(error).split())
    return Outcome(f"{type(error).__name__}: {text}"[:500], failure="".join(traceback.format_exception(error)))


def execute(job: Job, folders: Folders) -> Outcome:
    """Do a job on one thread, unless it is finished. A failure is an outcome, not an exception."""
    import torch  # which takes seconds to import

    # As many jobs run beside each other as there are cores, and sums do not depend on how many these are.
    torch.set_num_threads(1)
    try:
        path = folders.results / job.file_name
        message = "finished already" if job.is_finished(folders.results) else job.perform(folders)
        return Outcome(message, path.read_text())
    except Exception as error:
        return failed(error)


def refusal(job: Job, results: Path) -> Outcome | None:
    """The outcome of a job that must not be done because its file is not its result; None if it may be done."""
    try:
        job.is_finished(results)
    except DGPMPCError as error:
        return failed(error)
    return None


def log_of(job: Job, results: Path) -> Path:
    """Where the failure of a job is kept."""
    return (results / job.file_name).with_suffix(".log")


def keep(job: Job, outcome: Outcome, results: Path) -> None:
    """Write the result of a job that was done in another machine's folder, or the log of a failure.

    Raises:
        OSError: it cannot be written.
    """
    from gym_dgpmpc.checkpoints.files import replace_text  # which takes seconds to import

    path, log = results / job.file_name, log_of(job, results)
    if outcome.content is None:
        replace_text(log, outcome.failure or outcome.message)
        return
    if not path.exists() or path.read_text() != outcome.content:
        replace_text(path, outcome.content)
    log.unlink(missing_ok=True)


def unfinished(jobs: Sequence[Job], results: Path) -> list[Job]:
    """The jobs that are left to do, in their order; one whose file is not its result is among them, and will fail."""

    def is_left(job: Job) -> bool:
        try:
            return not job.is_finished(results)
        except DGPMPCError:
            return True

    return [job for job in jobs if is_left(job)]
