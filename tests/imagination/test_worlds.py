"""Imagined episodes: what the model, the rewards and the data say happens in them, and nothing else."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecMonitor

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import UnknownRewardError
from gym_dgpmpc.imagination import ImaginedVecEnv
from gym_dgpmpc.imagination.beginnings import Plausible, recorded_beginnings
from gym_dgpmpc.types import ObservationSpec
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, PointMass, agent, reward_fn

OBSERVATIONS = spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTIONS = spaces.Box(-2.0, 2.0, (1,), np.float32)


class Shift(LinearModel):
    """s' = s + a + the particle's own number, which the generator draws; NaN once the first number exceeds 9."""

    def draw(self, num_particles, horizon, generator):
        own = torch.rand(num_particles, 1, 1, generator=generator, dtype=torch.float64)

        def sampler(observation, action, step):
            assert 0 <= step < horizon
            after = observation + action + own.to(observation)
            return torch.where(after[..., :1] > 9, torch.nan, after)

        return sampler


def beginnings(count, generator):
    return torch.zeros(count, 2)


def worlds(**arguments):
    given = {"num_worlds": 3, "episode_steps": 4, "seed": 0, "dtype": torch.float64, **arguments}
    return ImaginedVecEnv(Shift(), reward_fn, beginnings, OBSERVATIONS, ACTIONS, **given)


def act(number, env):
    return np.full((env.num_envs, 1), number)


@pytest.fixture(scope="module")
def learned():
    return agent().learn(25)


def test_a_step_is_the_draws_own_with_each_worlds_own_action():
    env, generator = worlds(), torch.Generator().manual_seed(0)
    own = torch.rand(3, 1, 1, generator=generator, dtype=torch.float64)[:, 0].numpy()
    np.testing.assert_array_equal(env.reset(), np.zeros((3, 2)))
    actions = np.array([[0.5], [-1.0], [2.0]])
    after, rewards, dones, infos = env.step(actions)
    np.testing.assert_allclose(after, own + actions + np.zeros(2), rtol=1e-15)
    expected = -((own + actions) ** 2) - 0.01 * actions**2
    np.testing.assert_allclose(rewards, expected[:, 0], rtol=1e-6)  # float32
    assert not dones.any() and infos == [{}, {}, {}]


def test_worlds_of_a_learned_model_step_as_its_draws_do(learned):
    env = ImaginedVecEnv.of(learned, 4, seed=3, episode_steps=6)
    start = env.reset()
    actions = np.random.default_rng(0).uniform(-2, 2, (4, 1)).astype(np.float32)
    after, *_ = env.step(actions)
    velocity = start[:, 1] + 0.3 * actions[:, 0]
    exact = np.stack([start[:, 0] + 0.3 * velocity, velocity], -1)
    # The weights of a world are 1e-3 (1 + 1e-2) standard normals away from the fit, on 4 inputs of size below 3.
    assert np.abs(after - exact).max() < 6 * 1.01e-3 * 3 * 2
    assert np.abs(after - exact).max() > 0


def test_actions_beyond_the_bounds_are_clipped():
    env, same = worlds(), worlds()
    env.reset(), same.reset()
    np.testing.assert_array_equal(env.step(act(50.0, env))[0], same.step(act(2.0, env))[0])


def test_worlds_are_drawn_anew_when_they_end_and_by_the_seed_alone():
    env = worlds()
    first = env.reset()
    seen = [env.step(act(0.0, env))[0][:, 0] for _ in range(5)]
    np.testing.assert_array_equal(seen[3], first[:, 0])  # the fourth step ended the worlds
    assert (np.abs(seen[4] - seen[0]) > 1e-9).all()
    again = worlds()
    again.reset()
    for numbers in seen:
        np.testing.assert_array_equal(again.step(act(0.0, env))[0][:, 0], numbers)
    env.seed(0)
    env.reset()
    np.testing.assert_array_equal(env.step(act(0.0, env))[0][:, 0], seen[0])
    env.reset()
    assert (np.abs(env.step(act(0.0, env))[0][:, 0] - seen[0]) > 1e-9).all()


def test_an_episode_that_runs_out_of_time_is_truncated():
    env = worlds()
    env.reset()
    rewards = [env.step(act(1.0, env))[1] for _ in range(3)]
    before = env.step(act(1.0, env))
    observation, last, dones, infos = before
    assert dones.all() and all(info["TimeLimit.truncated"] and not info["implausible"] for info in infos)
    np.testing.assert_array_equal(observation, np.zeros((3, 2)))
    for i, info in enumerate(infos):
        assert info["terminal_observation"].shape == (2,) and (info["terminal_observation"] > 4).all()
        assert info["episode"]["l"] == 4
        assert info["episode"]["r"] == pytest.approx(sum(r[i] for r in rewards) + last[i], rel=1e-6)


def test_a_terminated_episode_is_followed_by_one_in_the_same_world():
    env = worlds(terminated_fn=lambda after: after[..., 0] > 2.0, episode_steps=50)
    env.reset()
    first = env.step(act(0.1, env))[0]
    while True:
        observation, _, dones, infos = env.step(act(2.0, env))
        if dones.any():
            break
    index = int(np.flatnonzero(dones)[0])
    assert not infos[index]["TimeLimit.truncated"]
    assert infos[index]["terminal_observation"][0] > 2.0
    np.testing.assert_array_equal(observation[index], np.zeros(2))
    np.testing.assert_array_equal(env.step(act(0.1, env))[0][index], first[index])


@pytest.mark.parametrize("plausible", [None, Plausible(torch.tensor([-5.0, -torch.inf]), torch.tensor([5.0, 99.0]))])
def test_what_nobody_knows_ends_an_episode_and_earns_the_least(plausible):
    env = worlds(plausible=plausible, least_reward=-7.0, episode_steps=20)
    env.reset()
    taken, earned = np.zeros(3, dtype=int), np.zeros(3)
    for _ in range(8):
        before = env._states.clone()
        observation, rewards, dones, infos = env.step(act(1.5, env))
        taken += 1
        earned += rewards
        assert np.isfinite(observation).all() and np.isfinite(rewards).all()
        for i in np.flatnonzero(dones):
            assert infos[i]["implausible"] and not infos[i]["TimeLimit.truncated"]
            assert rewards[i] == -7.0 * (20 - (taken[i] - 1))
            np.testing.assert_array_equal(infos[i]["terminal_observation"], before[i])
            assert infos[i]["episode"]["r"] == pytest.approx(earned[i], rel=1e-6)
            taken[i], earned[i] = 0, 0.0
    assert (taken < 8).all()  # every world had one


def test_a_reward_that_is_not_finite_ends_an_episode_too():
    env = ImaginedVecEnv(
        Shift(), lambda s, a, after: 1 / (after[..., 0] - after[..., 0]), beginnings, OBSERVATIONS, ACTIONS, seed=0
    )
    env.reset()
    _, rewards, dones, infos = env.step(act(0.0, env))
    assert dones.all() and (rewards == 0).all() and all(info["implausible"] for info in infos)


def test_where_episodes_begin(learned):
    store = learned.store
    first = {tuple(row) for row in store.exact_transitions().observation[[0, LENGTH, 2 * LENGTH]].tolist()}
    every = {tuple(row) for row in store.exact_transitions().observation.tolist()}
    drawn = {}
    for name in ("starts", "states", "mixed"):
        rows = recorded_beginnings(store, name)(4000, torch.Generator().manual_seed(1)).tolist()
        drawn[name] = [tuple(row) in first for row in rows]
        assert {tuple(row) for row in rows} <= every
    share = {name: np.mean(flags) for name, flags in drawn.items()}
    assert share["starts"] == 1.0
    for name, expected in (("states", 3 / 25), ("mixed", 0.5 + 0.5 * 3 / 25)):  # binomial, 5 standard deviations
        assert abs(share[name] - expected) < 5 * (expected * (1 - expected) / 4000) ** 0.5


def test_a_function_of_beginnings_is_asked_and_checked(learned, unchecked):
    env = ImaginedVecEnv.of(learned, 2, starts=lambda count, rng: rng.uniform(5, 6, (count, 2)), seed=0)
    assert ((env.reset() > 5) & (env.reset() < 6)).all()
    wrong = ImaginedVecEnv.of(learned, 2, starts=lambda count, rng: np.zeros((count, 3)), seed=0)
    with pytest.raises(ValueError, match=r"observations of shape \(2, 2\), got float64 of shape \(2, 3\)"):
        wrong.reset()
    with pytest.raises(ValueError, match=r"starts, states, or a function .* got 'somewhere'"):
        ImaginedVecEnv.of(learned, 2, starts="somewhere")


def test_the_plausible_range_is_of_what_the_model_is_fed():
    store = TransitionStore(5, 1)
    store.extend([[0, 0, 0, 0, 3]], [[0]], [[1, 2, 4, 8, 3]], reward=[0], terminated=[False], episode=[0])
    range_ = Plausible.of(store, ObservationSpec(angles=(1,), not_inputs=(2,)), margin=0.5)
    assert range_.low.tolist() == [-0.5, -np.inf, -np.inf, -4, -np.inf]  # the last one never moved
    assert range_.high.tolist() == [1.5, np.inf, np.inf, 12, np.inf]
    states = torch.tensor([[0.0, 99, 99, 0, 9], [1.6, 0, 0, 0, 0], [0, 0, 0, torch.nan, 0]])
    assert range_.left(states).tolist() == [False, True, True]


def test_an_agent_that_knows_nothing_has_no_worlds():
    with pytest.raises(ValueError, match=r"has not learned yet.* call learn first"):
        ImaginedVecEnv.of(agent())
    with pytest.raises(RuntimeError, match="call reset before the first step"):
        worlds().step(np.zeros((3, 1)))
    with pytest.raises(ValueError, match="num_worlds must be at least 1, got 0"):
        worlds(num_worlds=0)


def test_the_least_reward_is_the_least_that_was_seen(learned):
    assert ImaginedVecEnv.of(learned).least_reward == pytest.approx(float(learned.store.rewards.min()), rel=1e-5)


def test_learned_rewards_and_terminations_are_the_models():
    made = []

    def linear(observation_size, action_size, spec):
        made.append(observation_size)
        return LinearModel()

    one = agent(PointMass(terminate_beyond=1.5), dynamics=linear, learning_starts=40, terminated_fn="learned")
    one.learn(60)
    assert made[-1] == 4  # reward and termination beside the observation
    env = ImaginedVecEnv.of(one, 5, seed=0)
    assert env.reset().shape == (5, 2)
    sampler_states = env._states
    assert sampler_states.shape == (5, 4)
    _, rewards, _, _ = env.step(np.zeros((5, 1)))
    assert np.isfinite(rewards).all()


class Goal(gym.Env):
    """A Dict of two vectors."""

    observation_space = spaces.Dict(
        {"place": spaces.Box(-9, 9, (2,), np.float32), "aim": spaces.Box(-9, 9, (1,), np.float32)}
    )
    action_space = spaces.Box(-1.0, 1.0, (1, 2), np.float32)
    reward_fn = staticmethod(lambda s, a, after: -((after[..., 1] - after[..., 0]) ** 2))
    terminated_fn = None

    def _observed(self):
        return {"place": self.place.astype(np.float32), "aim": np.array([1.0], np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.time = self.np_random.uniform(-1, 1, 2), 0
        return self._observed(), {}

    def step(self, action):
        self.place = self.place + 0.1 * action[0]
        self.time += 1
        after = torch.from_numpy(np.concatenate([[1.0], self.place]))
        return self._observed(), float(self.reward_fn(None, None, after)), False, self.time >= 5, {}


def test_dict_observations_and_matrices_of_actions_are_the_tasks_own():
    from gym_dgpmpc.agents import MPCAgent
    from gym_dgpmpc.planning import CEM

    bound = torch.ones(2)
    one = MPCAgent(Goal(), LinearModel(), CEM(-bound, bound, horizon=3, num_candidates=9, num_iterations=1), seed=0)
    one.learn(10)
    env = ImaginedVecEnv.of(one, 3, seed=0)
    observation = env.reset()
    assert {key: (part.shape, part.dtype) for key, part in observation.items()} == {
        "aim": ((3, 1), np.float32), "place": ((3, 2), np.float32)
    }  # fmt: skip
    assert env.episode_steps == 200 and env.action_space.shape == (1, 2)
    actions = np.full((3, 1, 2), 0.5, np.float32)
    after, *_ = env.step(actions)
    np.testing.assert_allclose(after["place"], observation["place"] + 0.05, atol=0.02)
    model = SAC("MultiInputPolicy", env, learning_starts=5, train_freq=1, gradient_steps=1, seed=0).learn(60)
    assert Goal.action_space.contains(model.predict(Goal().reset(seed=0)[0])[0])


@pytest.mark.parametrize("algorithm", [SAC, TD3, PPO, A2C])
def test_algorithms_train_in_it_unchanged(algorithm, learned):
    env = ImaginedVecEnv.of(learned, 2, episode_steps=LENGTH, seed=0)
    few = {"n_steps": 20} if algorithm in (PPO, A2C) else {"learning_starts": 20, "train_freq": 10}
    few |= {"batch_size": 20} if algorithm is not A2C else {}
    model = algorithm("MlpPolicy", VecMonitor(env) if algorithm is PPO else env, **few, seed=0).learn(60)
    lengths = [info["l"] for info in model.ep_info_buffer]
    assert len(lengths) >= 6 and max(lengths) <= LENGTH and sum(lengths) <= model.num_timesteps


def test_a_vec_env_has_what_stable_baselines3_asks_of_one():
    env = worlds()
    assert env.get_attr("episode_steps", [0, 2]) == [4, 4]
    env.set_attr("least_reward", -1.0)
    assert env.get_attr("least_reward") == [-1.0] * 3
    assert env.env_method("get_attr", "num_envs", [0], indices=1) == [[3]]
    assert env.env_is_wrapped(VecMonitor) == [False] * 3
    env.reset()
    env.close()
    with pytest.raises(RuntimeError):
        env.step(act(0.0, env))


def test_an_agent_without_a_reward_has_no_worlds(tmp_path, learned):
    learned.save(tmp_path / "agent")
    loaded = type(learned).load(tmp_path / "agent", dynamics=LinearModel(), planner=learned.planner)
    with pytest.raises(UnknownRewardError):
        ImaginedVecEnv.of(loaded)
    assert (
        ImaginedVecEnv.of(
            type(learned).load(
                tmp_path / "agent", env=KnownPointMass(), dynamics=LinearModel(), planner=learned.planner
            )
        ).episode_steps
        == 200
    )


def test_worlds_without_limits_end_only_where_nothing_is_finite(learned):
    limited, free = (ImaginedVecEnv.of(learned, 1, is_limited=is_limited) for is_limited in (True, False))
    far = torch.full((1, 2), 1e6)
    assert limited.left(far).all() and not free.left(far).any()
    assert free.left(torch.full((1, 2), torch.nan)).all()
