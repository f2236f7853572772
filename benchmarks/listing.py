"""Which jobs of a suite are finished, which are left, and how long these may take."""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.jobs import Folders, Job
from benchmarks.result_files import RunResult
from benchmarks.run import Run
from gym_dgpmpc.errors import DGPMPCError


class Line(NamedTuple):
    """The state of one job."""

    job: Job
    state: str
    """"finished", "to do", "4 of 15 episodes", or the error in its file."""
    is_finished: bool
    seconds_left: float | None
    """For one process, estimated from finished runs of the same method on the same task; None without any."""


def survey(jobs: Sequence[Job], folders: Folders) -> list[Line]:
    """The state of each job."""
    pace = seconds_per_step(folders.results)
    return [_line(job, folders, pace) for job in jobs]


def seconds_per_step(results: Path) -> dict[tuple[str, str], float]:
    """Wall-clock seconds of an environment step, training included, by (method, task): the median over the seeds."""
    paces: dict[tuple[str, str], list[float]] = {}
    for path in sorted(results.glob("*_seed*.json")):
        try:
            result = RunResult.read(path)
        except DGPMPCError:
            continue  # the line of that run reports it
        steps = sum(episode.steps for episode in result.counted)
        if steps:
            seconds = sum(episode.seconds for episode in result.counted)
            paces.setdefault((result.key.method, result.key.task), []).append(seconds / steps)
    return {key: statistics.median(values) for key, values in paces.items()}


def _line(job: Job, folders: Folders, pace: dict[tuple[str, str], float]) -> Line:
    try:
        if job.is_finished(folders.results):
            return Line(job, "finished", True, 0.0)
        steps = job.steps_wanted(folders.results) if isinstance(job, Run) else 0
    except DGPMPCError as error:
        return Line(job, f"cannot be done: {error}", False, None)
    if not isinstance(job, Run):
        return Line(job, "to do", False, None)
    done = job.episodes_so_far(folders.work)
    state = f"{done} of {job.episodes} episodes" if done else "to do"
    seconds = pace.get((job.method, job.task.name))
    if seconds is None:
        return Line(job, state, False, None)
    return Line(job, state, False, seconds * (steps - done * job.task.episode_steps))


def summary(lines: Sequence[Line]) -> str:
    """The number of jobs, how many are left, and the machine time that these may take."""
    left = [line for line in lines if not line.is_finished]
    text = f"{len(lines)} jobs: {len(lines) - len(left)} finished, {len(left)} left"
    known = [line.seconds_left for line in left if line.seconds_left is not None]
    if known:
        text += f"; about {hours(sum(known))} of one process"
        text += f" for {len(known)} of them" if len(known) < len(left) else ""
    unknown = len(left) - len(known)
    return text + (f"; no estimate for {unknown} of them" if unknown else "")


def hours(seconds: float) -> str:
    """A duration in hours, or in minutes below one hour."""
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.0f} min"
