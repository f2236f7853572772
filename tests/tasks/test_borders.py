"""What environments do with shared arrays, and with shapes that are not their spaces', never reaches the store."""

from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper

from gym_dgpmpc.errors import EnvironmentDataError, EnvironmentFailedError
from gym_dgpmpc.planning import CEM
from gym_dgpmpc.tasks.borders import guard
from tests.agents.point_mass import KnownPointMass, LinearModel, agent, reward_fn

SPAN = 4  # steps of an episode


class Drifting(gym.Env):
    """x' = 0.9 x + 0.1 a, as a vector or a Dict, of fresh arrays: the twin of what shares them."""

    def __init__(self, parts=None, length=SPAN):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.parts, self.length = parts, length
        self.observation_space = box if parts is None else spaces.Dict(dict.fromkeys(parts, box))
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.time = self.np_random.normal(size=2), 0
        return self.handed_out(), {}

    def step(self, action):
        self.x = 0.9 * self.x + 0.1 * action
        self.time += 1
        ends = self.time >= self.length
        return self.handed_out(), -float((self.x**2).sum()), ends and self.length % 2 == 0, ends, {}

    def handed_out(self):
        return self.x.copy() if self.parts is None else {part: self.x + i for i, part in enumerate(self.parts)}


class Sharing(Drifting):
    """The same, which writes into its actions and hands out one array, dict and info again and again.

    Args:
        changes_actions, shares_array, shares_info, spoils: what it does; the last: it fills what it handed out before
            with other numbers as soon as it is called again.
    """

    info: ClassVar[dict] = {}  # one for all environments

    def __init__(self, parts, length, changes_actions=True, shares_array=True, shares_info=True, spoils=False):
        super().__init__(parts, length)
        self.changes_actions, self.shares_array = changes_actions, shares_array
        self.shares_info, self.spoils = shares_info, spoils
        self.buffer = np.zeros(2) if parts is None else {part: np.zeros(2) for part in parts}

    def reset(self, *, seed=None, options=None):
        self.spoil()
        observation, info = super().reset(seed=seed)
        return observation, self.info if self.shares_info else info

    def step(self, action):
        self.spoil()
        observation, reward, terminated, truncated, info = super().step(action.copy())
        if self.changes_actions:
            action *= 5
        return observation, np.array(reward), terminated, truncated, self.info if self.shares_info else info

    def spoil(self):
        if self.spoils:
            for array in [self.buffer] if self.parts is None else self.buffer.values():
                array.fill(77.0)

    def handed_out(self):
        fresh = super().handed_out()
        if not self.shares_array:
            return fresh
        if self.parts is None:
            self.buffer[:] = fresh
        else:
            for part, array in self.buffer.items():
                array[:] = fresh[part]
        return self.buffer


def stored(makers, as_vec_env=True):
    env = DummyVecEnv(makers) if as_vec_env else makers[0]()
    learned = {"reward_fn": "learned", "terminated_fn": "learned"}
    learner = agent(env, dynamics=lambda *sizes: LinearModel(), planner=small_planner, **learned)
    return learner.learn(len(makers) * 3 * SPAN).store.state_dict()


def small_planner(action_low, action_high):
    return CEM(action_low, action_high, horizon=2, num_candidates=6, num_elites=2, num_iterations=1)


@settings(max_examples=12, deadline=None)
@given(
    parts=st.sampled_from([None, ("b", "a"), ("achieved_goal", "desired_goal", "observation")]),
    length=st.integers(1, SPAN),
    num_envs=st.integers(1, 3),
    as_vec_env=st.booleans(),
    sharing=st.fixed_dictionaries(
        {name: st.booleans() for name in ("changes_actions", "shares_array", "shares_info", "spoils")}
    ),
)
def test_what_shares_its_arrays_leaves_the_same_data_as_what_does_not(parts, length, num_envs, as_vec_env, sharing):
    as_vec_env = as_vec_env or num_envs > 1
    expected = stored([lambda: Drifting(parts, length)] * num_envs, as_vec_env)
    found = stored([lambda: Sharing(parts, length, **sharing)] * num_envs, as_vec_env)
    for name, column in expected.items():
        assert torch.equal(found[name], column), name
    assert found["action"].abs().max() <= 1.0


