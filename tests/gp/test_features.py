"""Random Fourier features against the kernel that they stand for."""

import math

import pytest
import scipy.stats
import torch

from gym_dgpmpc.gp.features import draw_features
from gym_dgpmpc.gp.kernels import KERNELS, pairwise_sqdist
from tests.oracles.gaussian_process import MATERN_ORDER
from tests.oracles.models import normal, seeded

NUM_FEATURES = 40_000


@pytest.mark.parametrize("input_size", [1, 3, 24])
@pytest.mark.parametrize("kernel", KERNELS)
def test_products_of_features_estimate_the_kernel(kernel, input_size):
    """The mean of F / 2 terms cos(omega . (x - x')), of variance (1 + k(2 r)) / 2 - k(r)^2 each.

    That is at most 1/2, since all these kernels have k(2 r) <= 2 k(r)^2. With 45 pairs of points five standard errors
    are never reached.
    """
    # Distances from near zero to far out, whatever the dimension.
    radius = torch.linspace(0.0, 2.5, 10, dtype=torch.float64).unsqueeze(1)
    x = radius * torch.nn.functional.normalize(normal(seeded(1), 10, input_size), dim=1)
    phi = draw_features(KERNELS[kernel], 1, NUM_FEATURES, input_size, seeded())(x[None])[0]
    error = phi @ phi.mT - KERNELS[kernel].correlation(pairwise_sqdist(x))
    assert error.abs().max() < 5 / math.sqrt(NUM_FEATURES)


def test_one_scale_is_shared_by_the_dimensions_of_a_frequency():
    """Matern-3/2 at r = (0.6, 0.6, 0.6): 0.463. A scale for each dimension would make the product kernel, 0.375."""
    x = torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.6, 0.6]], dtype=torch.float64)
    phi = draw_features(KERNELS["matern32"], 1, 200_000, 3, seeded())(x[None])[0]
    assert (phi[0] @ phi[1]).item() == pytest.approx(0.463, abs=5 / math.sqrt(200_000))


@pytest.mark.parametrize("input_size", [1, 4])
@pytest.mark.parametrize("kernel", ["rbf", *MATERN_ORDER])
def test_the_length_of_a_frequency_has_the_spectral_law(kernel, input_size):
    """|omega|^2 / D follows F(D, 2 nu), or chi^2 for the RBF; the Kolmogorov bound fails with probability 1e-4."""
    frequency = draw_features(KERNELS[kernel], 1, 40_000, input_size, seeded()).frequency[0]
    square = frequency.square().sum(1).numpy()
    if kernel == "rbf":
        law, value = scipy.stats.chi2(input_size), square
    else:
        law, value = scipy.stats.f(input_size, 2 * MATERN_ORDER[kernel]), square / input_size
    assert scipy.stats.kstest(value, law.cdf).statistic < 2.23 / math.sqrt(len(value))


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_frequency_has_a_cosine_and_a_sine(kernel):
    """So that |phi(x)|^2 = k(0) = 1 for each draw: only distances, and not places, feel the error of the features."""
    features = draw_features(KERNELS[kernel], 3, 10, 2, seeded())
    assert features.frequency.shape == (3, 5, 2)
    x = normal(seeded(1), 3, 7, 2)
    turns = x @ features.frequency.mT
    expected = torch.cat([turns.cos(), turns.sin()], dim=-1) / math.sqrt(5)
    # An argument of some hundred, as the longest frequencies of Matern-1/2 make, is rounded to 1e-14.
    torch.testing.assert_close(features(x), expected, rtol=0, atol=1e-15 * float(10 + turns.abs().max()))
    torch.testing.assert_close(features(x).square().sum(-1), torch.ones(3, 7).double(), rtol=0, atol=1e-13)


def test_draws_have_frequencies_of_their_own():
    """Independent ones: neither repeated nor correlated; each correlation errs by the square root of their number."""
    frequency = draw_features(KERNELS["rbf"], 6, 2 * 4000, 2, seeded()).frequency
    correlation = frequency.transpose(1, 2).flatten(0, 1).corrcoef()
    assert (correlation - torch.eye(12).double()).abs().max() < 5 / math.sqrt(4000)
    # Each draw's estimate of the same covariance errs in its own way, and their mean by the root of their number less.
    x = torch.tensor([[0.0, 0.0], [0.7, 0.4]], dtype=torch.float64).expand(400, -1, -1)
    phi = draw_features(KERNELS["rbf"], 400, 32, 2, seeded())(x)
    estimates = (phi[:, 0] * phi[:, 1]).sum(-1)
    exact = math.exp(-0.5 * (0.7**2 + 0.4**2))
    variance = (1 - exact**2) ** 2 / 2 / 16  # of the mean of 16 cosines, with k(2 r) = k(r)^4
    assert estimates.mean().item() == pytest.approx(exact, abs=5 * math.sqrt(variance / 400))
    assert estimates.var().item() == pytest.approx(variance, rel=5 * math.sqrt(2 / 400))


def test_precision_and_reproducibility():
    first, second = (draw_features(KERNELS["matern52"], 3, 8, 2, seeded(3), torch.float32) for _ in range(2))
    assert first.frequency.dtype == torch.float32
    assert torch.equal(first.frequency, second.frequency)
    assert first(torch.zeros(3, 5, 2)).shape == (3, 5, 8)
