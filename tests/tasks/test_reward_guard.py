"""The functions that are planned with are compared with what the environment returned, once there is something."""

import warnings

import gymnasium
import pytest
import torch

from gym_dgpmpc.wrappers import RiskSensitiveReward
from tests.agents.point_mass import LENGTH, KnownPointMass, agent, reward_fn


def guard_warnings(learner, steps=LENGTH + 3):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learner.learn(steps)
    return [str(each.message) for each in caught if "disagrees" in str(each.message)]


def test_functions_that_agree_do_not_warn():
    ended = KnownPointMass(terminate_beyond=1.2)
    assert guard_warnings(agent()) == []
    assert guard_warnings(agent(ended, terminated_fn=lambda after: after[..., 0].abs() > 1.2), 25) == []


def test_a_reward_that_disagrees_warns_once_with_its_numbers():
    learner = agent(reward_fn=lambda o, a, n: reward_fn(o, a, n) + 0.5 * (o[..., 1] == 0))
    (message,) = guard_warnings(learner, 25)
    stored = learner.store.rewards[0].item()
    assert "1 of 10 transitions" in message and "transition 0" in message
    assert f"reward_fn gives {stored + 0.5:.6g}, the environment returned {stored:.6g}." in message


def test_a_reward_that_is_no_number_disagrees():
    def pushed_right(observation, action, next_observation):
        return reward_fn(observation, action, next_observation) * torch.where(action[..., 0] > 0, 1.0, torch.nan)

    with pytest.warns(UserWarning, match="returned nan"):
        learner = agent(reward_fn=pushed_right)
    (message,) = guard_warnings(learner, LENGTH)
    assert "reward_fn gives nan" in message


def test_a_termination_that_disagrees():
    learner = agent(KnownPointMass(terminate_beyond=1.2), terminated_fn=lambda after: after[..., 0].abs() > 1e3)
    learner.learning_starts = 40
    (message,) = guard_warnings(learner, 40)
    assert "terminated_fn gives 0, the environment returned 1" in message


@pytest.mark.parametrize("penalise_step", [False, True])
def test_a_reward_that_is_meant_to_be_another_is_not_compared(penalise_step):
    env = RiskSensitiveReward(KnownPointMass(), angle_index=0, angle_step=0.1, penalise_step=penalise_step)
    learner = agent(env)
    assert learner.task.functions.is_reported == penalise_step
    assert guard_warnings(learner) == []
    # The same wrapper, not saying that its rewards differ.
    other = RiskSensitiveReward(KnownPointMass(), angle_index=0, angle_step=0.1, penalise_step=penalise_step)
    other.plans_with_another_reward = False
    assert len(guard_warnings(agent(other))) == (0 if penalise_step else 1)


def test_a_shaped_reward_is_not_compared_and_a_given_one_is():
    shaped = agent(gymnasium.make("InvertedPendulum-v5"), reward_fn=None)
    assert not shaped.task.functions.is_reported
    assert guard_warnings(shaped) == []
    given = agent(gymnasium.make("InvertedPendulum-v5"), reward_fn=shaped.task.functions.reward_fn)
    (message,) = guard_warnings(given)
    assert "the environment returned 1" in message
