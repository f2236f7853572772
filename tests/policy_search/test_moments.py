"""The search by exact moments: beliefs against Monte Carlo, gradients against differences, and a known optimum."""

import pytest
import torch

from gym_dgpmpc.dynamics.sparse_gp import MomentMatchedDynamics
from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.policy_search.moments import Belief, BeliefPath, Bounds, search
from gym_dgpmpc.types import ObservationSpec, Transitions
from tests.oracles.models import normal, seeded
from tests.policy_search.test_policies import DRAWS, belief, drawn, linear, rbf

BOUNDS = Bounds(torch.tensor([-2.0, -1.0]).double(), torch.tensor([3.0, 1.0]).double())
MATRIX = normal(seeded(7), 5, 3)
NOISE = torch.diag(torch.tensor([0.01, 0.02, 0.03]).double())


def linear_step(mean, covariance):
    return mean @ MATRIX, MATRIX.mT @ covariance @ MATRIX + NOISE


def quadratic(before, action, after):
    return -after.square().sum(-1) - 0.3 * action.square().sum(-1) + 0.1 * before[..., 0]


def path(propagate=linear_step, reward_fn=quadratic, horizon=1, num_points=12, start=None):
    return BeliefPath(propagate, reward_fn, start or Belief(*belief()), BOUNDS, horizon, num_points, seeded(5))


@torch.no_grad()
def test_the_expected_reward_of_a_step_is_that_of_many_draws():
    """Quadratic rewards depend on mean and covariance alone, and a linear system has exact ones.

    Actions of a linear policy are not Gaussian, so the points must stay within the bounds for the average to be exact.
    """
    policy, (mean, covariance) = linear(scale=0.1), belief()
    states = drawn(mean, covariance)
    action = BOUNDS.low + 0.5 * (policy(states) + 1.0) * (BOUNDS.high - BOUNDS.low)
    noise = normal(seeded(6), DRAWS, 3) @ NOISE.sqrt()
    after = torch.cat([states, action], 1) @ MATRIX + noise
    samples = quadratic(states, action, after)
    error = samples.std().item() / DRAWS**0.5
    assert path().expected_return(policy).item() == pytest.approx(samples.mean().item(), abs=5 * error)


def fitted():
    """A model of a small system whose second number is an angle."""
    generator = seeded(8)
    state, action = normal(generator, 40, 3), normal(generator, 40, 2)
    # With as much noise the weights of the kernels, whose products round the second moments, stay small.
    after = (
        state + 0.3 * torch.stack([state[:, 1].sin(), state[:, 2], action.sum(1)], 1) + 0.3 * normal(generator, 40, 3)
    )
    model = MomentMatchedDynamics(3, 2, ObservationSpec(angles=(1,)), num_inducing=12, max_training_iterations=5)
    model.fit(Transitions(state.float(), action.float(), after.float()), generator)
    return model.draw(6, 4, generator)


@pytest.mark.parametrize("make", [linear, rbf])
def test_the_slope_is_that_of_the_value(make):
    """Central differences in float64: their error is of the order of the step squared and of rounding over the step."""
    policy, three = make(ObservationSpec(angles=(1,))), path(fitted().propagate, horizon=2)

    def value():
        return three.expected_return(policy)

    value().backward()
    for parameter in policy.parameters():
        flat = parameter.data.view(-1)
        for i in range(0, len(flat), 5):
            ends = []
            for sign in (1, -1):
                flat[i] += sign * 1e-4
                ends.append(value().item())
                flat[i] -= sign * 1e-4
            assert parameter.grad.view(-1)[i].item() == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-5, abs=1e-7)


def test_the_search_finds_the_best_constant_action():
    """With s' = a the reward -(a - 1)^2 is greatest at a = 1, which is 0.2 and the bound itself of the two ranges."""

    def copied(mean, covariance):
        return mean[:, [3, 4, 4]], covariance[:, [3, 4, 4]][:, :, [3, 4, 4]]

    policy = linear(scale=0.0)
    found = search(
        policy,
        path(copied, lambda before, action, after: -(action - torch.tensor([1.0, 0.5])).square().sum(-1)),
        50,
    )
    action = BOUNDS.low + 0.5 * (policy(belief()[0]) + 1.0) * (BOUNDS.high - BOUNDS.low)
    torch.testing.assert_close(action, torch.tensor([[1.0, 0.5]]).double(), atol=1e-3, rtol=0)
    assert found["imagined_return"] == pytest.approx(0.0, abs=1e-5)


def test_parameters_at_which_a_belief_explodes_are_left_again():
    def exploding(mean, covariance):
        return torch.where(mean[:, 3:4] > 0.6, torch.nan, mean[:, :3]), covariance[:, :3, :3] + 0.0 * mean[:, 3:4, None]

    policy = linear(scale=0.0)
    earned = search(policy, path(exploding, lambda before, action, after: action.sum(-1) + after.sum(-1) * 0), 20)
    assert all(parameter.isfinite().all() for parameter in policy.parameters())
    assert earned["imagined_return"] > 0.5 - 1e-9  # that of the middle of the ranges


def test_a_reward_without_a_slope_is_refused():
    with pytest.raises(NotDifferentiableError, match="no gradient comes through the reward"):
        search(linear(), path(reward_fn=lambda before, action, after: after.detach().sum(-1)), 3)


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="at least 6 points for 5 numbers of state and action, got num_points = 5"):
        path(num_points=5)