class Counting(gym.Env):
    """Fills its one array with 100 in reset and adds 1 in each step."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self):
        self.array = np.zeros(2, dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        self.array.fill(100.0)
        return self.array, {}

    def step(self, action):
        action *= 5
        self.array += 1.0
        return self.array, 0.0, False, bool(self.array[0] >= 105.0), {}


@pytest.mark.parametrize("env", [Counting, lambda: DummyVecEnv([Counting] * 2)])
def test_the_last_observation_of_an_episode_is_its_own(env):
    learner = agent(env(), reward_fn=reward_fn).learn(20)
    ends = learner.store.transitions().next_observation[:, 0]
    assert ends.max() == 105.0 and ends.min() == 101.0
    assert learner.store.transitions().action.abs().max() <= 1.0


def test_in_another_process_shared_arrays_are_warned_of():
    env = SubprocVecEnv([Counting], start_method="fork")
    try:
        with pytest.warns(UserWarning, match=r"the next one begins with, \[100\. 100\.\].*Return copies"):
            agent(env, reward_fn=reward_fn).learn(6)
    finally:
        env.close()


class Spoiling(VecEnvWrapper):
    """Writes into the actions, and hands out one array of observations and one of rewards again and again."""

    keeps_actions = True

    def __init__(self, venv):
        super().__init__(venv)
        self.obs, self.rewards = np.zeros((venv.num_envs, 2)), np.zeros(venv.num_envs, dtype=np.float32)

    def reset(self):
        self.obs[:] = self.venv.reset()
        return self.obs

    def step_async(self, actions):
        self.venv.step_async(actions.copy())
        actions *= 5

    def step_wait(self):
        self.obs[:], self.rewards[:], dones, infos = self.venv.step_wait()
        return self.obs, self.rewards, dones, infos


def test_vec_envs_may_share_their_arrays_too():
    def learner(wrapper):
        return agent(wrapper(DummyVecEnv([KnownPointMass] * 2)), learning_starts=1000).learn(50).store.state_dict()

    expected, found = learner(lambda venv: venv), learner(Spoiling)
    for name, column in expected.items():
        assert torch.equal(found[name], column), name


def test_callbacks_may_write_into_what_they_are_given():
    def spoil(locals_, globals_):
        for name in ("new_obs", "rewards", "actions", "dones"):
            locals_[name].fill(0)
        return True

    expected, found = (agent(learning_starts=1000).learn(25, callback=each).store for each in (None, spoil))
    for name, column in expected.state_dict().items():
        assert torch.equal(found.state_dict()[name], column), name


def test_predict_shares_nothing_with_its_caller():
    learner = agent(actions_per_plan=2).learn(20)
    observation = np.array([0.5, 0.0], dtype=np.float32)
    action, state = learner.predict(observation, deterministic=True)
    told = [array.copy() for array in state]
    follows, _ = learner.predict(observation, state, deterministic=True)
    np.testing.assert_array_equal(observation, [0.5, 0.0])
    for array, before in zip(state, told, strict=True):
        np.testing.assert_array_equal(array, before)
    action[:] = np.nan
    for array in state:
        array.fill(0)
    again, _ = learner.predict(observation, tuple(told), deterministic=True)
    np.testing.assert_array_equal(again, follows)


class Returning(KnownPointMass):
    """Returns something else from reset or step than it should."""

    def __init__(self, method, returned, episode=0):
        super().__init__()
        self.method, self.returned, self.episode = method, returned, episode
        self.num_resets = 0

    def reset(self, *, seed=None, options=None):
        result = super().reset(seed=seed)
        self.num_resets += 1
        return self.returned if self.method == "reset" and self.num_resets > self.episode else result

    def step(self, action):
        _, *others = super().step(action)
        return (self.returned if self.method == "step" else self.state), *others


@pytest.mark.parametrize("make", [lambda make: make(), lambda make: DummyVecEnv([make] * 2)])
@pytest.mark.parametrize(
    ("returned", "named"),
    [
        (np.array([0.25, 0.75]), r"\(observation, info\).*got ndarray array\(\[0\.25, 0\.75\]\)"),
        ((np.array([0.25, 0.75]), 1.0), r"\(observation, info\).*0\.25"),
        ((np.array([0.5]), {}), r"reset returned an observation of shape \(1,\), expected \(2,\)"),
        ((0.5, {}), r"shape \(\), expected \(2,\): 0\.5"),
        ((np.zeros((2, 2)), {}), r"shape \(2, 2\), expected \(2,\)"),
        (([[1.0], [2.0, 3.0]], {}), r"cannot be made an array: \[\[1\.0\], \[2\.0, 3\.0\]\]"),
        ((np.array(["a", "b"]), {}), r"not numeric.*<U1"),
        ((None, {}), r"not numeric.*object.*None"),
        (({"observation": np.zeros(2)}, {}), r"not numeric.*observation"),
    ],
)
def test_what_reset_should_not_return_is_named_before_a_step_is_lost(make, returned, named):
    learner = agent(make(lambda: Returning("reset", returned)))
    with pytest.raises(EnvironmentDataError, match=named):
        learner.learn(5)
    assert len(learner.store) == learner.num_timesteps == 0


def test_what_step_should_not_return_is_named():
    with pytest.raises(EnvironmentDataError, match=r"step 0: .*step returned an observation of shape \(1,\)"):
        agent(Returning("step", np.array([0.5]))).learn(5)


class Answering(KnownPointMass):
    """Answers its third step with what ``change`` makes of the five values."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def step(self, action):
        returned = super().step(action)
        return self.change(*returned) if self.num_steps == 3 else returned


