"""Numbers from result files: what a run earned by a number of steps, and which runs can be compared with which."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks import paper
from benchmarks.result_files import Episode, ResultError, RunResult, read_results
from benchmarks.tasks import TASKS

OURS = "DGP-MPC"
"""What the names of the package's own method begin with; its settings follow."""

CEILING = "true dynamics"
"""The method that every other is measured against: the same planner with the simulator as its model."""

PEERS = (
    "PETS TSinf",
    "PETS TSinf to its optimum",
    "PETS TS1",
    "GP-MM",
    "GP-MM with noise",
    "GP-DS",
    "GP-DS with noise",
    "SAC",
    "TD3",
    "CrossQ",
    "TQC",
    "PPO",
)
"""The methods of the comparison in the order of legends; others come after them."""

NEAR = 0.9
"""How much of the way from random actions to the ceiling counts as having learned, where no threshold is known."""

Runs = Mapping[str, Sequence[RunResult]]
"""The runs of one task by method, in the order of their seeds."""


class Threshold(NamedTuple):
    """A return that counts as having learned a task."""

    value: float
    origin: str
    is_scaled: bool = False
    """Whether it was worked out from the runs themselves, as a share of the way to the ceiling."""


def load_runs(folder: Path) -> dict[str, dict[str, list[RunResult]]]:
    """All runs of a folder by task and method; the paper's tasks come first, in its order, then the others by name.

    Raises:
        ResultError: a file is damaged or holds what no run can have done, there are no files, or there is no folder.
    """
    if not folder.is_dir():
        raise ResultError(f"expected a folder of result files, but there is no folder {folder}")
    study: dict[str, dict[str, list[RunResult]]] = {}
    for result in read_results(folder):
        _check(result, folder / result.key.file_name)
        study.setdefault(result.key.task, {}).setdefault(result.key.method, []).append(result)
    first = [*paper.EPISODES]
    return dict(sorted(study.items(), key=lambda item: first.index(item[0]) if item[0] in first else len(first)))


def setting_of(method: str) -> tuple[str, int] | None:
    """Kernel and layers of "DGP-MPC L=2 matern32"; None for any other name, one with further settings included."""
    match = re.fullmatch(rf"{OURS} L=(\d+) (\w+)", method)
    return (match[2], int(match[1])) if match else None


def reference_of(study: Mapping[str, Runs], preferred: str | None = None) -> dict[str, str]:
    """Which setting of the package's own method stands for it, by task; tasks without it are left out.

    It is ``preferred`` where the task has it. Otherwise it is the setting with the most tasks, then the most runs,
    the most layers and the first name, among those that the task has: a rule that does not look at returns.

    Raises:
        ValueError: the preferred method is not a setting of the package's own, or no task has it.
    """
    candidates = {task: [method for method in methods if method.startswith(OURS)] for task, methods in study.items()}
    known = sorted(set().union(*candidates.values()))
    if preferred is not None and preferred not in known:
        raise ValueError(
            f"expected a setting of {OURS} that has runs as the reference ({', '.join(known) or 'there is none'}), "
            f"got {preferred!r}"
        )

    def rank(method: str) -> tuple[bool, int, int, int, str]:
        tasks = [methods[method] for methods in study.values() if method in methods]
        setting = setting_of(method)
        layers = setting[1] if setting else 0
        return (method != preferred, -len(tasks), -sum(map(len, tasks)), -layers, method)

    return {task: min(methods, key=rank) for task, methods in candidates.items() if methods}


def compared(methods: Iterable[str], reference: str | None) -> list[str]:
    """The reference and every method that is neither another setting of the package's own nor the ceiling."""
    others = [method for method in methods if not method.startswith(OURS) and method not in (CEILING, reference)]
    others.sort(key=lambda method: (PEERS.index(method) if method in PEERS else len(PEERS), method))
    return ([reference] if reference else []) + others


def ranked(runs: Runs) -> list[str]:
    """The methods of a task, the highest mean return at equal steps first, those without one then, the ceiling last."""
    steps = common_steps(runs)
    means = {method: mean_returns(results, steps).mean() for method, results in runs.items()}
    return sorted(runs, key=lambda method: (method == CEILING, math.isnan(means[method]), -means[method], method))


def common_steps(runs: Runs) -> int:
    """The environment steps that every run of a task has, its ceiling's aside: what methods are compared at.

    Where there is nothing but the ceiling, its own.
    """
    counted = [result for method, results in runs.items() if method != CEILING for result in results]
    return min(result.episodes[-1].total_steps for result in counted or runs[CEILING])


def until(result: RunResult, steps: float = math.inf) -> list[Episode]:
    """The counted episodes that ended within ``steps`` environment steps of the run."""
    return [episode for episode in result.counted if episode.total_steps <= steps]


def mean_returns(results: Iterable[RunResult], steps: float = math.inf) -> Float[ndarray, " n"]:
    """Each run's average return over the episodes within ``steps``; NaN for a run without one."""
    return _each(results, steps, lambda returns: float(np.mean(returns)))


def best_returns(results: Iterable[RunResult], steps: float = math.inf) -> Float[ndarray, " n"]:
    """Each run's maximum seen return within ``steps``; NaN for a run without an episode by then."""
    return _each(results, steps, max)


