"""The cart-pole tasks keep Gymnasium's contract, know their own reward and say the truth in their documentation."""

import ast
import inspect
import pickle
import re

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from gym_dgpmpc.envs import ModCartPoleEnv, SwingUpCartPoleEnv
from gym_dgpmpc.types import ObservationSpec

IDS = ["ModCartPole-v0", "SwingUpCartPole-v0"]
CLASSES = [ModCartPoleEnv, SwingUpCartPoleEnv]


def play(env, actions, seed):
    """Observations (T+1, 4), rewards and infos of one episode."""
    observations, rewards, infos = [env.reset(seed=seed)[0]], [], []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
        assert not terminated
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    return np.array(observations), np.array(rewards), infos


def uniform_actions(num_steps, seed, bound=3.0):
    return np.random.default_rng(seed).uniform(-bound, bound, (num_steps, 1)).astype(np.float32)


@pytest.mark.filterwarnings("ignore:.*normalized:UserWarning", "ignore:.*infinity:UserWarning")
@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_and_sb3_accept_it(env_id):
    env = gymnasium.make(env_id)
    check_env(env.unwrapped, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_same_episode(env_id):
    first, second = (play(gymnasium.make(env_id), uniform_actions(50, 0), seed=3) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    assert not np.array_equal(first[0][0], play(gymnasium.make(env_id), [], seed=4)[0][0])


def test_an_episode_has_200_steps():
    env = gymnasium.make("ModCartPole-v0")
    env.reset(seed=0)
    truncations = [env.step(np.zeros(1, np.float32))[3] for _ in range(200)]
    assert truncations == [False] * 199 + [True]
    assert env.unwrapped.dt == pytest.approx(0.04)


@pytest.mark.parametrize("env_id", IDS)
def test_step_pays_exactly_what_reward_fn_says(env_id):
    env = gymnasium.make(env_id)
    reward_fn = env.get_wrapper_attr("reward_fn")
    actions = np.stack([uniform_actions(200, seed, bound=5.0) for seed in range(5)])  # some beyond the bounds
    episodes = [play(env, actions[seed], seed) for seed in range(5)]

    observations = torch.as_tensor(np.stack([episode[0] for episode in episodes]))
    rewards = torch.as_tensor(np.stack([episode[1] for episode in episodes]))
    before, after = observations[:, :-1], observations[:, 1:]
    one_by_one = [
        [reward_fn(before[e, t], torch.as_tensor(actions[e, t]), after[e, t]).item() for t in range(200)]
        for e in range(5)
    ]
    assert one_by_one == rewards.tolist()
    # A processor may round the elements of a batch differently by a unit in the last place.
    batched = reward_fn(before, torch.as_tensor(actions), after)
    torch.testing.assert_close(batched, rewards, rtol=0, atol=1e-15)
    single = reward_fn(before.float(), torch.as_tensor(actions), after.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), rewards, rtol=0, atol=1e-5)


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
    observations, rewards, infos = play(env, uniform_actions(30, 1), seed=1)
    for observation, reward, info in zip(observations[1:], rewards, infos, strict=True):
        assert info["reward_closeness"] + info["reward_control"] == reward
        x, theta = observation[:2]
        tip = np.array([x - 0.6 * np.sin(theta), -0.6 * np.cos(theta)])
        assert info["distance_to_target"] == pytest.approx(np.linalg.norm(tip - (2.0, 0.6)))
        assert info["reward_closeness"] == pytest.approx(np.exp(-(info["distance_to_target"] ** 2) / 0.36))
    _, reset_info = env.reset(seed=1)
    assert set(reset_info) == {"distance_to_target"}


def test_returned_objects_are_fresh():
    env = ModCartPoleEnv()
    observation, info = env.reset(seed=0)
    kept, kept_info = observation.copy(), dict(info)
    next_observation, _, _, _, next_info = env.step(np.array([-3.0], np.float32))
    env.step(np.array([-3.0], np.float32))
    np.testing.assert_array_equal(observation, kept)
    assert info == kept_info and next_info is not info
    assert not np.shares_memory(next_observation, env.data.qpos)


def test_actions_are_clipped_for_dynamics_and_reward():
    outcomes = []
    for action in (-3.0, -50.0):
        env = ModCartPoleEnv()
        env.reset(seed=0)
        outcomes.append(env.step(np.array([action], np.float32)))
    np.testing.assert_array_equal(outcomes[0][0], outcomes[1][0])
    assert outcomes[0][1] == outcomes[1][1]
    assert outcomes[1][4]["reward_control"] == pytest.approx(-0.09)


def test_the_action_of_the_caller_is_not_changed():
    env = ModCartPoleEnv()
    env.reset(seed=0)
    action = np.array([7.0], np.float32)
    env.step(action)
    assert action[0] == 7.0


@pytest.mark.parametrize("action", [np.array([np.nan], np.float32), np.zeros(2, np.float32), np.zeros((1, 1))])
def test_bad_actions_are_refused(action):
    env = ModCartPoleEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=re.escape(repr(action))):
        env.step(action)