@pytest.mark.parametrize("make", [lambda env: env, lambda env: DummyVecEnv([lambda: env])])
@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda *five: five[:4], r"step must return \(observation, reward, .*got tuple of 4 \(array"),
        (lambda *five: five[0], r"step must return \(observation, reward, .*got ndarray array"),
        (lambda *five: [*five], r"step must return \(observation, reward, .*got list"),
        (lambda *five: (*five[:4], None), r"info a dict, .*got tuple of 5 .*None\)"),
        (lambda o, r, *three: (o, None, *three), "one number as reward, got None"),
        (lambda o, r, *three: (o, np.array([r, r]), *three), r"one number as reward, got array\("),
        (lambda o, r, *three: (o, "high", *three), "one number as reward, got 'high'"),
        (lambda o, r, *three: (o, r + 1j, *three), "one number as reward, got .*j"),
        (lambda o, r, *three: (o, float("nan"), *three), "reward must be finite as float32, got nan"),
        (lambda o, r, t, u, i: (o, r, None, u, i), "one number as terminated, got None"),
        (lambda o, r, t, u, i: (o, r, t, np.zeros(2, bool), i), r"one number as truncated, got array\("),
        (lambda o, r, t, u, i: (o, r, 0.5, u, i), "true or false as terminated, got 0.5"),
    ],
)
def test_the_other_things_that_step_should_not_return_are_named_and_cost_no_step_before(make, change, named):
    learner = agent(make(Answering(change)))
    with pytest.raises(EnvironmentDataError, match=f"step 2: .*{named}"):
        learner.learn(5)
    assert len(learner.store) == learner.num_timesteps == 2


