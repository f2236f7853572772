"""Estimates against exact answers: every resample enumerated, textbook survival data, closed forms."""

from itertools import product
from math import sqrt

import numpy as np
import pytest
from scipy import stats

from benchmarks.report.statistics import (
    CONFIDENCE,
    RESAMPLES,
    Estimate,
    difference_p_value,
    iqm,
    mean,
    mean_band,
    probability_of_improvement,
    time_to_reach,
)

TAIL = (1 - CONFIDENCE) / 2
FIVE_DEVIATIONS = 5 * sqrt(TAIL * (1 - TAIL) / RESAMPLES)
"""How far the share of finitely many resamples beyond a quantile may be from the quantile's probability."""

FIRST, SECOND = np.array([0.1, 1.7, 2.9, 7.3]), np.array([5.03, -2.11, 0.57])


def all_resamples(sample):
    return [np.array(choice) for choice in product(sample, repeat=len(sample))]


def assert_quantiles(estimate: Estimate, exact: np.ndarray):
    """Both ends cut off the right share of the exact distribution, which has atoms."""
    for end, tail in ((estimate.low, TAIL), (estimate.high, 1 - TAIL)):
        assert np.mean(exact < end - 1e-9) <= tail + FIVE_DEVIATIONS
        assert np.mean(exact <= end + 1e-9) >= tail - FIVE_DEVIATIONS


def interquartile(values):
    """By sorting: a quarter, rounded down, off each end."""
    cut = len(values) // 4
    return np.sort(values)[cut : len(values) - cut].mean()


def test_mean():
    estimate = mean([FIRST])
    assert estimate.value == pytest.approx(3.0)
    assert_quantiles(estimate, np.array([resample.mean() for resample in all_resamples(FIRST)]))


def test_mean_of_strata_weighs_tasks_alike_and_resamples_each():
    estimate = mean([FIRST, SECOND])
    assert estimate.value == pytest.approx((FIRST.mean() + SECOND.mean()) / 2)
    pairs = product(all_resamples(FIRST), all_resamples(SECOND))
    assert_quantiles(estimate, np.array([(a.mean() + b.mean()) / 2 for a, b in pairs]))


def test_iqm():
    assert iqm([np.array([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -900.0])]).value == pytest.approx(3.5)
    estimate = iqm([FIRST])
    assert estimate.value == pytest.approx((1.7 + 2.9) / 2)
    assert_quantiles(estimate, np.array([interquartile(resample) for resample in all_resamples(FIRST)]))


def test_iqm_of_strata_is_of_all_runs_together():
    estimate = iqm([FIRST, SECOND])
    assert estimate.value == pytest.approx(interquartile(np.concatenate([FIRST, SECOND])))
    pairs = product(all_resamples(FIRST), all_resamples(SECOND))
    assert_quantiles(estimate, np.array([interquartile(np.concatenate(pair)) for pair in pairs]))


def test_probability_of_improvement():
    x, y = np.array([1.0, 3.0, 5.0]), np.array([0.0, 3.0, 4.0])
    estimate = probability_of_improvement([x], [y])
    assert estimate.value == pytest.approx((1 + 1.5 + 3) / 9)  # the pair of threes counts a half
    assert estimate.value == pytest.approx(stats.mannwhitneyu(x, y).statistic / 9)
    exact = [
        np.mean([(a > b) + 0.5 * (a == b) for a in first for b in second])
        for first, second in product(all_resamples(x), all_resamples(y))
    ]
    assert_quantiles(estimate, np.array(exact))


def test_probability_of_improvement_over_tasks():
    x = [np.array([1.0, 2.0]), np.array([3.0, 4.0, 5.0])]
    y = [np.array([0.0, 0.5]), np.array([4.5, 6.0])]
    estimate = probability_of_improvement(x, y)
    assert estimate.value == pytest.approx((1 + 1 / 6) / 2)
    reverse = probability_of_improvement(y, x)
    assert reverse.value == pytest.approx(1 - estimate.value)


def test_with_up_to_three_runs_the_interval_is_their_range():
    # All resampled alike has a probability of 1/27, or more, at each end: more than the tail that is cut off.
    for values in ([4.0, -1.0], [2.0, 9.0, 4.0]):
        estimate = mean([np.array(values)])
        assert (estimate.low, estimate.high) == (min(values), max(values))


def test_one_run_in_a_stratum_gives_no_interval():
    assert mean([np.array([2.0])]) == Estimate(2.0)
    assert iqm([FIRST, np.array([1.0])]).low is None
    assert probability_of_improvement([FIRST], [np.array([1.0])]) == Estimate(0.75)


def test_the_same_runs_give_the_same_interval_wherever_they_stand():
    alone = mean([FIRST])
    iqm([SECOND])
    assert mean([FIRST]) == alone


def test_nothing_to_estimate_from():
    with pytest.raises(ValueError, match=r"\[3, 0\]"):
        mean([SECOND, np.array([])])
    with pytest.raises(ValueError, match="1 and 2"):
        probability_of_improvement([FIRST], [FIRST, SECOND])


def test_band_is_the_interval_at_each_time():
    values = np.stack([FIRST, 2 * FIRST - 5], axis=1)
    low, high = mean_band(values)
    exact = np.array([resample.mean() for resample in all_resamples(FIRST)])
    assert_quantiles(Estimate(0.0, low[0], high[0]), exact)
    # The same runs are drawn for all times, so a curve that is another's image has the image of its band.
    np.testing.assert_allclose(low[1], 2 * low[0] - 5)
    np.testing.assert_allclose(high[1], 2 * high[0] - 5)
    assert mean_band(values[:1]) is None


def test_p_of_no_difference_is_exact():
    # Two of the 20 orders of three and three are as extreme as complete separation.
    assert difference_p_value(np.array([4.0, 5.0, 6.0]), np.array([1.0, 2.0, 3.0])) == pytest.approx(2 / 20)
    assert difference_p_value(np.array([1.0]), np.array([0.0])) == pytest.approx(1.0)


def test_kaplan_meier_on_textbook_data():
    # Weeks of remission with 6-mercaptopurine (Freireich et al. 1963): the median is known to be 23.
    arrived = [6, 6, 6, 7, 10, 13, 16, 22, 23]
    censored = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    passage = time_to_reach([*arrived, *censored], [True] * len(arrived) + [False] * len(censored))
    assert passage == (23.0, 9, 21, 35.0)


@pytest.mark.parametrize(
    ("times", "reached", "median"),
    [
        ([100, 300, 200], [True, True, True], 200),  # as without censoring
        ([100, 200], [True, False], 100),  # half have arrived
        ([100, 200], [False, True], 200),  # nobody knows when the first would have
        ([100, 200, 200], [True, False, False], None),  # a third have arrived
        ([100, 100, 300], [True, False, True], 300),
        ([500, 500], [False, False], None),
    ],
)
def test_median_time_of_a_few_runs(times, reached, median):
    passage = time_to_reach(times, reached)
    assert passage.median == median
    assert (passage.reached, passage.runs, passage.longest) == (sum(reached), len(times), max(times))


def test_times_of_nobody():
    with pytest.raises(ValueError, match="0 and 0"):
        time_to_reach([], [])
    with pytest.raises(ValueError, match="2 and 1"):
        time_to_reach([1, 2], [True])
