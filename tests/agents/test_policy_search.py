"""The agents that search a policy: the same loop, file and run as `DGPMPCAgent`'s, and they act by the policy."""

import numpy as np
import pytest
import torch
from gymnasium.wrappers import TimeLimit

from gym_dgpmpc import DeepPILCOAgent, MCPILCOAgent, PILCOAgent
from gym_dgpmpc.errors import CheckpointError, NotDifferentiableError, PlanningError
from tests.agents.point_mass import LENGTH, KnownPointMass, PointMass, actions_of
from tests.agents.test_dgp_mpc import TINY

SEARCH = {"num_centres": 5, "seed": 0}
SAMPLED = {**SEARCH, "first_search_steps": 2, "search_steps": 1, "num_worlds": 3}
DEEP_GP = {name: value for name, value in TINY.items() if name != "num_layers"}
QUICK = {
    MCPILCOAgent: {**DEEP_GP, **SAMPLED, "num_paths": 2},
    DeepPILCOAgent: {**SAMPLED, "hidden_size": 8, "num_epochs": 2},
    PILCOAgent: {"num_inducing": 8, "max_training_iterations": 10, **SEARCH, "max_search_iterations": 1,
                 "search_horizon": 3, "num_points": 8, "num_particles": 3},
}  # fmt: skip
AGENTS = [
    (MCPILCOAgent, {"num_layers": 2, "kernel": "matern32"}),
    (DeepPILCOAgent, {"split_noise": True}),
    (DeepPILCOAgent, {"match_moments": False, "policy_form": "linear"}),
    (PILCOAgent, {"policy_form": "linear", "exact": True}),
]
OBSERVATION = np.array([0.7, -0.1])


def point_mass():
    return TimeLimit(KnownPointMass(fixed_start=True), LENGTH)


def quick(agent_class, env=None, **arguments):
    return agent_class(point_mass() if env is None else env, **{**QUICK[agent_class], **arguments})


@pytest.mark.parametrize(("agent_class", "arguments"), AGENTS)
def test_it_acts_by_its_policy_and_is_saved_and_goes_on_as_if_it_had_not_been(agent_class, arguments, tmp_path):
    whole = quick(agent_class, **arguments).learn(3 * LENGTH)
    part = quick(agent_class, **arguments).learn(2 * LENGTH)
    policy = part.searched_policy
    with torch.no_grad():
        state = torch.from_numpy(OBSERVATION).to(next(policy.parameters()).dtype)
        expected = 2.0 * policy(state.unsqueeze(0))[0].numpy()
    # An action near zero has the rounding of its bounds, -2 and 2.
    np.testing.assert_allclose(part.predict(OBSERVATION)[0], expected, rtol=1e-6, atol=2 * 2**-23)
    part.save(tmp_path / "part")
    loaded = agent_class.load(tmp_path / "part", env=point_mass())
    np.testing.assert_array_equal(loaded.predict(OBSERVATION)[0], part.predict(OBSERVATION)[0])
    loaded.learn(LENGTH, reset_num_timesteps=False)
    third = actions_of(whole.env.envs[0])[2 * LENGTH : 3 * LENGTH]
    np.testing.assert_array_equal(third, actions_of(loaded.env.envs[0]))
    with pytest.raises(CheckpointError, match=f"holds a {agent_class.__name__}"):
        next(other for other in QUICK if other is not agent_class).load(tmp_path / "part")


@pytest.mark.parametrize("agent_class", QUICK)
def test_until_it_has_learned_its_actions_are_random(agent_class):
    agent = quick(agent_class).learn(LENGTH - 1)
    assert agent.searched_policy is None
    with pytest.warns(UserWarning, match="before the agent has learned"):
        agent.predict(OBSERVATION)


@pytest.mark.parametrize("agent_class", QUICK)
def test_a_reward_that_is_learned_has_a_gradient_too(agent_class):
    env = TimeLimit(PointMass(fixed_start=True), LENGTH)
    agent = quick(agent_class, env).learn(LENGTH)
    before = agent.searched_policy.weight.detach().clone()
    agent.learn(LENGTH, reset_num_timesteps=False)
    assert not torch.equal(agent.searched_policy.weight, before)
    assert env.action_space.contains(agent.predict(OBSERVATION)[0])


@pytest.mark.parametrize("agent_class", QUICK)
def test_a_policy_that_is_not_finite_does_not_act(agent_class):
    agent = quick(agent_class).learn(LENGTH)
    with torch.no_grad():
        agent.searched_policy.weight.fill_(torch.nan)
    with pytest.raises(PlanningError, match="the policy returned the action"):
        agent.predict(OBSERVATION)


@pytest.mark.parametrize("agent_class", QUICK)
def test_a_reward_without_a_gradient_is_refused(agent_class):
    def reward_fn(observation, action, next_observation):
        return -next_observation[..., 0].detach().abs()

    with pytest.raises(NotDifferentiableError, match="no gradient comes through the reward"):
        quick(agent_class, PointMass(), reward_fn=reward_fn).learn(LENGTH)


@pytest.mark.parametrize(
    ("agent_class", "wrong", "message"),
    [
        (MCPILCOAgent, {"policy_form": "network"}, "policy_form must be one of rbf, linear, got 'network'"),
        (MCPILCOAgent, {"num_centres": 0}, "num_centres must be at least 1"),
        (MCPILCOAgent, {"search_steps": 0}, "search_steps must be at least 1"),
        (MCPILCOAgent, {"policy_dropout": 1.0}, r"policy_dropout must lie in \[0, 1\), got 1.0"),
        (MCPILCOAgent, {"search_step_size": 0.0}, r"search_step_size must lie in \(0, 1\], got 0.0"),
        (DeepPILCOAgent, {"dropout": 1.0}, r"dropout must lie in \[0, 1\), got 1.0"),
        (PILCOAgent, {"search_horizon": 0}, "search_horizon must be at least 1"),
        (PILCOAgent, {"draw": "DS"}, "no setting 'draw'"),
        (PILCOAgent, {"policy_dropout": 0.1}, "no setting 'policy_dropout'"),
    ],
)
def test_wrong_settings_are_named(agent_class, wrong, message, unchecked):
    with pytest.raises((ValueError, TypeError), match=message):
        quick(agent_class, **wrong)


def test_too_few_points_are_named():
    with pytest.raises(ValueError, match="at least 4 points for 3 numbers of state and action, got num_points = 3"):
        quick(PILCOAgent, num_points=3).learn(LENGTH)
