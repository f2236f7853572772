"""Gymnasium-Robotics' goal environments with the MuJoCo at hand; skipped where the package is not installed."""

import importlib
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.tasks.environment import environment_id, wrapped_env
from gym_dgpmpc.tasks.functions import find_functions, find_observation_spec
from gym_dgpmpc.types import ObservationSpec

pytest.importorskip("gymnasium_robotics")
robotics = importlib.import_module("gym_dgpmpc.envs.robotics")

PREFIX = "gym_dgpmpc.envs.robotics:"


def made(env_id):
    return wrapped_env(gym.make(PREFIX + env_id))


@pytest.mark.parametrize(
    ("env_id", "spec"),
    [
        ("FetchReachDense-v4", ObservationSpec(constant=(3, 4, 5), not_inputs=(0, 1, 2, 3, 4, 5))),
        ("FetchPushDense-v4", ObservationSpec(constant=(3, 4, 5), not_inputs=(0, 1, 2, 3, 4, 5))),
        ("PointMaze_UMazeDense-v3", ObservationSpec(constant=(2, 3), not_inputs=(0, 1, 2, 3))),
        ("AntMaze_UMazeDense-v5", ObservationSpec(constant=(2, 3), not_inputs=(2, 3))),
    ],
)
def test_they_can_be_planned_for(env_id, spec):
    """The reward that is planned with is the one that `step` returns, and the goal stays for the episode."""
    env = made(env_id)
    task = find_functions(env, None, None, (env.observation_space, env.action_space))
    assert (task.reward_source, find_observation_spec(env, None)) == ("compute_reward", spec)
    assert environment_id(env) == PREFIX + env_id
    env.seed(0)
    env.action_space.seed(0)
    observation = env.reset()
    goal = observation[0, list(spec.constant)]
    for _ in range(10):
        action = env.action_space.sample()[None]
        after, reward, _, _ = env.step(action)
        planned = task.reward_fn(*(torch.as_tensor(each).double() for each in (observation, action, after)))
        np.testing.assert_allclose(planned.numpy(), reward, rtol=1e-6)
        np.testing.assert_array_equal(after[0, list(spec.constant)], goal)
        observation = after
    env.close()


@pytest.mark.parametrize("env_id", ["FetchReachDense-v4", "FetchPushDense-v4", "PointMaze_UMazeDense-v3"])
def test_what_is_no_input_is_observed_twice(env_id):
    env = made(env_id)
    env.seed(1)
    seen = env.reset()[0]
    achieved, rest = seen[env.layout["achieved_goal"]], seen[env.layout["observation"]]
    assert np.isin(achieved, rest).all()
    env.close()


def test_the_ants_place_is_observed_once():
    env = made("AntMaze_UMazeDense-v5")
    seen = env.reset()[0]
    assert not np.isin(seen[env.layout["achieved_goal"]], seen[env.layout["observation"]]).any()
    env.close()


def test_joint_types_are_integers_only_where_they_must_be():
    types = robotics.IntegerJointTypes()
    assert types.mj_forward is mujoco.mj_forward
    for name in ("mjJNT_FREE", "mjJNT_BALL", "mjJNT_SLIDE", "mjJNT_HINGE"):
        assert getattr(types.mjtJoint, name) == int(getattr(mujoco.mjtJoint, name))

    class NeverEqual:  # as members of MuJoCo's enumeration are to NumPy's integers
        def __init__(self, value):
            self.value = value

        def __int__(self):
            return self.value

        def __eq__(self, other):
            return False

        def __hash__(self):
            return 0

    def utilities(kind):
        joint = SimpleNamespace(mjJNT_HINGE=kind(3), mjJNT_SLIDE=kind(2))
        return SimpleNamespace(mujoco=SimpleNamespace(mjtJoint=joint))

    broken, fine = utilities(NeverEqual), utilities(int)
    before = fine.mujoco
    assert robotics.use_integer_joint_types(broken) and isinstance(broken.mujoco, robotics.IntegerJointTypes)
    assert not robotics.use_integer_joint_types(broken)
    assert not robotics.use_integer_joint_types(fine) and fine.mujoco is before


def test_the_papers_agent_learns_in_one(tmp_path):
    sizes = {"num_inducing": 10, "num_features": 16, "num_samples": 5, "sample_spacing": 1, "num_particles": 2}
    sizes |= {"first_training_iterations": 5, "resample_samples": 1, "horizon": 3, "num_candidates": 12}
    learner = DGPMPCAgent(f"{PREFIX}FetchReachDense-v4", num_layers=1, seed=0, **sizes).learn(52)
    assert learner.dynamics.encoder.input_size == 10 + 4
    learner.save(tmp_path / "agent")
    loaded = DGPMPCAgent.load(tmp_path / "agent", env=f"{PREFIX}FetchReachDense-v4")
    observation = learner.env.reset()[0]
    expected = learner.predict(observation, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], expected)
