"""The store as arrays, as a replay buffer and as a Minari dataset, and back into a fresh agent."""

import sys

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from gym_dgpmpc.errors import EnvironmentDataError
from gym_dgpmpc.tasks.dict_observations import original_space
from gym_dgpmpc.tasks.exported import arrays, minari_dataset, replay_buffer
from tests.agents.point_mass import LENGTH, KnownPointMass, agent
from tests.tasks.test_goals import Goal

NAMES = ("observation", "action", "next_observation", "reward", "terminated", "episode")
pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning:minari.*"),  # of metadata that are left out
    pytest.mark.filterwarnings("ignore:the environment ended an episode by termination:UserWarning"),
]

ROUNDING = np.finfo(np.float32).eps * 4.0
"""Of an action in [-2, 2] that was scaled: half an eps of at most 1 in the buffer, times 2, and half an eps of at most
2 in the store."""


class Ending(Goal):
    """Terminates where the point is too far off."""

    def step(self, action):
        seen, reward, _, truncated, info = super().step(action)
        terminated = abs(self.state[0]) > 0.7
        return seen, reward, bool(terminated), truncated and not terminated, info


class EndingPoint(KnownPointMass):
    def __init__(self):
        super().__init__(terminate_beyond=1.2)


ENVIRONMENTS = {"box": EndingPoint, "dict": Ending}


@pytest.fixture(params=ENVIRONMENTS)
def env(request):
    return ENVIRONMENTS[request.param]


def at_random(env, num_steps=3 * LENGTH + 3):
    """An agent that has only explored, so that its steps are random and its last episode is running."""
    return agent(env, learning_starts=1000).learn(num_steps)


def export(function, learner, *arguments, **options):
    space = original_space(learner.env, learner.observation_space)
    return function(learner.store, space, learner.action_space, *arguments, **options)


def rows_of(store):
    return dict(zip(NAMES, (*store.transitions(), store.rewards, store.terminated, store.episodes), strict=True))


def one_episode_after_the_other(rows):
    """The rows in the order of their episodes, which are numbered from 0 on."""
    order = torch.argsort(rows["episode"], stable=True)
    sorted_rows = {name: column[order] for name, column in rows.items()}
    return sorted_rows | {"episode": sorted_rows["episode"].unique(return_inverse=True)[1]}


def assert_equal_but_for_rounding(rows, expected, rounding=0.0):
    for name in NAMES:
        tolerance = rounding if name == "action" else 0.0
        torch.testing.assert_close(rows[name], expected[name], rtol=0.0, atol=tolerance)


def read_back(data, env):
    learner = agent(env())
    learner.add_transitions(data)
    return rows_of(learner.store)


def test_the_episodes_of_these_tests_end_in_every_way(env):
    """Otherwise the tests below would hold little."""
    store = at_random(env()).store
    ends = np.flatnonzero(np.diff(store.episodes.numpy()))
    terminated = store.terminated.numpy()
    assert terminated[ends].any() and not terminated[ends].all() and not terminated[-1]


def test_arrays_there_and_back(env):
    learner = at_random(env())
    data = export(arrays, learner)
    assert_equal_but_for_rounding(read_back(data, env), rows_of(learner.store))
    parts = data["observation"]
    assert isinstance(parts, dict) == (env is Ending)
    assert data["action"].dtype == np.float32
    # The spaces are of float64, the store is of float32.
    assert {part.dtype for part in (parts.values() if isinstance(parts, dict) else [parts])} == {np.dtype(np.float64)}


def test_steps_of_several_environments_there_and_back(env):
    """They are stored in turns; arrays keep that, a buffer of one environment does not."""
    learner = at_random(make_vec_env(env, n_envs=3, seed=1), 3 * LENGTH)
    stored = rows_of(learner.store)
    assert (stored["episode"].diff() < 0).any()
    assert_equal_but_for_rounding(read_back(export(arrays, learner), env), stored)
    buffer = export(replay_buffer, learner)
    assert buffer.n_envs == 1
    assert_equal_but_for_rounding(read_back(buffer, env), one_episode_after_the_other(stored), ROUNDING)


def test_arrays_are_copies(env):
    learner = at_random(env())
    before = {name: column.clone() for name, column in rows_of(learner.store).items()}
    data = export(arrays, learner)
    for column in data.values():
        for part in column.values() if isinstance(column, dict) else [column]:
            part[...] = 0
    assert_equal_but_for_rounding(rows_of(learner.store), before)


@pytest.mark.parametrize("buffer_size", [None, 5, 100])
def test_a_replay_buffer_there_and_back(env, buffer_size):
    learner = at_random(env())
    buffer = export(replay_buffer, learner, buffer_size, device="cpu")
    count = len(learner.store)
    assert type(buffer) is (DictReplayBuffer if env is Ending else ReplayBuffer)
    assert buffer.size() == count and buffer.buffer_size == max(count, buffer_size or 0)
    assert np.abs(buffer.actions).max() <= 1.0 and np.abs(buffer.actions).max() > 0.9
    expected = one_episode_after_the_other(rows_of(learner.store))
    assert_equal_but_for_rounding(read_back(buffer, env), expected, ROUNDING)