def first_returns(results: Iterable[RunResult], episodes: int) -> Float[ndarray, " n"]:
    """Each run's average return over its first counted episodes, or over all of them if they are fewer."""
    return np.array([np.mean([e.episode_return for e in result.counted[:episodes]]) for result in results])


def success_rates(results: Iterable[RunResult], steps: float = math.inf) -> Float[ndarray, " n"] | None:
    """Each run's share of successful episodes within ``steps``; None where a run or an episode does not say."""
    answers = [[episode.success for episode in until(result, steps)] for result in results]
    if not answers or any(not run or any(answer is None for answer in run) for run in answers):
        return None
    return np.array([np.mean([bool(answer) for answer in run]) for run in answers])


def steps_until(result: RunResult, threshold: float) -> tuple[int, bool]:
    """Environment steps at the end of the first counted episode that reached a return, or those of the run; which."""
    for episode in result.counted:
        if episode.episode_return >= threshold:
            return episode.total_steps, True
    return result.episodes[-1].total_steps, False


def random_return(runs: Runs) -> float | None:
    """The mean return of a task's random episodes, of all its runs; None if there was none."""
    returns = [
        episode.episode_return
        for results in runs.values()
        for result in results
        for episode in result.episodes
        if episode.actions == "random"
    ]
    return float(np.mean(returns)) if returns else None


def ceiling_return(runs: Runs) -> float | None:
    """What the planner with the true dynamics earns in an episode, on average over its runs; None without any."""
    return float(mean_returns(runs[CEILING]).mean()) if CEILING in runs else None


def scale_of(task: str, runs: Runs) -> tuple[float, float] | None:
    """The returns that count as 0 and as 1: of random actions and of the ceiling; None unless both are known.

    Where a task has an ``idle_return``, that of doing nothing counts as 0.
    """
    idle = TASKS[task].idle_return if task in TASKS else None
    low, high = random_return(runs) if idle is None else idle, ceiling_return(runs)
    return None if low is None or high is None or high <= low else (low, high)


def threshold_of(task: str, runs: Runs, given: Mapping[str, float]) -> Threshold | None:
    """The return that counts as having learned a task, from the first of the sources that has one; None if none has.

    The sources are what the user gave, the paper's best average, the task's registration with Gymnasium, and a share
    of the way from random actions to the ceiling.
    """
    if task in given:
        return Threshold(given[task], "as given")
    if task in paper.AVERAGE_RETURN:
        best = max(cell.mean for cell in paper.AVERAGE_RETURN[task].values())
        return Threshold(best, "the best average of the paper's table")
    try:
        registered = gymnasium.spec(task).reward_threshold
    except gymnasium.error.Error:  # a task that was changed, or of a package that is not imported
        registered = None
    if registered is not None:
        return Threshold(float(registered), "its reward threshold in Gymnasium")
    scale = scale_of(task, runs)
    if scale is None:
        return None
    origin = f"{NEAR:.0%} of the way from random actions to the ceiling"
    return Threshold(scale[0] + NEAR * (scale[1] - scale[0]), origin, is_scaled=True)


def _each(
    results: Iterable[RunResult], steps: float, statistic: Callable[[Sequence[float]], float]
) -> Float[ndarray, " n"]:
    returns = [[episode.episode_return for episode in until(result, steps)] for result in results]
    return np.array([statistic(run) if run else math.nan for run in returns], dtype=np.float64)


def _check(result: RunResult, path: Path) -> None:
    """Refuse by name what would make statistics meaningless."""

    def refuse(why: str) -> None:
        raise ResultError(f"{path} cannot be reported: {why}")

    steps = 0
    for number, episode in enumerate(result.episodes, start=1):
        what = f"episode {number}"
        if episode.actions not in ("random", "planned", "policy"):
            refuse(f"{what} has actions {episode.actions!r}, expected 'random', 'planned' or 'policy'")
        for name in ("episode_return", "seconds"):
            if not _is_number(getattr(episode, name)):
                refuse(f"{what} has {name} {getattr(episode, name)!r}, expected a finite number")
        for name in ("cpu_seconds", "training_iterations"):
            if (value := getattr(episode, name)) is not None and not _is_number(value):
                refuse(f"{what} has {name} {value!r}, expected a finite number or null")
        if not (type(episode.steps) is int and type(episode.total_steps) is int and episode.steps > 0):
            refuse(f"{what} has steps {episode.steps!r} of {episode.total_steps!r}, expected positive integers")
        if episode.total_steps < max(steps, episode.steps):
            refuse(f"{what} of {episode.steps} steps ends at step {episode.total_steps}, the one before at {steps}")
        if episode.success not in (True, False, None):
            refuse(f"{what} has success {episode.success!r}, expected true, false or null")
        steps = episode.total_steps
    if not result.counted:
        refuse("it has no episode but those of random actions")
    per_action = result.milliseconds_per_action
    if per_action is not None and not _is_number(per_action):
        refuse(f"its milliseconds_per_action are {per_action!r}, expected a finite number or null")
    for name in ("settings", "versions", "machine"):
        if not isinstance(getattr(result, name), dict):
            refuse(f"its {name} are {getattr(result, name)!r}, expected names and values")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
