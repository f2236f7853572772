"""MPPI against its closed form: a softmax mean of the candidates, whose limit is known for quadratic returns."""

import math

import numpy as np
import pytest
import scipy.special
import torch

from gym_dgpmpc.planning import MPPI
from gym_dgpmpc.planning.mppi import path_weights
from gym_dgpmpc.planning.sequence import Sequence
from tests.oracles.models import seeded

INF = math.inf


def weights(scores, temperature=1.0, *, standardise=False, cost=0.0):
    given = torch.tensor(scores, dtype=torch.float64)
    return path_weights(given, temperature, standardise=standardise, cost=cost).numpy()


def softmax(x):
    return scipy.special.softmax(np.array(x))


def test_weights_are_a_softmax():
    np.testing.assert_allclose(weights([1.0, 2.0, 4.0], 0.5), softmax([2.0, 4.0, 8.0]), rtol=1e-14)
    cost = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    np.testing.assert_allclose(weights([1.0, 2.0, 4.0], 0.5, cost=cost), softmax([2.0, 3.0, 5.0]), rtol=1e-14)
    np.testing.assert_allclose(weights([1e30, 1e30 + 1e20, -1e38], 1e20), [*softmax([0.0, 1.0]), 0.0], atol=1e-3)


@pytest.mark.parametrize("standardise", [False, True])
def test_a_score_that_is_not_finite_has_no_weight(standardise):
    finite = np.array([1.0, 3.0, 2.0])
    unit = finite.std() if standardise else 1.0
    expected = np.insert(softmax(finite / unit), [0, 1, 2], 0.0)
    np.testing.assert_allclose(
        weights([INF, 1.0, math.nan, 3.0, -INF, 2.0], standardise=standardise), expected, rtol=1e-14
    )
    assert np.isnan(weights([INF, math.nan], standardise=standardise)).all()


def test_standardised_weights_do_not_depend_on_the_units_of_the_return():
    scores = np.random.default_rng(0).normal(size=30)
    expected = softmax(scores / (0.3 * scores.std()))
    for scale, offset in ((1.0, 0.0), (1e12, 3e12), (1e-9, 0.0)):
        np.testing.assert_allclose(
            weights(scale * scores + offset, 0.3, standardise=True), expected, rtol=1e-9, atol=1e-12
        )
    np.testing.assert_allclose(weights([2.0, 2.0], standardise=True), [0.5, 0.5])
    np.testing.assert_allclose(weights([2.0], standardise=True), [1.0])


def planned(objective, start=None, low=(-1.0, -2.0), high=(1.0, 3.0), seed=0, **settings):
    planner = MPPI(*(torch.tensor(each, dtype=torch.float64) for each in (low, high)), **{"horizon": 3, **settings})
    start = planner.initial_plan() if start is None else Sequence(start)
    return planner.plan(objective, start, seeded(seed))


@pytest.mark.parametrize("settings", [{"standardise": False}, {"temperature": 0.7}, {"noise_beta": 2.0}])
def test_the_plan_is_the_mean_of_the_candidates_by_their_weights(settings):
    seen = []

    def objective(actions):
        seen.append(actions.numpy())
        return actions.sin().sum((1, 2))

    plan, info = planned(objective, num_iterations=3, num_candidates=50, **settings)
    assert len(seen) == 3
    scores = np.sin(seen[-1]).sum((1, 2))
    unit = scores.std() if settings.get("standardise", True) else 1.0
    weight = softmax(scores / (settings.get("temperature", 0.5) * unit))
    np.testing.assert_allclose(plan.actions.numpy(), np.einsum("k,kha->ha", weight, seen[-1]), rtol=1e-12)
    assert info.expected_return == pytest.approx(weight @ scores)
    assert info.metrics == {"num_iterations": 3, "effective_candidates": pytest.approx(1 / (weight**2).sum())}


def test_a_quadratic_return_pulls_as_its_product_with_the_noise():
    """exp(-(v - t)^2 / 2 lambda) times N(v | u, s^2) is a Gaussian, whose mean is known.

    The weighted mean of K candidates errs by less than s sqrt(E w^2 / K) with weights of mean one, and the weights
    of a Gaussian of a fraction q of the variance have E w^2 = 1 / sqrt(q (2 - q)) where it has the same mean, times
    exp(d^2 / (s^2 (2 - q))) where it is d away.
    """
    target, std, temperature, candidates = 0.3, 0.25 * 2.0 * 0.2, 0.02, 200_000
    plan, _ = planned(
        lambda a: -(a - target).square().sum((1, 2)) / 2,
        low=(-1.0,), high=(1.0,), horizon=1, num_iterations=1, num_candidates=candidates,
        standardise=False, temperature=temperature, noise_std=0.05,
    )  # fmt: skip
    q = 1 / (1 + std**2 / temperature)
    expected = (1 - q) * target
    second = math.exp(expected**2 / (std**2 * (2 - q))) / math.sqrt(q * (2 - q))
    assert plan.actions.item() == pytest.approx(expected, abs=5 * std * math.sqrt(second / candidates))


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_the_control_cost_draws_to_the_middle(share):
    """With equal returns w ~ exp(-c u' S^-1 e), and the mean of N(0, S) so weighted is -c u."""
    middle, std, candidates = torch.tensor([0.0, 0.5]), torch.tensor([0.1, 0.25]), 100_000
    start = (middle + std * torch.tensor([[0.5, 0.0], [-0.4, 0.3], [0.2, -0.5]])).double()
    plan, _ = planned(
        lambda a: torch.zeros(len(a)), start, noise_std=0.05, control_cost=share, num_iterations=1,
        num_candidates=candidates,
    )  # fmt: skip
    pull = share * ((start - middle) / std).square().sum()
    error = ((plan.actions - middle) - (1 - share) * (start - middle)) / std
    assert error.abs().max() < 5 * math.sqrt(math.exp(pull) * (1 + pull) / candidates)
    # What is fixed can be neither pushed nor drawn.
    plan, _ = planned(lambda a: a.sum((1, 2)), low=(-1.0, 2.0), high=(1.0, 2.0), control_cost=1.0)
    assert (plan.actions[:, 1] == 2.0).all() and plan.actions.isfinite().all()


@pytest.mark.parametrize("seed", range(3))
def test_it_comes_near_the_optimum_of_a_quadratic(seed):
    """From where it stands the noise alone moves it: by its standard deviation over the root of what counts."""
    target = torch.tensor([0.3, -0.7]).double()
    plan, info = planned(lambda a: -(a - target).square().sum((1, 2)), seed=seed, num_iterations=40, num_candidates=500)
    scale = torch.tensor([0.5, 1.25]) / math.sqrt(info.metrics["effective_candidates"])
    assert ((plan.actions - target).abs() < 4.5 * scale).all()
    assert info.metrics["effective_candidates"] > 5


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        ({"temperature": 0.0}, r"temperature .*\(0, inf\).* 0\.0$"),
        ({"temperature": math.inf}, "temperature .* inf$"),
        ({"noise_std": 1.5}, r"noise_std .* 1\.5$"),
        ({"noise_beta": -1.0}, r"noise_beta .* -1\.0$"),
        ({"control_cost": 1.5}, r"control_cost .* 1\.5$"),
        ({"control_cost": 0.5, "noise_beta": 1.0}, r"control_cost = 0\.5.* 1\.0$"),
        ({"num_candidates": 0}, "num_candidates .* 0$"),
    ],
)
def test_bad_arguments_are_named(arguments, value):
    with pytest.raises(ValueError, match=value):
        planned(lambda a: a.sum((1, 2)), **arguments)
