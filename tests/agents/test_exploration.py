"""The first actions: within their bounds, of the law they are said to have, the same after an interruption."""

import math
import warnings

import gymnasium
import numpy as np
import pytest
import scipy.stats
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv

from gym_dgpmpc.agents.exploration import ExplorationName, chirp_shares, coloured_shares
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.randomness import episode_generator
from tests.agents.point_mass import LENGTH, KnownPointMass, actions_of, agent
from tests.checkpoints.common import load
from tests.checkpoints.test_resume import train
from tests.faults.compare import checkpoint_differences
from tests.oracles.models import seeded
from tests.tasks.test_goals import Goal

CPU = torch.device("cpu")
RANDOM = ExplorationName.__args__


class Wide(KnownPointMass):
    """Two numbers of other bounds, of which one pushes, and no end."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(np.array([-2.0, 1.0]), np.array([2.0, 4.0]), dtype=np.float32)

    def step(self, action):
        after, reward, *_ = super().step(action)
        return after, reward, False, False, {}


def push(observation):
    """A controller of the point mass."""
    assert observation.shape == (2,)
    return [-3.0 * observation[0]]


def explored(steps, env=None, **settings):
    """The random actions [steps, 2]."""
    learner = agent(TimeLimit(Wide() if env is None else env, steps), planner="cem", learning_starts=steps, **settings)
    learner.learn(steps)
    assert learner.dynamics.fits == [steps]
    return actions_of(learner.env.envs[0])


@pytest.mark.parametrize("name", RANDOM)
def test_actions_lie_within_the_bounds_and_fill_them(name):
    actions = explored(300, exploration=name)
    assert actions.dtype == np.float32
    assert (actions >= [-2.0, 1.0]).all() and (actions <= [2.0, 4.0]).all()
    assert (np.ptp(actions, axis=0) > 0.9 * np.array([4.0, 3.0])).all()


def test_uniform_actions_are_those_of_before():
    """The default, and what the generator of exploration gives."""
    for settings in ({}, {"exploration": "uniform", "exploration_beta": 3.0}):
        learner = agent(learning_starts=20, **settings)
        fresh = agent().generators.exploration
        learner.learn(20)
        expected = [-2 + 4 * torch.rand(1, generator=fresh).item() for _ in range(20)]
        np.testing.assert_allclose(actions_of(learner.env.envs[0])[:, 0], expected, rtol=1e-6, atol=1e-6)


def test_held_actions_change_at_their_time_and_are_uniform():
    actions = explored(600, exploration="held", exploration_hold=3).reshape(200, 3, 2)
    assert (actions == actions[:, :1]).all()
    held = actions[:, 0]
    assert (held[1:] != held[:-1]).all()
    for column, low, width in ((0, -2.0, 4.0), (1, 1.0, 3.0)):
        law = scipy.stats.uniform(low, width)
        assert scipy.stats.kstest(held[:, column], law.cdf).statistic < 2.23 / math.sqrt(200)
    assert abs(np.corrcoef(held.T)[0, 1]) < 5 / math.sqrt(200)


@pytest.mark.parametrize("beta", [0.0, 1.0, 2.0])
def test_coloured_actions_are_uniform_at_each_step_and_correlated_over_them(beta):
    """Of normal numbers of correlation r, what the normal distribution function makes of them has 6/pi asin(r/2)."""
    draws, length = 2000, 20
    shares = torch.stack([coloured_shares(length, 1, beta, seeded(i), CPU)[:, 0] for i in range(draws)]).numpy()
    assert scipy.stats.kstest(shares[:, 7], "uniform").statistic < 2.23 / math.sqrt(draws)
    frequency = np.maximum(np.abs(np.fft.fftfreq(length)), 1 / length)
    power = frequency**-beta
    lagged = (power * np.cos(2 * np.pi * np.fft.fftfreq(length))).sum() / power.sum()
    found = np.mean([np.corrcoef(shares[:, t], shares[:, t + 1])[0, 1] for t in range(0, length - 1, 4)])
    assert found == pytest.approx(6 / np.pi * np.arcsin(lagged / 2), abs=5 / math.sqrt(draws))


def test_a_sweep_passes_all_frequencies_with_every_number():
    """Its zeros: one cycle in all steps at first, four steps to a cycle at last; numbers are elsewhere in the sweep."""
    length = 800
    wave = 2 * chirp_shares(length, 3, seeded(), CPU).double().numpy() - 1
    assert np.abs(wave).max() <= 1.0
    first = wave[:, 0]
    crossings = np.flatnonzero(np.diff(np.sign(first)))
    assert np.diff(crossings)[0] > 50 and np.diff(crossings)[-10:].mean() == pytest.approx(2.0, abs=0.3)
    # Half a cycle at each crossing: the integral of the frequency over the sweep.
    cycles = (0.25 - 1 / length) * length / math.log(length / 4)
    assert len(crossings) == pytest.approx(2 * cycles, abs=2)
    assert (np.abs(np.corrcoef(wave.T)[np.triu_indices(3, 1)]) < 0.15).all()
    assert not np.allclose(wave, 2 * chirp_shares(length, 3, seeded(1), CPU).numpy() - 1, atol=0.1)


@pytest.mark.parametrize(
    ("settings", "length"), [({"learning_starts": 12}, 6), ({"train_freq": 8}, 4), ({"learning_starts": 60}, LENGTH)]
)
def test_a_sweep_is_over_the_steps_that_exploration_takes(settings, length):
    """Of each of two environments, or over an episode if that is shorter."""
    env = DummyVecEnv([lambda: TimeLimit(KnownPointMass(), LENGTH)] * 2)
    learner = agent(env, exploration="chirp", **settings).learn(2 * length)
    for index, each in enumerate(learner.env.envs):
        shares = chirp_shares(length, 1, episode_generator(0, index, 0), CPU).numpy()
        np.testing.assert_allclose(actions_of(each)[:length], -2 + 4 * shares, atol=1e-6)


@pytest.mark.parametrize("length", [1, 2, 5])
def test_the_shortest_explorations(length):
    for shares in (coloured_shares(length, 2, 1.0, seeded(), CPU), chirp_shares(length, 2, seeded(), CPU)):
        assert shares.shape == (length, 2) and (shares >= 0).all() and (shares <= 1).all()


@pytest.mark.parametrize("name", RANDOM)
def test_seeds_episodes_and_environments_differ_and_repeat(name):
    def actions(seed, num_envs=1, steps=3 * LENGTH):
        env = DummyVecEnv([KnownPointMass] * num_envs)
        agent(env, exploration=name, exploration_hold=2, learning_starts=steps, seed=seed).learn(steps)
        return [actions_of(each)[:, 0] for each in env.envs]

    (once,), (again,), (other,) = actions(3), actions(3), actions(4)
    np.testing.assert_array_equal(once, again)
    for episodes in ([*once.reshape(3, LENGTH), other[:LENGTH]], actions(3, 2, 2 * LENGTH)):
        assert all(not np.allclose(one, two) for i, one in enumerate(episodes) for two in episodes[:i])


@pytest.mark.parametrize(
    "settings",
    [{"exploration": "held"}, {"exploration": "coloured"}, {"exploration": "chirp"}, {"first_controller": push}],
)
def test_an_exploration_that_was_interrupted_goes_on_exactly(settings, tmp_path):
    settings = {**settings, "exploration_hold": 4, "learning_starts": LENGTH + 6, "total": LENGTH + 8, "logs": False}
    train(tmp_path / "whole", **settings)
    for kill_at in (5, LENGTH + 3):
        train(tmp_path / "parts", kill_at=kill_at, every=4, **settings)
    train(tmp_path / "parts", **settings)
    assert checkpoint_differences(tmp_path / "whole" / "agent.zip", tmp_path / "parts" / "agent.zip") == []
    if "exploration" in settings:
        with pytest.raises(CheckpointError, match=r"exploration was .*, now uniform"):
            train(tmp_path / "parts", **{**settings, "exploration": "uniform"})


def test_the_users_own_controller_takes_the_place_of_random_actions():
    learner = agent(first_controller=push).learn(LENGTH + 2)
    stored = learner.store.transitions()
    expected = (-3 * stored.observation[:LENGTH, 0]).clamp(-2, 2)  # beyond the bounds it is clipped
    torch.testing.assert_close(stored.action[:LENGTH, 0], expected)
    assert (expected == -2).any()
    assert learner.dynamics.fits == [LENGTH]


def test_of_several_environments_it_is_asked_for_each():
    env = DummyVecEnv([lambda: TimeLimit(KnownPointMass(), LENGTH)] * 2)
    learner = agent(env, first_controller=push).learn(2 * LENGTH)
    stored = learner.store.transitions()
    torch.testing.assert_close(stored.action[:, 0], (-3 * stored.observation[:, 0]).clamp(-2, 2))


def test_a_controller_of_dicts_is_given_dicts():
    seen = []

    def controller(observation):
        seen.append(observation)
        return np.zeros(1)

    env = gymnasium.wrappers.TimeLimit(Goal(), LENGTH)
    agent(env, first_controller=controller).learn(3)
    space = env.observation_space
    assert all({key: part.shape for key, part in each.items()} == {k: space[k].shape for k in space} for each in seen)


@pytest.mark.parametrize(
    "returned", [np.zeros(2), [[0.0]], 0.0, np.nan, [np.inf], None, "push", (np.zeros(1), None), [[0.0], [0.0, 1.0]]]
)
def test_what_is_no_action_is_named(returned):
    learner = agent(first_controller=lambda observation: returned)
    with pytest.raises(ValueError, match=r"first_controller .*\(1,\)"):
        learner.learn(3)
    assert len(learner.store) == 0


def test_a_controller_cannot_change_what_is_stored():
    def spoil(observation):
        observation[:] = np.nan
        return np.zeros(1)

    assert agent(first_controller=spoil).learn(5).store.transitions().observation.isfinite().all()


def test_a_file_says_that_there_was_a_controller_and_none_is_needed_once_it_has_learned(tmp_path):
    learner = agent(first_controller=push).learn(3)
    learner.save(tmp_path / "early")
    with pytest.warns(UserWarning, match="first_controller"):
        load(tmp_path / "early")
    learner.learn(2 * LENGTH).save(tmp_path / "later")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = load(tmp_path / "early", first_controller=push)
        load(tmp_path / "later")
        agent().learn(3).save(tmp_path / "without")
        load(tmp_path / "without")
    loaded.learn(LENGTH)
    stored = loaded.store.transitions()
    torch.testing.assert_close(stored.action[:, 0], (-3 * stored.observation[:, 0]).clamp(-2, 2))


@pytest.mark.parametrize(
    ("arguments", "error", "value"),
    [
        ({"exploration": "gaussian"}, ValueError, "exploration .*held.*'gaussian'"),
        ({"exploration_hold": 0}, ValueError, "exploration_hold .*0"),
        ({"exploration_beta": -1.0}, ValueError, r"exploration_beta .*-1\.0"),
        ({"first_controller": 3}, TypeError, "first_controller .*3"),
    ],
)
def test_settings_are_checked_when_the_agent_is_made(arguments, error, value, unchecked):
    with pytest.raises(error, match=value):
        agent(**arguments)
