"""Coloured noise against its own law: independent Gaussian Fourier coefficients of power f^-beta."""

import math

import numpy as np
import pytest
import scipy.stats
import torch

from gym_dgpmpc.planning.coloured_noise import coloured_noise
from tests.oracles.models import seeded

COUNT, SIZE = 4000, 2
DRAWS = COUNT * SIZE


def draw(length, beta, dtype=torch.float64, seed=0):
    return coloured_noise((COUNT, length, SIZE), beta, seeded(seed), device="cpu", dtype=dtype)


@pytest.mark.parametrize("beta", [0.0, 0.25, 1.0, 3.0])
@pytest.mark.parametrize("length", [30, 15])
def test_power_falls_with_frequency(length, beta):
    """A mean of n squares of real Gaussians errs by sqrt(2 / n) of itself, and of complex ones by less."""
    noise = draw(length, beta)
    power = np.abs(np.fft.rfft(noise.numpy(), axis=1)) ** 2
    frequency = np.maximum(np.fft.rfftfreq(length), 1 / length)
    law = frequency**-beta
    two_sided = np.full(len(law), 2.0)
    two_sided[[0] if length % 2 else [0, -1]] = 1.0
    law *= length**2 / (two_sided * law).sum()  # of variance one, by Parseval
    assert np.abs(power.mean((0, 2)) / law - 1).max() < 5 * math.sqrt(2 / DRAWS)
    assert np.abs(noise.square().mean((0, 2)).numpy() - 1).max() < 5 * math.sqrt(2 / DRAWS)
    assert scipy.stats.kstest(noise[:, 3].flatten().numpy(), "norm").statistic < 2.23 / math.sqrt(DRAWS)


def test_series_are_independent():
    noise = draw(10, 2.0)
    for one, other in ((noise[:, :, 0], noise[:, :, 1]), (noise[1:, :, 0], noise[:-1, :, 0])):
        assert (one * other).mean(0).abs().max() < 5 / math.sqrt(COUNT - 1)


def test_white_noise_is_what_the_generator_gives():
    noise = draw(7, 0.0, torch.float32)
    assert torch.equal(noise, torch.randn(COUNT, 7, SIZE, generator=seeded()))


@pytest.mark.parametrize("length", [1, 2, 3])
def test_the_shortest(length):
    noise = draw(length, 2.0, torch.float32)
    assert noise.shape == (COUNT, length, SIZE) and noise.dtype == torch.float32
    assert abs(float(noise.square().mean()) - 1) < 5 * math.sqrt(2 / DRAWS)
