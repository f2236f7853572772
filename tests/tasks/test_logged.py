"""Transitions from elsewhere: arrays, SB3's buffers and Minari's datasets, in place of random actions."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from gym_dgpmpc.errors import EnvironmentDataError
from tests.agents.point_mass import LENGTH, KnownPointMass, PointMass, agent, reward_fn
from tests.tasks.test_goals import Goal


def played(num_steps=2 * LENGTH, seed=0):
    """Random actions on the point mass, as columns."""
    env, generator = KnownPointMass(), np.random.default_rng(seed)
    rewards, terminated = [], []
    env.reset(seed=seed)
    for _ in range(num_steps):
        _, reward, end, truncated, _ = env.step(generator.uniform(-2, 2, 1))
        rewards.append(reward)
        terminated.append(end)
        if truncated:
            env.reset()
    columns = [np.array(column) for column in zip(*env.steps, strict=True)]
    names = ("observation", "action", "next_observation")
    return dict(zip(names, columns, strict=True)) | {"reward": np.array(rewards), "terminated": np.array(terminated)}


def assert_stored(learner, data):
    names = ("observation", "action", "next_observation")
    for name, stored in zip(names, learner.store.transitions(), strict=True):
        np.testing.assert_allclose(stored[: len(data[name])], data[name], atol=1e-6)
    np.testing.assert_allclose(learner.store.rewards[: len(data["reward"])], data["reward"], atol=1e-6)


def test_arrays_take_the_place_of_the_random_episode():
    data, learner = played(), agent()
    learner.add_transitions(data)
    assert len(learner.store) == 2 * LENGTH and learner.num_timesteps == 0
    assert not learner.is_exploring
    learner.learn(LENGTH + 2)
    assert learner.dynamics.fits == [20, 30]
    assert learner.num_timesteps == LENGTH + 2
    assert learner.store.episodes.tolist() == [0] * 20 + [1] * 10 + [2] * 2
    assert_stored(learner, data)
    # Planned from the first step on: standing still would cost more.
    assert learner.store.rewards[20:30].sum() > -3.0


def test_arrays_with_the_numbers_of_their_episodes():
    """Whatever the numbers are, the store's go on from those that it has."""
    data, learner = played(), agent().learn(13)
    learner.add_transitions({**data, "episode": np.where(np.arange(20) % 2, 7, -3)})
    assert learner.store.episodes.tolist() == [0] * 10 + [1] * 3 + [2, 3] * 10


def test_tensors_and_data_in_the_middle_of_a_run():
    data = {name: torch.as_tensor(value) for name, value in played().items() if name != "terminated"}
    learner = agent().learn(13)
    learner.add_transitions(data)
    learner.learn(10, reset_num_timesteps=False)
    assert learner.dynamics.fits == [10, 40]
    assert learner.store.episodes.tolist() == [0] * 10 + [1] * 3 + [2] * 20 + [1] * 7 + [3] * 3


def test_logged_steps_count_for_learning_starts():
    learner = agent(learning_starts=25)
    learner.add_transitions(played())
    assert learner.is_exploring
    learner.learn(10)
    assert learner.dynamics.fits == [25, 30]


def buffer_of(data, size, num_envs=1, **arguments):
    env = KnownPointMass()
    buffer = ReplayBuffer(size, env.observation_space, env.action_space, "cpu", n_envs=num_envs, **arguments)
    for i in range(0, len(data["reward"]) - num_envs + 1, num_envs):
        rows = slice(i, i + num_envs)
        truncated = [(row + 1) % LENGTH == 0 for row in range(i, i + num_envs)]
        infos = [{"TimeLimit.truncated": each} for each in truncated]
        columns = (data[name][rows] for name in ("observation", "next_observation"))
        scaled = data["action"][rows] / 2.0
        buffer.add(*columns, scaled, data["reward"][rows], np.array(truncated), infos)
    return buffer


