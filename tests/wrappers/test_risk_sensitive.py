"""Risk-sensitive rewards: planned with, reported beside the task's own, on any environment with a known reward."""

import math

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env

from gym_dgpmpc.envs import HalfCheetahReward, SwingUpCartPoleEnv, VelocityHalfCheetahEnv
from gym_dgpmpc.types import ObservationSpec, RewardFn
from gym_dgpmpc.wrappers import RiskSensitiveReward
from tests.envs.common import play, uniform_actions


def tumbling(penalise_step):
    """The cheetah, begun with a spin, so that its pitch goes through many bands; observations, actions, the rest."""
    env = gymnasium.make("RiskSensitiveHalfCheetah-v0", penalise_step=penalise_step)
    observations, steps = [env.reset(seed=0)[0]], []
    env.unwrapped.set_state(np.eye(9)[1] * 2.0, np.eye(9)[2] * 5.0)
    actions = uniform_actions(env.action_space, 60, seed=0)
    for action in actions:
        observation, reward, *_, info = env.step(action)
        observations.append(observation)
        steps.append((reward, info))
    observations, actions = torch.as_tensor(np.array(observations)), torch.as_tensor(actions)
    return env, (observations[:-1], actions, observations[1:]), steps


def one_by_one(reward_fn, transitions):
    return [reward_fn(*row).item() for row in zip(*transitions, strict=True)]


@pytest.mark.parametrize("penalise_step", [False, True])
def test_both_rewards_exactly(penalise_step):
    env, transitions, steps = tumbling(penalise_step)
    planned = one_by_one(env.get_wrapper_attr("reward_fn"), transitions)
    original = one_by_one(env.unwrapped.reward_fn, transitions)
    assert [info["reward_original"] for _, info in steps] == original
    assert [info["reward_risk_sensitive"] for _, info in steps] == planned
    assert [reward for reward, _ in steps] == (planned if penalise_step else original)
    # The paper's penalty, in Python's own arithmetic.
    penalties = [math.floor(abs(pitch) / (math.pi / 9)) for pitch in transitions[2][:, 2].tolist()]
    assert max(penalties) > 3 and min(penalties) == 0
    np.testing.assert_allclose(np.subtract(original, planned), penalties, atol=1e-12)
    batched = env.get_wrapper_attr("reward_fn")(*transitions)
    torch.testing.assert_close(batched, torch.tensor(planned, dtype=torch.float64), rtol=0, atol=1e-13)


def test_penalty_by_hand():
    reward_fn = RiskSensitiveReward(VelocityHalfCheetahEnv(ctrl_cost_weight=0.0), angle_index=2).reward_fn
    assert isinstance(reward_fn, RewardFn)
    after = torch.zeros(7, 18, dtype=torch.float64)
    degrees = torch.tensor([0.0, 19.9, -19.9, 20.1, -40.1, 180.1, 720.1])
    after[:, 2] = torch.deg2rad(degrees)
    reward = reward_fn(after, torch.zeros(7, 6), after)
    assert reward.tolist() == [0.0, 0.0, 0.0, -1.0, -2.0, -9.0, -36.0]
    assert torch.isnan(reward_fn(after, torch.zeros(7, 6), after.fill_(torch.nan))).all()  # stays a failure to be seen


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrapped_it_counts_from_the_nearest_full_turn(dtype):
    env = gymnasium.make("RiskSensitiveHalfCheetah-v0", ctrl_cost_weight=0.0, wrap=True)
    after = torch.zeros(8, 18, dtype=dtype)
    degrees = torch.tensor([19.9, -20.1, 179.0, 181.0, 339.0, 361.0, -720.1, 750.0], dtype=dtype)
    after[:, 2] = torch.deg2rad(degrees)
    reward = env.get_wrapper_attr("reward_fn")(after, torch.zeros(8, 6), after)
    assert reward.tolist() == [0.0, -1.0, -8.0, -8.0, -1.0, 0.0, 0.0, -1.0]
    env.reset(seed=0)
    env.unwrapped.set_state(np.eye(9)[2] * 2 * np.pi, np.zeros(9))
    *_, info = env.step(np.zeros(6, np.float32))
    assert info["reward_risk_sensitive"] == info["reward_original"]
    assert torch.isnan(env.get_wrapper_attr("reward_fn")(after, torch.zeros(8, 6), after.fill_(torch.nan))).all()


