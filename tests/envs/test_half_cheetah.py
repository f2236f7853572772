"""The half cheetah: the same body as Gymnasium's, its velocity first, its reward, and its anchor."""

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

from gym_dgpmpc.envs import HalfCheetahReward, VelocityHalfCheetahEnv
from tests.envs.common import play, uniform_actions

PHYSICS = [
    *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat", "dof_damping"),
    *("dof_armature", "jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_limited", "jnt_stiffness"),
    *("jnt_solref", "jnt_solimp", "geom_type", "geom_pos", "geom_quat", "geom_friction", "geom_solref"),
    *("geom_solimp", "geom_contype", "geom_conaffinity", "geom_condim", "actuator_gear", "actuator_ctrlrange"),
    *("qpos0", "qpos_spring"),
]


@pytest.fixture(scope="module")
def gymnasiums():
    return gymnasium.make("HalfCheetah-v5").unwrapped


def test_the_body_is_gymnasiums(gymnasiums):
    env = VelocityHalfCheetahEnv()
    for name in PHYSICS:
        ours, theirs = getattr(env.model, name), getattr(gymnasiums.model, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-14, err_msg=name)
    # The floor's size is but how far it is drawn.
    np.testing.assert_allclose(env.model.geom_size[1:], gymnasiums.model.geom_size[1:], rtol=1e-12)
    assert env.model.body_mass.sum() == pytest.approx(14.0, rel=1e-12)
    assert (env.model.opt.timestep, env.frame_skip) == (gymnasiums.model.opt.timestep, gymnasiums.frame_skip)
    assert int(env.model.opt.integrator) == mujoco.mjtIntegrator.mjINT_EULER.value


def test_it_moves_as_gymnasiums_does(gymnasiums):
    """From the same state, each step, so that contacts do not make a rounding error grow."""
    env = VelocityHalfCheetahEnv()
    env.reset(seed=0), gymnasiums.reset(seed=0)
    for action in uniform_actions(env.action_space, 100, seed=0):
        mujoco.mj_resetData(gymnasiums.model, gymnasiums.data), gymnasiums.set_state(env.data.qpos, env.data.qvel)
        state = env.data.qpos.copy(), env.data.qvel.copy()
        mujoco.mj_resetData(env.model, env.data), env.set_state(*state)
        observation, reward, *_ = env.step(action)
        theirs, their_reward, *_ = gymnasiums.step(action)
        np.testing.assert_allclose(observation[1:], theirs, rtol=1e-9, atol=1e-9)
        assert reward == pytest.approx(their_reward, abs=2e-7)  # they sum the action's cost in float32


def test_the_first_number_is_the_way_by_the_time():
    env = VelocityHalfCheetahEnv()
    observation, info = env.reset(seed=0)
    assert observation[0] == 0.0
    for action in uniform_actions(env.action_space, 50, seed=0):
        before = info["x_position"]
        observation, _, _, _, info = env.step(action)
        assert info["x_position"] == env.data.qpos[0]
        assert observation[0] == (info["x_position"] - before) / env.dt


def test_pitch_is_positive_nose_down():
    env = VelocityHalfCheetahEnv()
    env.reset(seed=0)
    env.set_state(np.eye(9)[2] * 0.3, np.zeros(9))
    head = env.data.geom("head").xpos - env.data.body("torso").xpos
    level = np.array([0.6, 0.0, 0.1])
    assert head[2] == pytest.approx(level[2] * np.cos(0.3) - level[0] * np.sin(0.3))


def test_reward_by_hand():
    after = torch.zeros(3, 18, dtype=torch.float64)
    after[:, 0] = torch.tensor([2.0, -1.0, 0.5])
    after[:, 2] = 3.0  # which the task's own reward does not mind
    action = torch.tensor([[0.0] * 6, [1.0] * 6, [0.0] * 5 + [-7.0]], dtype=torch.float64)
    reward = HalfCheetahReward(ctrl_cost_weight=0.2)(torch.zeros_like(after), action, after)
    np.testing.assert_allclose(reward, [2.0, -2.2, 0.3], atol=1e-15)


def test_starting_states():
    num_resets = 1000
    error = 5 / np.sqrt(num_resets)
    env = VelocityHalfCheetahEnv(reset_noise_scale=0.1)
    env.reset(seed=0)
    starts = np.array([env.reset()[0] for _ in range(num_resets)])
    assert not starts[:, 0].any()
    assert np.all(np.abs(starts[:, 1:].mean(0)) < 0.1 * error)
    assert np.all(np.abs(starts[:, 1:].std(0) / 0.1 - 1) < error)
    assert np.abs(VelocityHalfCheetahEnv().reset(seed=0)[0]).max() < 0.005


def test_return_of_random_episodes():
    """Anchor: -91 m/s of speeds, summed, in the mean of 200 other episodes, with a spread over episodes of 82.

    A cheetah that does not move has 0, which is outside. The actions cost 200.
    """
    num_episodes, env = 24, gymnasium.make("VelocityHalfCheetah-v0")
    episodes = [play(env, uniform_actions(env.action_space, 1000, seed), seed) for seed in range(num_episodes)]
    forward = [sum(info["reward_forward"] for info in infos) for _, _, infos in episodes]
    assert np.mean(forward) == pytest.approx(-91, abs=4 * 82 / np.sqrt(num_episodes))
    costs = [sum(info["reward_control"] for info in infos) for _, _, infos in episodes]
    # The cost of a step has the variance 0.01 * 6 * 4 / 45.
    assert np.mean(costs) == pytest.approx(-200, abs=4 * np.sqrt(1000 * 0.01 * 6 * 4 / 45 / num_episodes))
    returns = [rewards.sum() for _, rewards, _ in episodes]
    np.testing.assert_allclose(returns, np.add(forward, costs), rtol=1e-9)
