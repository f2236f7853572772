"""Effective sample size and R-hat on chains whose mixing is known."""

import math

import numpy as np
import pytest
import scipy.signal
import scipy.stats
import torch

from gym_dgpmpc.inference.diagnostics import effective_sample_size, rank_normalised_r_hat, split_r_hat


def autoregression(rho, length, num_chains, seed=0):
    """Stationary x[t+1] = rho x[t] + sqrt(1 - rho^2) noise."""
    noise = np.random.default_rng(seed).standard_normal((length, num_chains)) * math.sqrt(1 - rho**2)
    noise[0] /= math.sqrt(1 - rho**2)
    return torch.from_numpy(scipy.signal.lfilter([1.0], [1.0, -rho], noise, axis=0))


@pytest.mark.parametrize("rho", [-0.5, 0.0, 0.5, 0.9])
def test_the_effective_size_of_an_autoregression(rho):
    """The autocorrelation time is (1 + rho) / (1 - rho); the mean over 200 chains knows it to a few per cent."""
    length = 4001  # odd, so that the last lag has no partner
    effective = effective_sample_size(autoregression(rho, length, 200))
    assert effective.mean().item() == pytest.approx(length * (1 - rho) / (1 + rho), rel=0.08)


def test_scale_and_offset_do_not_matter():
    chain = autoregression(0.7, 500, 3)
    moved = 1e-4 * chain + 1e3
    torch.testing.assert_close(effective_sample_size(moved), effective_sample_size(chain), rtol=1e-5, atol=0)
    torch.testing.assert_close(split_r_hat(moved), split_r_hat(chain), rtol=1e-5, atol=0)


def test_a_coordinate_that_does_not_move_has_no_effective_samples():
    chain = autoregression(0.0, 100, 2)
    chain[:, 1] = 3.0
    effective = effective_sample_size(chain)
    assert effective[0] > 20
    assert effective[1] == 0.0
    assert split_r_hat(chain)[1] == 1.0


@pytest.mark.parametrize("length", [1, 2, 3])
def test_the_shortest_chains_have_an_effective_size(length):
    effective = effective_sample_size(autoregression(0.0, length, 5))
    assert effective.shape == (5,)
    assert effective.isfinite().all()


@pytest.mark.parametrize("length", [2000, 2001])
def test_r_hat_of_a_stationary_chain_is_one(length):
    r_hat = split_r_hat(autoregression(0.5, length, 50))
    # Half the squared difference of the halves' means, in units of the variance: about tau / (n / 2) on average.
    assert (r_hat - 1.0).abs().mean() < 2 * 3 / length
    assert (r_hat - 1.0).abs().max() < 20 * 3 / length


def test_r_hat_of_halves_that_disagree():
    """Halves three standard deviations apart: between / n = 9 / 2 beside a variance of 1 within."""
    chain = autoregression(0.0, 20_000, 4)
    chain[10_000:] += 3.0
    torch.testing.assert_close(split_r_hat(chain), torch.full((4,), math.sqrt(5.5)).double(), rtol=0.05, atol=0)


def test_halves_at_rest_in_different_places_disagree():
    chain = torch.zeros(10, 1, dtype=torch.float64)
    chain[5:] = 1.0
    assert split_r_hat(chain).item() == math.inf


@pytest.mark.parametrize("length", [0, 3])
def test_r_hat_of_too_few_samples_is_an_error(length):
    with pytest.raises(ValueError, match=rf"\b4 samples.* {length}$"):
        split_r_hat(torch.zeros(length, 2))


def ranked_r_hat(chain):
    """Vehtari et al. 2021, equations 3, 4 and 14, chain by chain with SciPy's ranks."""
    half = len(chain) // 2
    halves = np.stack([chain[:half], chain[-half:]])

    def r_hat(values):
        z = scipy.stats.norm.ppf((scipy.stats.rankdata(values).reshape(values.shape) - 3 / 8) / (values.size + 1 / 4))
        within, between = z.var(1, ddof=1).mean(), half * z.mean(1).var(ddof=1)
        return np.sqrt(((half - 1) / half * within + between / half) / within)

    return max(r_hat(halves), r_hat(np.abs(halves - np.median(halves))))


@pytest.mark.parametrize("length", [6, 7, 40, 41])
def test_rank_normalised_r_hat(length):
    """Of a mixing chain, one that drifts, one with Cauchy's tails, one with two values, and one that grows wider."""
    chain = autoregression(0.5, length, 5, seed=1).numpy()
    chain[:, 1] += np.linspace(0, 3, length)
    chain[:, 2] = np.tan(np.pi * (scipy.stats.norm.cdf(chain[:, 2]) - 0.5))
    chain[:, 3] = np.arange(length) % 3 == 0
    chain[:, 4] *= np.linspace(0.1, 5, length)
    found = rank_normalised_r_hat(torch.from_numpy(chain))
    np.testing.assert_allclose(found, [ranked_r_hat(column) for column in chain.T], rtol=1e-9)


def test_ranks_see_what_moments_do_not():
    """A chain that grows wider has halves of one mean; one at rest agrees with itself."""
    chain = autoregression(0.0, 1000, 2)
    chain[500:, 0] *= 5
    chain[:, 1] = 2.0
    assert split_r_hat(chain)[0] < 1.02 and rank_normalised_r_hat(chain)[0] > 1.2
    assert rank_normalised_r_hat(chain)[1] == 1.0