@pytest.mark.parametrize("kind", [np.float32, np.array, lambda each: np.array([each]), torch.tensor])
def test_numbers_and_truths_of_other_kinds_are_let_in(kind):
    env = Answering(lambda o, r, t, u, i: (o, kind(r), kind(float(t)), kind(u), i))
    expected, found = (agent(each).learn(5).store.state_dict() for each in (KnownPointMass(), env))
    for name, column in expected.items():
        assert torch.equal(found[name], column), name


def test_an_info_that_is_shared_is_given_nothing():
    """Stable-Baselines3's monitor writes what an episode earned into the info of its last step."""
    env = Sharing(None, SPAN, changes_actions=False, shares_array=False)
    learner = agent(env, reward_fn=reward_fn, planner=small_planner, learning_starts=1000).learn(3 * SPAN)
    assert Sharing.info == {} and len(learner.ep_info_buffer) == 3


@pytest.mark.parametrize("num_envs", [1, 2])
def test_what_the_first_reset_raises_is_the_cause(num_envs):
    class Failing(KnownPointMass):
        def reset(self, *, seed=None, options=None):
            raise OSError("no such plant")

    with pytest.raises(EnvironmentFailedError, match=r"reset raised OSError: no such plant") as raised:
        agent(DummyVecEnv([Failing] * num_envs)).learn(1)
    assert isinstance(raised.value.__cause__, OSError)


def test_a_reset_that_goes_wrong_later_costs_no_step():
    learner = agent(Returning("reset", np.array([0.25, 0.75]), episode=1))
    with pytest.raises(EnvironmentDataError, match=r"step 9: .*reset must return"):
        learner.learn(15)
    assert len(learner.store) == learner.num_timesteps == 10


@pytest.mark.parametrize(
    "returned", [np.array([[0.5, 0.25]]), [[0.5], [0.25]], (0.5, 0.25), np.array([0.5, 0.25], "f2")]
)
def test_axes_of_length_one_and_other_kinds_of_numbers_are_let_in(returned):
    learner = agent(Returning("reset", (returned, {}))).learn(1)
    np.testing.assert_array_equal(learner.store.transitions().observation[0], [0.5, 0.25])


def test_a_missing_part_of_a_dict_is_named():
    env = Drifting(("a", "b"))
    env.handed_out = lambda: {"a": np.zeros(2)}
    with pytest.raises(
        EnvironmentDataError, match=r"reset must return a dict with the parts \['a', 'b'\], got \['a'\]"
    ):
        agent(env, reward_fn=lambda o, a, n: n[..., 0]).learn(1)


def test_parts_that_the_space_does_not_name_are_left_out():
    env = Drifting(("a", "b"), length=2)
    env.handed_out = lambda: {"a": np.full(2, 1.0), "aa": np.full(2, 9.0), "b": np.full(2, 2.0)}
    learner = agent(env, reward_fn=lambda o, a, n: n[..., 0], learning_starts=100).learn(4)
    for column in learner.store.transitions()._replace(action=None)[::2]:
        assert column.tolist() == [[1.0, 1.0, 2.0, 2.0]] * 4


class Bare(VecEnvWrapper):
    """Loses the first dimension, or the last observation of an episode."""

    loses = "dimension"

    def reset(self):
        observation = self.venv.reset()
        return observation[0] if self.loses == "dimension" else observation

    def step_wait(self):
        observation, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return observation, rewards, dones, infos


def test_what_a_vec_env_should_not_return_is_named():
    env = Bare(DummyVecEnv([KnownPointMass]))
    with pytest.raises(
        EnvironmentDataError, match=r"reset must return observations of shape \(1, 2\).*of shape \(2,\)"
    ):
        agent(env).learn(1)
    env.loses = "last"
    with pytest.raises((EnvironmentDataError, EnvironmentFailedError), match="terminal_observation"):
        agent(env).learn(20)


def test_an_environment_has_one_border_however_often_it_is_used():
    env = DummyVecEnv([KnownPointMass] * 2)
    guard(env)
    first = list(env.envs)
    agent(env)
    assert env.envs == first
