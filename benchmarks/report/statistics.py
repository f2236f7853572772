"""Estimates with intervals from a few runs: means, probabilities of improvement, times with censoring.

After Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (NeurIPS 2021), by means of
SciPy: the samples that `scipy.stats.bootstrap` resamples one by one are the strata. An interval says what other seeds
would have given; it is a percentile interval and never leaves the range of the runs, so that with n runs of a method it
misses a symmetric distribution's mean with a probability of 2^(1-n) at least.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 10_000
SEED = 0
"""Seed of the resampling: the same runs give the same interval, whatever else is in a report."""

TRIMMED = 0.25
"""Share that the interquartile mean leaves out at each end."""

Strata = Sequence[Float[ndarray, " _"]]
"""One sample per task: a number for each run."""


class Estimate(NamedTuple):
    """A number and its interval; no interval where a stratum has a single run."""

    value: float
    low: float | None = None
    high: float | None = None


class Passage(NamedTuple):
    """How long runs took to reach something that some of them may never have reached."""

    median: float | None
    """Kaplan-Meier estimate; None if the runs end before half of them can be said to have arrived."""
    reached: int
    runs: int
    longest: float
    """The longest that a run took or was watched."""


def mean(strata: Strata) -> Estimate:
    """The mean over tasks of the mean over runs, with a stratified bootstrap interval."""
    return _estimate(strata, _mean)


def iqm(strata: Strata) -> Estimate:
    """The interquartile mean of all runs of all tasks together, with a stratified bootstrap interval.

    A quarter of the runs is left out at each end, rounded down: of three or fewer runs none, and it is their mean.
    """
    return _estimate(strata, _iqm)


def probability_of_improvement(x: Strata, y: Strata) -> Estimate:
    """P(X > Y) + P(X = Y) / 2 for a run X of one method and Y of another on the same task, averaged over the tasks.

    The Mann-Whitney statistic over the number of pairs, with an interval from resampling each method's runs.

    Args:
        x, y: one sample for each task, in the same order of tasks.

    Raises:
        ValueError: the numbers of tasks differ.
    """
    if len(x) != len(y):
        raise ValueError(f"samples of the same tasks are compared, got {len(x)} and {len(y)}")
    return _estimate([*x, *y], _improvement)


def mean_band(values: Float[ndarray, "n T"]) -> tuple[Float[ndarray, " T"], Float[ndarray, " T"]] | None:
    """The bootstrap interval of the mean over n runs at each of T times, whole runs resampled; None for one run."""
    if len(values) < 2:
        return None
    # Batches bound the memory: resamples x runs x times.
    low, high = _interval((values,), lambda sample, axis: sample.mean(axis), axis=0, batch=500)
    return low, high


def difference_p_value(x: Float[ndarray, " n"], y: Float[ndarray, " m"]) -> float:
    """Two-sided Mann-Whitney test that runs of two methods are alike: exact without ties, else by its normal limit."""
    return float(stats.mannwhitneyu(x, y, method="auto").pvalue)


def time_to_reach(times: Sequence[float], reached: Sequence[bool]) -> Passage:
    """Kaplan and Meier's median of times of which some are only known to be longer than the run.

    Args:
        times: when a run arrived, or when it ended without.
        reached: whether it arrived.

    Raises:
        ValueError: there is no run, or not one answer for each.
    """
    if not len(times) or len(times) != len(reached):
        raise ValueError(f"a time and an answer for each of at least one run, got {len(times)} and {len(reached)}")
    arrived = np.asarray(reached, dtype=bool)
    at = np.asarray(times, dtype=np.float64)
    median = None
    if arrived.any():
        survival = stats.ecdf(stats.CensoredData(uncensored=at[arrived], right=at[~arrived])).sf
        halved = survival.probabilities <= 0.5 + 1e-12  # a product of fractions, rounded
        median = float(survival.quantiles[halved][0]) if halved.any() else None
    return Passage(median, int(arrived.sum()), len(at), float(at.max()))


def _mean(*strata: ndarray, axis: int) -> ndarray:
    return np.asarray(np.mean([sample.mean(axis) for sample in strata], axis=0))


def _iqm(*strata: ndarray, axis: int) -> ndarray:
    return np.asarray(stats.trim_mean(np.concatenate(strata, axis), TRIMMED, axis))


def _improvement(*strata: ndarray, axis: int) -> ndarray:
    """P(X > Y) + P(X = Y) / 2; the first half of the samples are X's tasks, the others Y's."""
    wins = []
    for x, y in zip(strata[: len(strata) // 2], strata[len(strata) // 2 :], strict=True):
        first, second = np.moveaxis(x, axis, -1)[..., :, None], np.moveaxis(y, axis, -1)[..., None, :]
        wins.append(((first > second) + 0.5 * (first == second)).mean((-2, -1)))
    return np.asarray(np.mean(wins, axis=0))


def _estimate(strata: Strata, statistic: Callable[..., ndarray]) -> Estimate:
    if not strata or not all(len(sample) for sample in strata):
        raise ValueError(f"an estimate needs runs of each task, got {[len(sample) for sample in strata]}")
    value = float(statistic(*strata, axis=-1))
    if min(map(len, strata)) < 2:
        return Estimate(value)
    low, high = _interval(tuple(strata), statistic, axis=-1)
    return Estimate(value, float(low), float(high))


def _interval(
    samples: tuple[ndarray, ...], statistic: Callable[..., ndarray], axis: int, batch: int | None = None
) -> tuple[ndarray, ndarray]:
    interval = stats.bootstrap(
        samples,
        statistic,
        axis=axis,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=batch,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=SEED,
    ).confidence_interval
    return np.asarray(interval.low), np.asarray(interval.high)
