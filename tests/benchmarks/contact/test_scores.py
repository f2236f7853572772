"""Scores of particles against closed forms of the normal distribution, brute force, and counting."""

import math

import numpy as np
import pytest
from scipy import stats

from benchmarks.contact.scores import LEVELS, SCORES, crps, gaussian_nlpd, inside, scores


def normal_crps(observed, mean=0.0, std=1.0):
    """Gneiting and Raftery 2007, equation 21, with the sign of a loss."""
    z = (observed - mean) / std
    return std * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / math.sqrt(math.pi))


def test_crps_of_many_particles_is_that_of_their_distribution():
    count, mean, std = 100_000, -1.0, 2.0
    particles = np.random.default_rng(0).normal(mean, std, count)
    observed = np.array([-6.0, -1.0, 0.3, 9.0])
    found = crps(np.repeat(particles[:, None], 4, axis=1), observed)
    # Each of the two means of absolute differences has a standard error below std / sqrt(P).
    np.testing.assert_allclose(found, normal_crps(observed, mean, std), rtol=0, atol=5 * 2 * std / math.sqrt(count))


def test_crps_of_few_particles_is_right_on_average():
    """Without the correction for P = 3 it would be too large by E|X - X'| / 6 = 0.19."""
    repeats, observed = 40_000, 0.7
    found = crps(np.random.default_rng(1).normal(size=(3, repeats)), np.full(repeats, observed))
    assert abs(found.mean() - normal_crps(observed)) < 5 * found.std() / math.sqrt(repeats)


def test_crps_is_the_mean_over_all_pairs():
    rng = np.random.default_rng(2)
    particles, observed = rng.normal(size=(7, 2, 3)), rng.normal(size=(2, 3))
    pairs = np.abs(particles[:, None] - particles[None]).sum(axis=(0, 1)) / (7 * 6)
    expected = np.abs(particles - observed).mean(axis=0) - pairs / 2
    np.testing.assert_allclose(crps(particles, observed), expected, rtol=1e-12)


def test_nlpd_is_that_of_the_normal_distribution_with_the_particles_moments():
    rng = np.random.default_rng(3)
    particles, observed = rng.exponential(size=(50, 4)), rng.normal(size=4)
    expected = -stats.norm.logpdf(observed, particles.mean(axis=0), particles.std(axis=0, ddof=1))
    np.testing.assert_allclose(gaussian_nlpd(particles, observed), expected, rtol=1e-12)


def test_particles_that_agree_are_not_infinitely_sure():
    assert np.isfinite(gaussian_nlpd(np.ones((5, 1)), np.array([1.1]))).all()


@pytest.mark.parametrize("level", LEVELS)
def test_an_interval_holds_exactly_its_share_of_the_ranks(level):
    """One observation in each of the 200 gaps between, below and above 199 particles, in any order."""
    particles = np.random.default_rng(4).permutation(199).astype(float)
    observed = np.arange(-0.5, 199)
    found = inside(np.repeat(particles[:, None], 200, axis=1), observed, level)
    assert found.mean() == pytest.approx(level, abs=1e-12)
    assert (found == found[::-1]).all()


def test_few_particles_have_intervals_too():
    assert inside(np.array([[0.0], [1.0]]), np.array([0.5]), 0.95).all()
    assert not inside(np.array([[0.0], [1.0]]), np.array([1.5]), 0.5).any()


def test_all_scores_are_made_at_once():
    rng = np.random.default_rng(5)
    particles, observed = rng.normal(size=(20, 3, 2)), rng.normal(size=(3, 2))
    found = scores(particles, observed)
    assert tuple(found) == SCORES == ("nlpd", "crps", "inside_50", "inside_90", "inside_95")
    np.testing.assert_array_equal(found["crps"], crps(particles, observed))
    np.testing.assert_array_equal(found["inside_90"], inside(particles, observed, 0.9))


def test_what_cannot_be_scored_is_refused():
    with pytest.raises(ValueError, match="1"):
        scores(np.zeros((1, 3)), np.zeros(3))
    with pytest.raises(ValueError, match="must be finite"):
        scores(np.array([[0.0], [np.nan]]), np.zeros(1))
    with pytest.raises(ValueError, match="must be finite"):
        scores(np.zeros((2, 1)), np.full(1, np.inf))