def test_what_the_agent_looks_for():
    env = gymnasium.make("ModCartPole-v0")
    assert env.get_wrapper_attr("observation_spec") == ObservationSpec(angles=(1,))
    assert not env.has_wrapper_attr("terminated_fn")


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

    def returns(env_id, bound):
        env = gymnasium.make(env_id)
        episodes = [play(env, uniform_actions(200, seed, bound), seed)[1].sum() for seed in range(num_episodes)]
        return np.array(episodes)

    # The action costs 0.01 * E[a^2] = 0.03 a step, 6 an episode; the rest is chance: spread 3.7, 0.5 and 1.0.
    assert returns("ModCartPole-v0", 3.0).mean() == pytest.approx(-3.0, abs=5 * 3.7 / np.sqrt(num_episodes))
    idle = returns("ModCartPole-v0", 0.0)
    assert idle.mean() == pytest.approx(2.5, abs=5 * 0.5 / np.sqrt(num_episodes))
    assert returns("SwingUpCartPole-v0", 3.0).mean() == pytest.approx(-4.5, abs=5 * 1.0 / np.sqrt(num_episodes))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start_position": 2.6}, "start_position must lie on the rail, in [-2.5, 2.5]; got 2.6"),
        ({"start_position": float("nan")}, "start_position must be a finite number; got nan"),
        ({"target": (1.0, 2.0, 3.0)}, "target must be two finite numbers, x and z in m; got (1.0, 2.0, 3.0)"),
        ({"target": (1.0, float("inf"))}, "target must be a finite number; got inf"),
        ({"reset_noise_scale": -0.1}, "reset_noise_scale must not be negative; got -0.1"),
        ({"reward_scale": 0.0}, "reward_scale must be positive; got 0.0"),
        ({"ctrl_cost_weight": -1.0}, "ctrl_cost_weight must not be negative; got -1.0"),
        ({"frame_skip": 0}, "frame_skip must be a positive integer; got 0"),
        ({"width": -1}, "width must be a positive integer; got -1"),
        ({"render_mode": "ascii"}, "got 'ascii'"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ModCartPoleEnv(**arguments)


def test_arguments_reach_the_task_and_survive_pickling():
    env = gymnasium.make("SwingUpCartPole-v0", target=np.array([0.5, 0.6]), reset_noise_scale=0.0, frame_skip=1)
    for task in (env.unwrapped, pickle.loads(pickle.dumps(env.unwrapped))):
        assert type(task) is SwingUpCartPoleEnv
        np.testing.assert_array_equal(task.reset(seed=0)[0], np.zeros(4))
        assert task.reward_fn.target == (0.5, 0.6)
        assert task.dt == pytest.approx(0.02) and task.metadata["render_fps"] == 50
        np.testing.assert_array_equal(task.model.site("target").pos, [0.5, 0.0, 0.6])
    assert "render_fps" not in ModCartPoleEnv.metadata


# --- documentation ---------------------------------------------------------------------------------------------------


def section(cls, title):
    return inspect.getdoc(cls).split(f"## {title}\n")[1].split("\n## ")[0]


def table(cls, title):
    """The rows of a section's table, header and rule left out, each a list of cells."""
    rows = [line for line in section(cls, title).splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


@pytest.mark.parametrize("cls", CLASSES)
def test_documented_arguments_are_the_signature(cls):
    documented = {row[0].strip("`"): ast.literal_eval(row[2].strip("`")) for row in table(cls, "Arguments")}
    parameters = inspect.signature(cls).parameters.values()
    assert documented == {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}


def test_documented_spaces_are_the_spaces():
    env = ModCartPoleEnv()
    for title, space in (("Action space", env.action_space), ("Observation space", env.observation_space)):
        assert section(ModCartPoleEnv, title).startswith(f"`{space}`")
        rows = table(ModCartPoleEnv, title)
        assert [int(row[0]) for row in rows] == list(range(space.shape[0]))
        np.testing.assert_array_equal([float(row[2]) for row in rows], space.low)
        np.testing.assert_array_equal([float(row[3]) for row in rows], space.high)
        for row in rows:
            kind, name = re.fullmatch(r"(\w+) \((\w+)\)", row[4]).groups()
            assert int(env.model.joint(name).type[0]) == {"slide": 2, "hinge": 3}[kind]


def test_documented_episode_and_starting_state():
    env = gymnasium.make("ModCartPole-v0")
    steps, seconds = re.search(r"after (\d+) steps of ([\d.]+) s", section(ModCartPoleEnv, "Episode end")).groups()
    assert (int(steps), float(seconds)) == (env.spec.max_episode_steps, pytest.approx(env.unwrapped.dt))
    low, high = re.search(r"limits of (-[\d.]+) and ([\d.]+),", section(ModCartPoleEnv, "Starting state")).groups()
    np.testing.assert_array_equal([float(low), float(high)], env.unwrapped.model.joint("slider").range)
