"""The search by samples: its gradient against differences with the draws held, what is dropped, and that it climbs."""

from functools import partial

import pytest
import torch

from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.dynamics.dropout import DropoutDynamics
from gym_dgpmpc.imagination.gradient import Paths
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv
from gym_dgpmpc.policy_search.policies import LinearPolicy, RBFPolicy
from gym_dgpmpc.policy_search.samples import Dropped, SampledSearch
from gym_dgpmpc.types import Transitions
from tests.agents.point_mass import reward_fn
from tests.imagination.test_worlds import ACTIONS, OBSERVATIONS, beginnings, worlds
from tests.oracles.models import normal, seeded
from tests.policy_search.test_policies import fed


def policy(num_centres=4, size=2):
    return RBFPolicy(fed(size=size), 1, "tanh", num_centres, seeded(1)).double()


def a_deep_gp(num_layers):
    return DeepGPDynamics(
        2, 1, num_layers=num_layers, kernel="rbf", num_inducing=8, num_features=16, first_training_iterations=5,
        num_samples=5, sample_spacing=1, dtype=torch.float64,
    )  # fmt: skip


def of_functions(model):
    """Worlds of functions drawn from a model, in double precision."""
    generator = seeded(2)
    state, action = normal(generator, 30, 2), 2 * normal(generator, 30, 1)
    after = state + 0.3 * torch.cat([state[:, 1:], action], 1)
    model.fit(Transitions(state.float(), action.float(), after.float()), generator)
    return ImaginedVecEnv(
        model, reward_fn, beginnings, OBSERVATIONS, ACTIONS, num_worlds=3, episode_steps=4, seed=0, dtype=torch.float64
    )


MODELS = {
    "gp": partial(a_deep_gp, 1),
    "deep gp": partial(a_deep_gp, 2),
    "dropout": partial(DropoutDynamics, 2, 1, hidden_size=8, num_epochs=5, dropout=0.3, dtype=torch.float64),
}


@pytest.mark.parametrize(("model", "matches_moments"), [("gp", False), ("deep gp", False), ("dropout", True)])
def test_the_slope_is_that_of_the_value(model, matches_moments):
    """Central differences in float64: their error is of the order of the step squared and of rounding over the step."""
    env, searched = of_functions(MODELS[model]()), policy()

    def value():
        env.generator.manual_seed(1)
        acting = Dropped(searched, env.generator)
        acting.rate = 0.3
        return Paths(env, 4, 2, 0.0, goes_on=0.0, matches_moments=matches_moments).mean_reward(acting)

    value().backward()
    for parameter in searched.parameters():
        flat = parameter.data.view(-1)
        for i in range(len(flat)):
            ends = []
            for sign in (1, -1):
                flat[i] += sign * 1e-6
                ends.append(value().item())
                flat[i] -= sign * 1e-6
            assert parameter.grad.view(-1)[i].item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-7)


@torch.no_grad()
def test_what_is_left_out_is_made_up_for_on_average():
    """Of what is squashed: the mean over many draws is the whole policy's, within five standard errors."""
    searched, count, rate = policy(num_centres=3), 50_000, 0.4
    searched.squash = None
    x = torch.full((count, 2), 0.3, dtype=torch.float64)
    uniform = torch.rand(count, 3, generator=seeded(9), dtype=torch.float64)
    dropped = searched.unsquashed(x, (uniform >= rate).double() / (1 - rate))
    error = dropped.std().item() / count**0.5
    assert dropped.mean().item() == pytest.approx(searched.unsquashed(x[:1]).item(), abs=5 * error)


@torch.no_grad()
def test_a_call_leaves_out_what_the_rate_says():
    searched = policy(num_centres=1)
    acting = Dropped(searched, seeded(3))
    acting.rate = 0.25
    actions = acting(torch.zeros(10_000, 2, dtype=torch.float64))
    # Without its only basis function it does nothing; the share of such calls is a mean of as many coins.
    assert (actions == 0).double().mean().item() == pytest.approx(0.25, abs=5 * (0.25 * 0.75 / 10_000) ** 0.5)
    acting.rate = 0.0
    torch.testing.assert_close(acting(actions.expand(-1, 2)), searched(actions.expand(-1, 2)))


@torch.no_grad()
def test_a_linear_policy_has_nothing_to_leave_out():
    acting = Dropped(LinearPolicy(fed(size=2), 1, "tanh"), seeded(3))
    acting.rate = 0.9
    torch.testing.assert_close(acting(torch.ones(5, 2)), torch.zeros(5, 1))


def test_it_climbs_to_the_reward_that_is_best():
    """A step moves a state by the action and a number u ~ U(0, 1) of its world; the best first action is near -1/2."""
    env, searched = worlds(num_worlds=20, episode_steps=1), policy()
    found = SampledSearch(1, 150, 0.1, 0.0).improve(searched, env)
    action = 2 * searched(torch.zeros(1, 2, dtype=torch.float64)).item()
    # The mean reward is -(a^2 + a + 1/3) - 0.01 a^2, at its top where a = -1 / 2.02. A step of Adam's is at most 0.01
    # in each of 13 parameters at the end; the gradient's noise does no more.
    assert action == pytest.approx(-1 / 2.02, abs=0.1)
    # Of the last ten steps: 200 worlds, whose rewards have a variance below that of u^2, 4/45.
    assert found["imagined_return"] == pytest.approx(-1 / 12 - 0.01 / 4, abs=5 * (4 / 45 / 200) ** 0.5)
