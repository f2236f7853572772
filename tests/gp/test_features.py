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
    """One term 2 cos(.) cos(.) has a variance of at most 3/2; with 45 pairs five standard errors are never reached."""
    # Distances from near zero to far out, whatever the dimension.
    radius = torch.linspace(0.0, 2.5, 10, dtype=torch.float64).unsqueeze(1)
    x = radius * torch.nn.functional.normalize(normal(seeded(1), 10, input_size), dim=1)
    phi = draw_features(KERNELS[kernel], NUM_FEATURES, input_size, seeded())(x)
    error = phi @ phi.mT - KERNELS[kernel].correlation(pairwise_sqdist(x))
    assert error.abs().max() < 5 * math.sqrt(1.5 / NUM_FEATURES)


def test_one_scale_is_shared_by_the_dimensions_of_a_frequency():
    """Matern-3/2 at r = (0.6, 0.6, 0.6): 0.463. A scale for each dimension would make the product kernel, 0.375."""
    x = torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.6, 0.6]], dtype=torch.float64)
    phi = draw_features(KERNELS["matern32"], 200_000, 3, seeded())(x)
    assert (phi[0] @ phi[1]).item() == pytest.approx(0.463, abs=5 * math.sqrt(1.5 / 200_000))


@pytest.mark.parametrize("input_size", [1, 4])
@pytest.mark.parametrize("kernel", ["rbf", *MATERN_ORDER])
def test_the_length_of_a_frequency_has_the_spectral_law(kernel, input_size):
    """|omega|^2 / D follows F(D, 2 nu), or chi^2 for the RBF; the Kolmogorov bound fails with probability 1e-4."""
    frequency = draw_features(KERNELS[kernel], 20_000, input_size, seeded()).frequency
    square = frequency.square().sum(1).numpy()
    if kernel == "rbf":
        law, value = scipy.stats.chi2(input_size), square
    else:
        law, value = scipy.stats.f(input_size, 2 * MATERN_ORDER[kernel]), square / input_size
    assert scipy.stats.kstest(value, law.cdf).statistic < 2.23 / math.sqrt(len(value))


def test_precision_and_reproducibility():
    first, second = (draw_features(KERNELS["matern52"], 8, 2, seeded(3), dtype=torch.float32) for _ in range(2))
    assert first.frequency.dtype == first.phase.dtype == torch.float32
    assert torch.equal(first.frequency, second.frequency) and torch.equal(first.phase, second.phase)
    assert first(torch.zeros(3, 5, 2)).shape == (3, 5, 8)
