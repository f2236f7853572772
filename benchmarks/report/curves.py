"""Learning curves over runs: what the methods had earned by a number of steps or by a time."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.report.statistics import mean_band
from benchmarks.result_files import RunResult

Clock = Literal["steps", "minutes"]
"""Environment steps, or wall-clock time since the run's start; both include the random episodes and all training."""

Earned = Literal["return", "best"]
"""An episode's return, or the maximum seen so far."""

MOST_POINTS = 60
"""A longer run is smoothed: each point is the mean of as many latest episodes as leave this many points apart."""


class Curve(NamedTuple):
    """The mean over n runs wherever all of them have something to show."""

    at: Float[ndarray, " T"]
    mean: Float[ndarray, " T"]
    band: tuple[Float[ndarray, " T"], Float[ndarray, " T"]] | None
    """Bootstrap interval of the mean; None of a single run."""


def curve(results: Sequence[RunResult], clock: Clock, earned: Earned) -> Curve:
    """The mean over runs, at each end of an episode of any of them, of what each had earned by then.

    It begins where every run has ended a counted episode and ends where the first of them ends, so that at every point
    it is the mean of the same runs; empty if the one comes after the other.
    """
    lines = [line(result, clock, earned) for result in results]
    begin, end = max(at[0] for at, _ in lines), min(at[-1] for at, _ in lines)
    grid = np.unique(np.concatenate([at for at, _ in lines]))
    grid = _thin(grid[(begin <= grid) & (grid <= end)])
    # What a run had earned at a time is known from its last episode that had ended by then.
    values = np.array([known[np.searchsorted(at, grid, side="right") - 1] for at, known in lines])
    return Curve(grid, values.mean(0), mean_band(values) if grid.size else None)


def line(result: RunResult, clock: Clock, earned: Earned) -> tuple[Float[ndarray, " E"], Float[ndarray, " E"]]:
    """When each counted episode of one run ended, and what had been earned by then."""
    seconds = np.cumsum([episode.seconds for episode in result.episodes])
    ends = zip(result.episodes, seconds, strict=True)
    at = [e.total_steps if clock == "steps" else passed / 60 for e, passed in ends if e.actions != "random"]
    returns = np.array([episode.episode_return for episode in result.counted], dtype=np.float64)
    earned_by_then = np.maximum.accumulate(returns) if earned == "best" else _latest_mean(returns)
    return np.array(at, dtype=np.float64), earned_by_then


def _latest_mean(returns: Float[ndarray, " E"]) -> Float[ndarray, " E"]:
    """The mean of the latest few values at each point, of as many as there are at the beginning."""
    width = -(-len(returns) // MOST_POINTS)
    sums = np.concatenate([[0.0], np.cumsum(returns)])
    until = np.arange(1, len(returns) + 1)
    since = np.maximum(until - width, 0)
    return (sums[until] - sums[since]) / (until - since)


def _thin(grid: Float[ndarray, " T"]) -> Float[ndarray, " kept"]:
    """At most some 150 points, denser at the beginning, where most is learned; the first and the last among them."""
    if len(grid) <= 150:
        return grid
    picked = np.unique(np.round(np.geomspace(1, len(grid), 200)).astype(int)) - 1
    return grid[picked]