@pytest.mark.parametrize("size", [30, 20, 13])
def test_a_replay_buffer_full_or_not(size):
    """SB3 keeps actions scaled to [-1, 1]; a buffer that is full begins somewhere in the middle."""
    data, learner = played(), agent()
    learner.add_transitions(buffer_of(data, size))
    kept = {name: value[-size:] for name, value in data.items()}
    assert_stored(learner, kept)
    assert not learner.store.terminated.any()
    expected = [i // LENGTH for i in range(2 * LENGTH)][-size:]
    assert learner.store.episodes.tolist() == [e - expected[0] for e in expected]


@pytest.mark.parametrize("size", [30, 13])
def test_a_replay_buffer_that_saves_memory(size):
    data, learner = played(), agent()
    buffer = buffer_of(data, size, optimize_memory_usage=True, handle_timeout_termination=False)
    learner.add_transitions(buffer)
    # A full buffer has lost the oldest step's observation; what the first of two episodes ended in is lost in any case.
    kept = np.array([step for step in range(0 if size == 30 else 8, 20) if step != LENGTH - 1])
    assert_stored(learner, {name: column[kept] for name, column in data.items()})
    assert len(learner.store) == len(kept)
    assert learner.store.episodes.tolist() == [step // LENGTH for step in kept]


def test_the_buffer_of_an_algorithm_and_of_several_environments():
    algorithm = TD3("MlpPolicy", KnownPointMass(), buffer_size=50, learning_starts=100, seed=0).learn(25)
    learner = agent()
    learner.add_transitions(algorithm.replay_buffer)
    torch.testing.assert_close(learner.store.rewards, reward_fn(*learner.store.transitions()), rtol=1e-4, atol=1e-5)
    assert learner.store.transitions().action.abs().max() > 1.2
    data, learner = played(), agent()
    learner.add_transitions(buffer_of(data, 40, num_envs=2))
    np.testing.assert_allclose(learner.store.rewards[:10], data["reward"][::2], atol=1e-6)
    assert learner.store.episodes.tolist() == [0] * 10 + [1] * 5 + [2] * 5


def test_the_scale_of_actions_can_be_said():
    data = played()
    learner = agent()
    learner.add_transitions({**data, "action": data["action"] / 2}, scaled_actions=True)
    assert_stored(learner, data)
    learner = agent()
    learner.add_transitions(buffer_of({**data, "action": data["action"] * 2}, 20), scaled_actions=False)
    assert_stored(learner, data)


def test_a_dict_replay_buffer():
    env, generator = Goal(), np.random.default_rng(0)
    buffer = DictReplayBuffer(20, env.observation_space, env.action_space, "cpu")
    before, _ = env.reset(seed=0)
    for _ in range(8):
        action = generator.uniform(-2, 2, 1)
        after, reward, *_ = env.step(action)
        buffer.add(before, after, action / 2, np.array([reward]), np.array([False]), [{}])
        before = after
    learner = agent(Goal())
    learner.add_transitions(buffer)
    stored = learner.store.transitions()
    torch.testing.assert_close(learner.task.functions.reward_fn(*stored), learner.store.rewards)
    assert len(stored.observation.unique(dim=0)) == 8
    as_arrays = {
        "observation": {key: part[:8, 0] for key, part in buffer.observations.items()},
        "next_observation": {key: part[:8, 0] for key, part in buffer.next_observations.items()},
        "action": buffer.actions[:8, 0] * 2,
        "reward": buffer.rewards[:8, 0],
    }
    other = agent(Goal())
    other.add_transitions(as_arrays)
    assert torch.equal(other.store.transitions().next_observation, stored.next_observation)


class Episodes:
    """As a Minari dataset gives them."""

    def __init__(self, data, ends):
        self.episodes = []
        for first, last in zip([0, *ends], ends, strict=False):
            observations = np.concatenate([data["observation"][first:last], data["next_observation"][last - 1 : last]])
            self.episodes.append(
                SimpleNamespace(
                    observations=observations,
                    actions=data["action"][first:last],
                    rewards=data["reward"][first:last],
                    terminations=np.arange(first, last) == 6,
                    truncations=np.zeros(last - first, dtype=bool),
                )
            )

    def iterate_episodes(self):
        return iter(self.episodes)


def test_a_dataset_of_episodes():
    data, learner = played(), agent(PointMass(), reward_fn=reward_fn)
    learner.add_transitions(Episodes(data, [7, 10, 20]))
    assert_stored(learner, data)
    assert learner.store.episodes.tolist() == [0] * 7 + [1] * 3 + [2] * 10
    assert learner.store.terminated.nonzero().flatten().tolist() == [6]
    short = Episodes(data, [7])
    short.episodes[0].observations = short.episodes[0].observations[:-1]
    with pytest.raises(EnvironmentDataError, match=r"episode 0 .*8 observations.* 7 actions, got 7"):
        learner.add_transitions(short)
    with pytest.raises(EnvironmentDataError, match="0 episodes"):
        learner.add_transitions(Episodes(data, []))


@pytest.mark.filterwarnings("ignore::UserWarning:minari.*")
def test_a_minari_dataset(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = played(LENGTH)
    episode = EpisodeBuffer(
        id=0,
        seed=0,
        observations=np.concatenate([data["observation"], data["next_observation"][-1:]]),
        actions=data["action"],
        rewards=data["reward"],
        terminations=np.zeros(LENGTH, dtype=bool),
        truncations=np.arange(1, LENGTH + 1) == LENGTH,
    )
    minari.create_dataset_from_buffers("tests/point-mass-v0", [episode], env=KnownPointMass(), algorithm_name="random")
    learner = agent()
    learner.add_transitions(minari.load_dataset("tests/point-mass-v0"))
    assert_stored(learner, data)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observation": np.zeros((20, 3))}, r"observation .*\[20, 2\].*got \[20, 3\]"),
        ({"next_observation": np.zeros((19, 2))}, r"next_observation .*\[20, 2\].*got \[19, 2\]"),
        ({"action": np.zeros(20)}, r"action .*\[20, 1\].*got \[20\]"),
        ({"reward": np.zeros((20, 1))}, r"reward .*\[20\].*got \[20, 1\]"),
        ({"reward": np.full(20, np.nan)}, r"step 0: reward .*got nan"),
        ({"terminated": np.zeros(3, dtype=bool)}, r"terminated .*\[20\].*got \[3\]"),
        ({"episode": np.zeros(3, dtype=int)}, r"episode .*\[20\].*got \[3\]"),
        ({"episode": np.zeros((20, 1), dtype=int)}, r"episode .*\[20\].*got \[20, 1\]"),
        ({"episode": np.full(20, 0.5)}, r"episode .*float64"),
        ({"action": np.full((20, 1), 2.5)}, r"\[-2.0\].*\[2.0\], got 2.5 in component 0 of step 0 \(20 "),
        ({"actions": np.zeros((20, 1))}, r"missing: \[\], unknown: \['actions'\]"),
        ({"observation": np.array([["a", "b"]] * 20)}, r"observation .*<U1"),
    ],
)
def test_bad_data_are_named_and_nothing_is_stored(change, message):
    learner = agent().learn(3)
    with pytest.raises(EnvironmentDataError, match=message):
        learner.add_transitions({**played(), **change})
    assert len(learner.store) == 3 and learner.is_exploring


def test_missing_fields_and_other_kinds_of_data(unchecked):
    data = played()
    del data["reward"]
    with pytest.raises(EnvironmentDataError, match=r"missing: \['reward'\]"):
        agent().add_transitions(data)
    with pytest.raises(TypeError, match="got list"):
        agent().add_transitions([1, 2])


def test_no_data_at_all():
    learner = agent()
    with pytest.raises(EnvironmentDataError, match="0 transitions"):
        learner.add_transitions({name: value[:0] for name, value in played().items()})
    assert learner.is_exploring


def test_actions_of_two_dimensions():
    class Grid(KnownPointMass):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(-2.0, 2.0, (1, 1), np.float64)

    data, learner = played(), agent(Grid())
    learner.add_transitions({**data, "action": data["action"][:, None]})
    assert_stored(learner, data)
