"""The agent that acts by a policy from its model's worlds: the same loop, file and run as `DGPMPCAgent`'s."""

import numpy as np
import pytest
import torch
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger

from gym_dgpmpc import DGPMPCAgent, DynaAgent, PETSAgent
from gym_dgpmpc.errors import CheckpointError, PlanningError
from gym_dgpmpc.imagination import controller
from tests.agents.point_mass import LENGTH, KnownPointMass, actions_of
from tests.agents.test_dgp_mpc import TINY

QUICK = {"algorithm": "SAC", "imagined_timesteps": 40, "num_worlds": 4, "trial_every": 40}
OBSERVATION = np.array([0.7, -0.1])


def point_mass():
    return TimeLimit(KnownPointMass(fixed_start=True), LENGTH)


def tiny(**arguments):
    return DynaAgent(point_mass(), **{**TINY, **QUICK, **arguments})


@pytest.fixture(scope="module")
def learned():
    return tiny().learn(3 * LENGTH)


def test_it_acts_by_the_policy(learned):
    action, _ = learned.predict(OBSERVATION)
    np.testing.assert_array_equal(action, learned.imagined_policy.predict(OBSERVATION, deterministic=True)[0])
    assert isinstance(learned.imagined_policy, SAC)
    assert evaluate_policy(learned, learned.env, 1, warn=False)[0] < 0
    line = learned.episode_records[0].line(30)
    assert "random" not in line and "nan" not in line


def test_until_it_has_learned_its_actions_are_random():
    agent = tiny().learn(LENGTH - 1)
    assert agent.imagined_policy is None
    assert "random" in agent.episode_records[0].line(9)
    with pytest.warns(UserWarning, match="before the agent has learned"):
        agent.predict(OBSERVATION)


def test_with_the_planner_it_does_what_its_like_does_and_learns_a_policy_beside_it():
    agent = tiny(acts_by="planner").learn(2 * LENGTH)
    alike = DGPMPCAgent(KnownPointMass(fixed_start=True), **TINY).learn(2 * LENGTH)
    np.testing.assert_array_equal(actions_of(agent.env.envs[0]), actions_of(alike.env.envs[0]))
    assert agent.imagined_policy is not None


def test_it_is_saved_and_goes_on_as_if_it_had_not_been(learned, tmp_path):
    part = tiny().learn(2 * LENGTH)
    part.save(tmp_path / "part")
    loaded = DynaAgent.load(tmp_path / "part", env=point_mass())
    assert loaded.imagined_timesteps == 40 and loaded.acts_by == "policy"
    np.testing.assert_array_equal(loaded.predict(OBSERVATION)[0], part.predict(OBSERVATION)[0])
    loaded.learn(LENGTH, reset_num_timesteps=False)
    third = actions_of(learned.env.envs[0])[2 * LENGTH : 3 * LENGTH]
    np.testing.assert_array_equal(third, actions_of(loaded.env.envs[0]))
    with pytest.raises(CheckpointError, match="holds a DynaAgent"):
        PETSAgent.load(tmp_path / "part")


def test_another_algorithms_policy_does_not_fit(learned, tmp_path):
    learned.save(tmp_path / "agent")
    with pytest.raises(CheckpointError, match="does not fit a DynaAgent of its arguments"):
        DynaAgent.load(tmp_path / "agent", env=KnownPointMass(), algorithm="PPO")


def test_each_training_goes_on_from_the_policy_before(learned, monkeypatch):
    asked = []

    def imagine(*args, **kwargs):
        asked.append(kwargs["begin_with"])
        return original(*args, **kwargs)

    original = controller.imagine
    monkeypatch.setattr(controller, "imagine", imagine)
    agent = tiny().learn(2 * LENGTH)
    assert asked[0] is None and asked[1] is not None and agent.imagined_policy is not asked[1]


def test_what_it_imagined_is_logged(learned):
    logged = {}

    class Keeping(Logger):
        def record(self, key, value, exclude=None):
            logged[key] = value

    agent = tiny()
    agent.set_logger(Keeping(None, []))
    agent.learn(LENGTH)
    assert logged["train/imagined_steps"] == 40 and np.isfinite(logged["train/imagined_return"])


def test_a_policy_that_is_not_finite_does_not_act():
    agent = tiny().learn(LENGTH)
    with torch.no_grad():
        next(iter(agent.imagined_policy.policy.actor.parameters())).fill_(torch.nan)
    with pytest.raises((PlanningError, ValueError)):
        agent.predict(OBSERVATION)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"acts_by": "hand"}, "acts_by must be one of policy, planner, got 'hand'"),
        ({"algorithm": "DQN"}, "algorithm must be one of"),
        ({"trial_patience": 0}, "trial_patience must be at least 1"),
        ({"imagination": 3}, "no setting 'imagination'"),
    ],
)
def test_wrong_settings_are_named(wrong, message, unchecked):
    with pytest.raises((ValueError, TypeError), match=message):
        tiny(**wrong)