def test_the_rest_is_as_it_was():
    plain, wrapped = gymnasium.make("VelocityHalfCheetah-v0"), gymnasium.make("RiskSensitiveHalfCheetah-v0")
    actions = uniform_actions(plain.action_space, 30, seed=0)
    plain, risk_sensitive = play(plain, actions, seed=0), play(wrapped, actions, seed=0)
    np.testing.assert_array_equal(plain[0], risk_sensitive[0])
    np.testing.assert_array_equal(plain[1], risk_sensitive[1])
    assert [set(there) - set(here) for here, there in zip(plain[2], risk_sensitive[2], strict=True)] == [
        {"reward_original", "reward_risk_sensitive"}
    ] * 30
    assert wrapped.get_wrapper_attr("observation_spec") == ObservationSpec((2,), (0,), (0,))


def test_arguments_of_the_registered_task():
    env = gymnasium.make("RiskSensitiveHalfCheetah-v0", ctrl_cost_weight=0.5, penalise_step=True)
    for same in (env, gymnasium.make(env.spec), gymnasium.make(EnvSpec.from_json(env.spec.to_json()))):
        assert same.unwrapped.reward_fn == HalfCheetahReward(0.5)
        assert str(same).count("RiskSensitiveReward") == 1
        same.reset(seed=0)
        same.unwrapped.set_state(np.eye(9)[1] + np.eye(9)[2] * 3.0, np.zeros(9))
        _, reward, *_, info = same.step(np.zeros(6, np.float32))
        assert reward == info["reward_risk_sensitive"] == info["reward_original"] - 8  # 8 * 20 < 172 < 9 * 20 degrees


def test_an_agent_finds_the_penalised_reward_through_vector_environments():
    vec_env = make_vec_env("RiskSensitiveHalfCheetah-v0", n_envs=2, seed=0)
    reward_fn = vec_env.get_attr("reward_fn")[0]
    upside_down = torch.zeros(18).index_fill(0, torch.tensor([2]), 3.0)
    assert reward_fn(upside_down, torch.zeros(6), upside_down) == -8
    vector_env = gymnasium.make_vec("RiskSensitiveHalfCheetah-v0", num_envs=2, penalise_step=True)
    vector_env.reset(seed=0)
    _, rewards, *_, infos = vector_env.step(np.zeros((2, 6), np.float32))
    np.testing.assert_array_equal(rewards, infos["reward_risk_sensitive"])


def test_on_another_environment():
    env = RiskSensitiveReward(SwingUpCartPoleEnv(reset_noise_scale=0.0), 1, angle_step=0.5, penalise_step=True)
    env.reset(seed=0)
    env.unwrapped.set_state(np.array([0.0, 1.2]), np.zeros(2))
    observation, reward, *_, info = env.step(np.zeros(1, np.float32))
    assert reward == info["reward_original"] - math.floor(observation[1] / 0.5) == info["reward_original"] - 2


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_on_a_known_task_of_gymnasiums():
    env = RiskSensitiveReward(gymnasium.make("InvertedPendulum-v5"), angle_index=1, angle_step=0.05, penalise_step=True)
    sb3_check_env(env, skip_render_check=True)
    env.reset(seed=0)
    env.unwrapped.set_state(np.array([0.0, 0.12]), np.zeros(2))
    observation, reward, terminated, _, info = env.step(np.zeros(1, np.float32))
    assert not terminated and info["reward_original"] == 1.0 and type(reward) is float
    assert reward == 1 - math.floor(observation[1] / 0.05) == -1


class Bare(gymnasium.Env):
    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))


class Picture(Bare):
    observation_space = spaces.Box(0, 255, (4, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("env", "arguments", "message"),
    [
        (Bare, {"angle_index": 0}, "Bare.*'reward_fn'"),
        (Picture, {"angle_index": 0}, r"observations .*Box\(0, 255, \(4, 4, 3\)"),
        (VelocityHalfCheetahEnv, {"angle_index": 18}, r"angle_index .*\b17\b.* 18$"),
        (VelocityHalfCheetahEnv, {"angle_index": -1}, r"angle_index .*\b17\b.* -1$"),
        (VelocityHalfCheetahEnv, {"angle_index": 2, "angle_step": 0.0}, r"angle_step .* 0\.0$"),
        (VelocityHalfCheetahEnv, {"angle_index": 2, "angle_step": math.inf}, "angle_step .* inf$"),
        (lambda: gymnasium.make("HalfCheetah-v5"), {"angle_index": 1}, "HalfCheetah.*'reward_fn'"),
    ],
)
def test_bad_arguments_are_named(env, arguments, message):
    with pytest.raises(ValueError, match=message):
        RiskSensitiveReward(env(), **arguments)


def test_an_index_of_a_wrong_type_is_named(unchecked):
    with pytest.raises(ValueError, match=r"angle_index .* 1\.5$"):
        RiskSensitiveReward(VelocityHalfCheetahEnv(), angle_index=1.5)
