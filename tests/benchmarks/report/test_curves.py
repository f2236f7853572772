"""Learning curves of runs that can be worked out by hand."""

import numpy as np
import pytest

from benchmarks.report.curves import MOST_POINTS, curve, line
from tests.benchmarks.made_up import run


def test_mean_over_runs_of_the_same_steps():
    whole = curve([run("A", [1.0, 3.0], random=-9.0), run("A", [3.0, 7.0], seed=1, random=-9.0)], "steps", "return")
    np.testing.assert_array_equal(whole.at, [200, 300])  # the random episode takes steps and earns nothing
    np.testing.assert_array_equal(whole.mean, [2.0, 5.0])
    np.testing.assert_array_equal(whole.band, [[1.0, 3.0], [3.0, 7.0]])  # of two runs: their range


def test_maximum_seen():
    whole = curve([run("A", [1.0, -3.0, 2.0])], "steps", "best")
    np.testing.assert_array_equal(whole.mean, [1.0, 1.0, 2.0])
    assert whole.band is None


def test_runs_whose_episodes_end_at_different_times():
    first = run("A", [10.0, 20.0, 30.0], steps=[10, 20, 30])  # ends at 10, 30, 60
    second = run("A", [0.0, 100.0], steps=[25, 25], seed=1)  # ends at 25, 50
    whole = curve([first, second], "steps", "return")
    # From where both have an episode to where the first of them ends; each by its latest episode.
    np.testing.assert_array_equal(whole.at, [25, 30, 50])
    np.testing.assert_array_equal(whole.mean, [5.0, 10.0, 60.0])


def test_wall_clock_counts_what_the_random_episode_took():
    at, earned = line(run("A", [1.0, 2.0], random=0.0, seconds=90.0), "minutes", "return")
    np.testing.assert_allclose(at, [3.0, 4.5])
    np.testing.assert_array_equal(earned, [1.0, 2.0])


def test_nothing_is_drawn_where_no_time_is_common_to_all():
    whole = curve([run("A", [1.0], seconds=60.0), run("A", [1.0], seed=1, seconds=600.0)], "minutes", "return")
    assert whole.at.size == whole.mean.size == 0
    assert whole.band is None


@pytest.mark.parametrize(("episodes", "width"), [(MOST_POINTS, 1), (3 * MOST_POINTS - 5, 3)])
def test_long_runs_are_smoothed(episodes, width):
    returns = np.random.default_rng(0).normal(size=episodes)
    _, earned = line(run("A", returns.tolist()), "steps", "return")
    by_hand = [returns[max(0, i + 1 - width) : i + 1].mean() for i in range(episodes)]
    np.testing.assert_allclose(earned, by_hand)


def test_long_curves_keep_their_ends():
    whole = curve([run("A", [0.0] * 1000)], "steps", "return")
    assert 100 <= len(whole.at) <= 200
    assert (whole.at[0], whole.at[1], whole.at[-1]) == (100, 200, 100_000)
