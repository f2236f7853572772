"""Measures of risk against sorted returns in NumPy; no measure lets a particle that is not finite pass."""

import math

import numpy as np
import pytest
import torch

from gym_dgpmpc.planning.risk import RiskMeasure, RiskName, cvar, mean_minus_std
from gym_dgpmpc.planning.rollout import rollout_objective
from tests.oracles.models import seeded

RETURNS = torch.randn(7, 50, generator=seeded(), dtype=torch.float64)
NAMES = RiskName.__args__


def test_the_mean_less_some_standard_deviations():
    sample = RETURNS.numpy()
    for aversion in (-1.5, 0.0, 2.0):
        expected = sample.mean(0) - aversion * sample.std(0)
        np.testing.assert_allclose(mean_minus_std(RETURNS, aversion), expected, rtol=1e-12)
    assert torch.equal(mean_minus_std(RETURNS[:1], 3.0), RETURNS[0])  # one particle has no spread


def worst_mean(sample, share):
    """The mean of the worst share, from 10,000 copies of each particle."""
    copies = np.sort(np.repeat(sample, 10_000, axis=0), axis=0)
    return copies[: round(share * len(copies))].mean(0)


@pytest.mark.parametrize("share", [0.05, 1 / 7, 0.2, 0.5, 6 / 7, 0.99, 1.0])
def test_the_worst_share(share):
    """The copies round the share to 1 / 70,000 of the whole, of returns that lie within 4 of each other."""
    np.testing.assert_allclose(cvar(RETURNS, share), worst_mean(RETURNS.numpy(), share), atol=8 / (70_000 * share))


def test_measures_are_ordered_and_meet_at_their_ends():
    scores = {name: RiskMeasure(name, 1.0, 0.3)(RETURNS) for name in NAMES}
    assert (scores["worst"] <= scores["cvar"]).all() and (scores["cvar"] <= scores["mean"]).all()
    assert (scores["mean-std"] < scores["mean"]).all() and (scores["mean"] < scores["best"]).all()
    torch.testing.assert_close(cvar(RETURNS, 1.0), scores["mean"])
    assert torch.equal(cvar(RETURNS, 0.1), scores["worst"])
    assert torch.equal(scores["worst"], RETURNS.min(0).values) and torch.equal(scores["best"], RETURNS.max(0).values)
    assert torch.equal(RiskMeasure()(RETURNS), RETURNS.mean(0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", NAMES)
def test_one_particle_that_is_not_finite_makes_its_candidate_lose(name, bad):
    returns = RETURNS.clone()
    returns[2, 10], returns[:, 20] = bad, bad
    scores = RiskMeasure(name)(returns)
    assert set(np.flatnonzero(~scores.isfinite())) == {10, 20}
    others = [k for k in range(50) if k not in (10, 20)]
    assert torch.equal(scores[others], RiskMeasure(name)(RETURNS)[others])


@pytest.mark.parametrize("name", NAMES)
def test_the_objective_measures_the_returns_in_the_worlds(name):
    """Particle p of candidate k earns its own multiple of the action."""
    gains = torch.tensor([-1.0, 0.0, 4.0])[:, None, None]
    objective = rollout_objective(
        lambda observation, action, step: gains * action.expand(3, -1, -1),
        lambda observation, action, next_observation: next_observation[..., 0],
        torch.zeros(1), 3, measure=RiskMeasure(name, 0.5, 2 / 3),
    )  # fmt: skip
    expected = {"mean": 1, "mean-std": 1 - 0.5 * np.std([-1, 0, 4]), "cvar": -0.5, "worst": -1, "best": 4}
    torch.testing.assert_close(objective(torch.ones(1, 1, 1)), torch.tensor([expected[name]], dtype=torch.float32))


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        ({"risk": "median"}, "risk .*mean-std.*'median'"),
        ({"risk_aversion": math.inf}, "risk_aversion .* inf$"),
        ({"risk_aversion": math.nan}, "risk_aversion .* nan$"),
        ({"cvar_share": 0.0}, r"cvar_share .* 0\.0$"),
        ({"cvar_share": 1.1}, r"cvar_share .* 1\.1$"),
    ],
)
def test_bad_measures_are_named(arguments, value, unchecked):
    with pytest.raises(ValueError, match=value):
        RiskMeasure(**arguments)
