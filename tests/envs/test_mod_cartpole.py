"""The cart-pole tasks' reward, info, starting states, arguments and anchors; what holds for all is in its own file."""

import pickle
import re

import gymnasium
import numpy as np
import pytest
import torch

from gym_dgpmpc.envs import ModCartPoleEnv, SwingUpCartPoleEnv
from gym_dgpmpc.types import ObservationSpec
from tests.envs.common import play, section, uniform_actions


def test_reward_by_hand():
    reward_fn = ModCartPoleEnv(target=(1.0, 0.6), reward_scale=0.5, ctrl_cost_weight=0.02).reward_fn
    upright_at_target = torch.tensor([1.0, torch.pi, 0.3, -2.0], dtype=torch.float64)
    hanging_left_of_it = torch.tensor([0.7, 0.0, 0.0, 0.0], dtype=torch.float64)
    tip_right_of_hinge = torch.tensor([0.4, 1.5 * torch.pi, 0.0, 0.0], dtype=torch.float64)  # tip at (1.0, 0.0)
    after = torch.stack([upright_at_target, hanging_left_of_it, tip_right_of_hinge])
    action = torch.tensor([[0.0], [2.0], [-9.0]], dtype=torch.float64)
    expected = [1.0, np.exp(-(0.3**2 + 1.2**2) / 0.25) - 0.08, np.exp(-(0.6**2) / 0.25) - 0.18]
    np.testing.assert_allclose(reward_fn(torch.zeros_like(after), action, after).numpy(), expected, rtol=1e-12)


def test_info_explains_the_reward():
    env = ModCartPoleEnv()
    observations, rewards, infos = play(env, uniform_actions(env.action_space, 30, 1), seed=1)
    for observation, reward, info in zip(observations[1:], rewards, infos, strict=True):
        assert info["reward_closeness"] + info["reward_control"] == reward
        x, theta = observation[:2]
        tip = np.array([x - 0.6 * np.sin(theta), -0.6 * np.cos(theta)])
        assert info["distance_to_target"] == pytest.approx(np.linalg.norm(tip - (2.0, 0.6)))
        assert info["reward_closeness"] == pytest.approx(np.exp(-(info["distance_to_target"] ** 2) / 0.36))
    _, reset_info = env.reset(seed=1)
    assert set(reset_info) == {"distance_to_target"}


def test_what_the_agent_looks_for():
    env = gymnasium.make("ModCartPole-v0")
    assert env.get_wrapper_attr("observation_spec") == ObservationSpec(angles=(1,))


def test_starting_states():
    num_resets = 2000

    def starts(env):
        env.reset(seed=0)
        return np.array([env.reset()[0] for _ in range(num_resets)])

    error = 5 / np.sqrt(num_resets)  # five standard errors, in standard deviations
    centre = starts(SwingUpCartPoleEnv())
    assert np.all(np.abs(centre.mean(0)) < 0.1 * error)
    assert np.all(np.abs(centre.std(0) / 0.1 - 1) < error)
    modified = starts(ModCartPoleEnv())
    assert modified[:, 0].max() == 2.5
    beyond = np.mean(modified[:, 0] == 2.5)  # one standard deviation above the mean lies the end of the rail
    assert beyond == pytest.approx(0.1587, abs=0.37 * error)
    assert np.median(modified[:, 0]) == pytest.approx(2.4, abs=0.1 * 1.26 * error)
    assert np.all(np.abs(modified[:, 1:].mean(0)) < 0.1 * error)
    assert starts(ModCartPoleEnv(start_position=-2.5))[:, 0].min() == -2.5


def test_returns_of_random_and_idle_episodes():
    """Known anchors: about -3 at random and +3 idle on the modified task, -4.5 at random on the plain one.

    Idle, the pole hangs at x = 2.37 on average: 200 exp(-(0.37^2 + 1.2^2) / 0.36) = 2.5.
    """
    num_episodes = 30

    def returns(env_id, stretch):
        env = gymnasium.make(env_id)
        actions = [uniform_actions(env.action_space, 200, seed, stretch) for seed in range(num_episodes)]
        return np.array([play(env, actions[seed], seed)[1].sum() for seed in range(num_episodes)])

    # The action costs 0.01 * E[a^2] = 0.03 a step, 6 an episode; the rest is chance: spread 3.7, 0.5 and 1.0.
    assert returns("ModCartPole-v0", 1.0).mean() == pytest.approx(-3.0, abs=5 * 3.7 / np.sqrt(num_episodes))
    idle = returns("ModCartPole-v0", 0.0)
    assert idle.mean() == pytest.approx(2.5, abs=5 * 0.5 / np.sqrt(num_episodes))
    assert returns("SwingUpCartPole-v0", 1.0).mean() == pytest.approx(-4.5, abs=5 * 1.0 / np.sqrt(num_episodes))


@pytest.mark.parametrize(
    ("name", "value", "received"),
    [
        ("start_position", 2.6, "2.6"),
        ("start_position", float("nan"), "nan"),
        ("target", (1.0, 2.0, 3.0), "(1.0, 2.0, 3.0)"),
        ("target", (1.0, float("inf")), "inf"),
        ("reward_scale", 0.0, "0.0"),
    ],
)
def test_bad_arguments_are_named(name, value, received):
    with pytest.raises(ValueError, match=rf"{name} .*{re.escape(received)}$"):
        ModCartPoleEnv(**{name: value})


def test_arguments_reach_the_task_and_survive_pickling():
    env = gymnasium.make("SwingUpCartPole-v0", target=np.array([0.5, 0.6]), reset_noise_scale=0.0, frame_skip=1)
    for task in (env.unwrapped, pickle.loads(pickle.dumps(env.unwrapped))):
        assert type(task) is SwingUpCartPoleEnv
        np.testing.assert_array_equal(task.reset(seed=0)[0], np.zeros(4))
        assert task.reward_fn.target == (0.5, 0.6)
        assert task.dt == pytest.approx(0.02) and task.metadata["render_fps"] == 50
        np.testing.assert_array_equal(task.model.site("target").pos, [0.5, 0.0, 0.6])
    assert "render_fps" not in ModCartPoleEnv.metadata


def test_documented_starting_state():
    env = gymnasium.make("ModCartPole-v0")
    low, high = re.search(r"limits of (-[\d.]+) and ([\d.]+),", section(ModCartPoleEnv, "Starting state")).groups()
    np.testing.assert_array_equal([float(low), float(high)], env.unwrapped.model.joint("slider").range)