def test_a_replay_buffer_tells_truncations_from_terminations():
    learner = at_random(EndingPoint())
    buffer, episode, terminated = export(replay_buffer, learner), learner.store.episodes, learner.store.terminated
    is_last = torch.cat([episode.diff() > 0, torch.ones(1, dtype=torch.bool)]).numpy()
    np.testing.assert_array_equal(buffer.dones[:, 0], is_last)
    np.testing.assert_array_equal(buffer.timeouts[:, 0], is_last & ~terminated.numpy())


@pytest.mark.parametrize(("make", "policy"), [(EndingPoint, "MlpPolicy"), (Ending, "MultiInputPolicy")])
def test_sac_trains_on_the_buffer_and_adds_to_it(make, policy):
    learner = at_random(make())
    algorithm = SAC(policy, make(), buffer_size=1, learning_starts=0, batch_size=16, seed=0, device="cpu")
    algorithm.replay_buffer = export(replay_buffer, learner, 50, device="cpu")
    before = [parameter.detach().clone() for parameter in algorithm.actor.parameters()]
    algorithm.set_logger(configure(None, []))
    algorithm.train(gradient_steps=1, batch_size=16)
    after = list(algorithm.actor.parameters())
    assert any(not torch.equal(*pair) for pair in zip(before, after, strict=True))
    assert all(parameter.isfinite().all() for parameter in after)
    algorithm.learn(2)
    assert algorithm.replay_buffer.size() == len(learner.store) + 2


def test_a_minari_dataset_there_and_back(env, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    learner = at_random(make_vec_env(env, n_envs=2, seed=1), 4 * LENGTH)
    export(minari_dataset, learner, "tests/exported-v0", algorithm_name="DGP-MPC")
    dataset = minari.load_dataset("tests/exported-v0")
    expected = one_episode_after_the_other(rows_of(learner.store))
    assert_equal_but_for_rounding(read_back(dataset, env), expected)
    assert dataset.spec.observation_space == env().observation_space
    assert dataset.spec.action_space == env().action_space
    assert dataset.storage.metadata["algorithm_name"] == "DGP-MPC"
    for episode in dataset.iterate_episodes():
        ends = episode.terminations | episode.truncations
        assert ends.tolist() == [False] * (len(ends) - 1) + [True]
        assert not (episode.terminations & episode.truncations).any()
    with pytest.raises(ValueError, match="tests/exported-v0"):
        export(minari_dataset, learner, "tests/exported-v0")


def test_rows_that_do_not_follow_each_other_are_episodes_of_their_own(tmp_path, monkeypatch):
    """Arrays without episode numbers are stored as one episode, although a step may begin anywhere."""
    learner = at_random(EndingPoint())
    data = export(arrays, learner)
    del data["episode"]
    kept = np.delete(np.arange(len(learner.store)), [3])
    fresh = agent(EndingPoint())
    fresh.add_transitions({name: column[kept] for name, column in data.items()})
    assert fresh.store.episodes.unique().tolist() == [0]
    stored = rows_of(learner.store)
    ends = [2, *(np.flatnonzero(stored["episode"].diff().numpy()) - 1), len(kept) - 1]
    buffer = export(replay_buffer, fresh)
    assert np.flatnonzero(buffer.dones[:, 0]).tolist() == ends
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = export(minari_dataset, fresh, "tests/holes-v0")
    assert [len(episode) for episode in dataset.iterate_episodes()] == np.diff([-1, *ends]).tolist()


@pytest.mark.parametrize("function", [arrays, replay_buffer, lambda *of: minari_dataset(*of, "tests/empty-v0")])
def test_an_empty_store_is_refused(function, tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with pytest.raises(EnvironmentDataError, match=r"\b0\b"):
        export(function, agent())
    assert list(tmp_path.iterdir()) == []


def test_without_minari_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r'pip install "gym-dgpmpc\[minari\]"'):
        export(minari_dataset, at_random(EndingPoint(), 3), "tests/point-v0")


def test_actions_are_exported_as_their_space_contains_them():
    class Fixed(KnownPointMass):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(0.1, 0.1, (1,), np.float64)

    learner = at_random(Fixed())
    assert all(learner.action_space.contains(action) for action in learner.to_arrays()["action"])
    assert np.isfinite(learner.to_replay_buffer().actions).all()
    read_back(learner.to_arrays(), Fixed)


def test_actions_of_two_dimensions_and_unequal_bounds(tmp_path, monkeypatch):
    class Grid(KnownPointMass):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(-2.0, 2.0, (1, 1), np.float64)

        def step(self, action):
            return super().step(action[0])

    learner = at_random(Grid())
    stored, data = rows_of(learner.store), export(arrays, learner)
    assert data["action"].shape == (len(learner.store), 1, 1) and data["action"].dtype == np.float64
    assert_equal_but_for_rounding(read_back(data, Grid), stored)
    low, high = np.array([[-2.0]]), np.array([[2.5]])
    buffer = replay_buffer(learner.store, learner.observation_space, spaces.Box(low, high, dtype=np.float64))
    expected = 2.0 * (stored["action"].double() + 2.0) / 4.5 - 1.0
    np.testing.assert_allclose(buffer.actions[:, 0], expected, atol=2 * np.finfo(np.float32).eps)
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert_equal_but_for_rounding(read_back(export(minari_dataset, learner, "tests/grid-v0"), Grid), stored)
