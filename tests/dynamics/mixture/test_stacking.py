"""Stacking weights: closed forms, a grid, and what the first-order condition of the concave maximum says."""

import math

import pytest
import torch

from gym_dgpmpc.dynamics.mixture.stacking import PRIOR, stacking_weights
from tests.oracles.models import normal, seeded


def objective(weights, log_density):
    """Of each row of weights "G M"."""
    mixed = (weights @ log_density.exp().mT).log().sum(-1)
    return mixed + PRIOR * weights.log().sum(-1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_weights_are_the_grids_optimum(seed):
    """A concave function's maximum lies next to that of its values on a grid."""
    log_density = 2.0 * normal(seeded(seed), 40, 2)
    first = torch.arange(1, 20_000, dtype=torch.float64) / 20_000
    best = first[objective(torch.stack([first, 1 - first], -1), log_density).argmax()]
    found = stacking_weights(log_density)
    assert abs(float(found[0] - best)) <= 1 / 20_000
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("num_models", [1, 2, 3, 6])
def test_all_weights_are_equally_worth_changing(num_models):
    """Every derivative is the multiplier of the constraint, n + M PRIOR: the weights' own sum of w_m times it."""
    log_density = 3.0 * normal(seeded(num_models), 100, num_models)
    weights = stacking_weights(log_density).requires_grad_()
    objective(weights, log_density).backward()
    multiplier = torch.full_like(weights, 100 + PRIOR * num_models)
    torch.testing.assert_close(weights.grad, multiplier, rtol=1e-6, atol=0)


def test_models_that_are_right_in_turn_share_by_how_often():
    """Where only one has a density, w_m is the number of its points, with those of the prior, of all."""
    log_density = torch.full((30, 2), -math.inf, dtype=torch.float64)
    log_density[:24, 0] = log_density[24:, 1] = -5.0
    expected = torch.tensor([24 + PRIOR, 6 + PRIOR], dtype=torch.float64) / (30 + 2 * PRIOR)
    torch.testing.assert_close(stacking_weights(log_density), expected, rtol=1e-9, atol=0)


def test_without_a_point_that_tells_all_are_equal():
    nothing = torch.empty(0, 3, dtype=torch.float64)
    equal = torch.full((3,), 1 / 3, dtype=torch.float64)
    torch.testing.assert_close(stacking_weights(nothing), equal)
    torch.testing.assert_close(stacking_weights(torch.full((7, 3), -20.0, dtype=torch.float64)), equal)


def test_points_and_densities_that_are_not_finite_say_nothing_but_zero():
    log_density = 2.0 * normal(seeded(), 20, 2)
    useless = torch.tensor([[-math.inf, -math.inf], [math.nan, math.nan], [math.inf, 0.0]], dtype=torch.float64)
    zero, nan = log_density.clone(), log_density.clone()
    zero[3, 0], nan[3, 0] = -math.inf, math.nan
    assert torch.equal(stacking_weights(torch.cat([log_density, useless])), stacking_weights(log_density))
    assert torch.equal(stacking_weights(nan), stacking_weights(zero))
    assert stacking_weights(zero)[0] < stacking_weights(log_density)[0] or log_density[3, 0] < log_density[3, 1] - 30


def test_a_factor_that_all_models_have_changes_nothing():
    """Densities of many numbers are far beyond what a float holds."""
    log_density, factor = 2.0 * normal(seeded(), 50, 3), 2000.0 * normal(seeded(1), 50, 1)
    torch.testing.assert_close(stacking_weights(log_density + factor), stacking_weights(log_density))
