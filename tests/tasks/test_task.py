"""Where reward, termination and the way to read observations come from, and in which order they are looked for."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc.envs.known_rewards import PendulumReward
from gym_dgpmpc.tasks.environment import wrapped_env
from gym_dgpmpc.tasks.functions import find_functions, find_observation_spec
from gym_dgpmpc.types import ObservationSpec
from gym_dgpmpc.wrappers import RiskSensitiveReward
from tests.agents.point_mass import KnownPointMass, PointMass, agent, reward_fn


def found(env, reward_fn=None, terminated_fn=None):
    env = wrapped_env(env)
    return find_functions(env, reward_fn, terminated_fn, (env.observation_space, env.action_space))


def sources(*arguments, **settings):
    task = found(*arguments, **settings)
    return task.reward_source, task.terminated_source


def far(next_observation):
    return next_observation[..., 0].abs() > 5


@pytest.mark.parametrize(
    ("env_id", "expected"),
    [
        ("Pendulum-v1", ("known", "never")),
        ("InvertedPendulum-v5", ("shaped", "known")),
        ("InvertedDoublePendulum-v5", ("shaped", "known")),
        ("HalfCheetah-v5", ("learned", "never")),
        ("Hopper-v5", ("learned", "known")),
        ("ModCartPole-v0", ("the environment's", "never")),
        ("RiskSensitiveHalfCheetah-v0", ("the environment's", "never")),
    ],
)
def test_what_is_known_of_registered_tasks(env_id, expected):
    assert sources(gym.make(env_id)) == expected


def test_an_environment_may_say_that_it_never_terminates_or_say_nothing():
    assert sources(PointMass()) == ("learned", "learned")
    assert sources(KnownPointMass()) == ("the environment's", "learned")
    env = KnownPointMass()
    env.terminated_fn = None
    assert sources(env) == ("the environment's", "never")
    env.terminated_fn = far
    assert sources(env) == ("the environment's", "the environment's")


def test_what_the_user_says_goes_first(unchecked):
    env = gym.make("Pendulum-v1")
    task = found(env, lambda o, a, n: o[..., 0], far)
    assert (task.reward_source, task.terminated_source) == ("given", "given")
    assert sources(env, "learned", "learned") == ("learned", "learned")
    assert sources(env, "learned") == ("learned", "never")
    with pytest.raises(ValueError, match="reward_fn must be a function, \"learned\" or None, got 'guessed'"):
        find_functions(None, "guessed", None, (env.observation_space, env.action_space))
    with pytest.raises(ValueError, match="terminated_fn must be a function"):
        find_functions(None, "learned", "guessed", (env.observation_space, env.action_space))


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_vec_envs_and_their_harmless_wrappers(vec_env_cls):
    inner = make_vec_env("Pendulum-v1", n_envs=2, vec_env_cls=vec_env_cls)
    try:
        task = found(VecNormalize(inner, norm_obs=False))
        assert task.reward_fn == PendulumReward(2.0)
        assert task.terminated_source == "never"
        assert sources(VecFrameStack(inner, 2)) == ("learned", "learned")
    finally:
        inner.close()


def test_a_wrapper_that_may_change_the_task_leaves_it_to_be_learned():
    env = gym.wrappers.TransformReward(gym.make("Pendulum-v1"), lambda reward: reward / 10)
    assert sources(env) == ("learned", "learned")
    assert sources(Monitor(gym.make("Pendulum-v1"))) == ("known", "never")


def test_observation_specs_are_looked_for_in_the_same_order():
    env = wrapped_env(gym.make("Reacher-v5"))
    assert find_observation_spec(env, None) == ObservationSpec(not_inputs=(4, 5, 8, 9), constant=(4, 5))
    given = ObservationSpec(angles=(0,))
    assert find_observation_spec(env, given) == given
    assert find_observation_spec(wrapped_env(gym.make("ModCartPole-v0")), None) == ObservationSpec(angles=(1,))
    assert find_observation_spec(wrapped_env(PointMass()), None) == ObservationSpec()


class Swapped(gym.ObservationWrapper):
    def observation(self, observation):
        return observation[::-1].copy()


class Shifted(gym.Wrapper):
    def step(self, action):
        observation, *others = super().step(action)
        return observation + 1, *others


class Described(Swapped):
    """Says itself how to read what it returns."""

    observation_spec = ObservationSpec(angles=(2,))


@pytest.mark.parametrize("wrapper", [Swapped, Shifted, lambda env: Monitor(Swapped(env))])
def test_an_offered_observation_spec_is_not_taken_through_what_may_change_observations(wrapper):
    env = wrapped_env(wrapper(gym.make("ModCartPole-v0")))
    with pytest.raises(ValueError, match=r"(Swapped|Shifted) .*may change what its numbers mean.*observation_spec="):
        find_observation_spec(env, None)
    given = ObservationSpec(angles=(2,))
    assert find_observation_spec(env, given) == given


def test_an_offered_observation_spec_is_not_taken_through_a_stack_of_frames():
    env = wrapped_env(VecFrameStack(DummyVecEnv([lambda: gym.make("ModCartPole-v0")]), 2))
    with pytest.raises(ValueError, match=r"VecFrameStack .*may change what its numbers mean"):
        find_observation_spec(env, None)


@pytest.mark.parametrize(
    "wrapper",
    [
        Monitor,
        lambda env: RiskSensitiveReward(env, angle_index=1),
        lambda env: gym.wrappers.RescaleAction(gym.wrappers.TransformReward(env, float), -0.5, 0.5),
        lambda env: VecNormalize(DummyVecEnv([lambda: gym.wrappers.DtypeObservation(env, np.float32)]), norm_obs=False),
    ],
)
def test_an_offered_observation_spec_is_taken_through_what_keeps_observations(wrapper):
    env = wrapped_env(wrapper(gym.make("ModCartPole-v0")))
    assert find_observation_spec(env, None) == ObservationSpec(angles=(1,))


def test_a_wrapper_may_say_how_its_own_observations_are_read():
    env = wrapped_env(Described(gym.make("ModCartPole-v0")))
    assert find_observation_spec(env, None) == ObservationSpec(angles=(2,))


class Closure(KnownPointMass):
    """Offers what cannot be sent to another process."""

    def __init__(self):
        super().__init__()
        self.reward_fn = lambda o, a, n: n[..., 0]


def test_a_reward_that_cannot_leave_its_process_is_named():
    env = SubprocVecEnv([Closure])
    try:
        with pytest.raises(ValueError, match=r"attribute 'reward_fn' cannot be sent from the process.*reward_fn="):
            found(env)
    finally:
        for process in env.processes:  # as the worker died, `close` would fail
            process.join()
        env.closed = True


def test_the_agent_says_it_once(capsys):
    learner = agent(gym.make("Pendulum-v1"), verbose=1)
    learner.learn(2)
    learner.learn(2)
    assert capsys.readouterr().out == "reward: known | termination: never\n"
    learner = agent(PointMass(), reward_fn=reward_fn, dynamics=lambda *sizes: agent().dynamics, verbose=1)
    learner.learn(2)
    assert capsys.readouterr().out == ("reward: given | termination: learned, once an episode has terminated\n")


def test_a_reward_that_is_not_finite_where_the_space_says_it_must_be():
    env = KnownPointMass()
    env.observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float64)
    expected = r"(?s)finite numbers, but returned nan for observation = \[.*within the spaces Box\(-1\.0, 1\.0"
    with pytest.raises(ValueError, match=expected):
        agent(env, reward_fn=lambda o, a, n: n[..., 0].sqrt())


def test_a_reward_that_is_not_finite_where_nobody_knows_whether_that_occurs():
    with pytest.warns(UserWarning, match=r"returned nan for observation = \[.*will never be taken"):
        agent(reward_fn=lambda o, a, n: n[..., 0].sqrt())
    with pytest.raises(ValueError, match="finite numbers, but returned inf"):
        agent(reward_fn=lambda o, a, n: n[..., 0] + torch.inf)


def test_bounds_that_say_nothing_are_not_sampled_between():
    """Squares of numbers from within these bounds are infinite in single precision."""
    env = KnownPointMass()
    most = np.finfo(np.float32).max
    env.observation_space = gym.spaces.Box(np.array([-most, 5.0]), np.array([most, most]), dtype=np.float32)
    seen = []

    def remembered(observation, action, next_observation):
        seen.append(next_observation)
        return -(next_observation**2).sum(-1)

    agent(env, reward_fn=remembered)
    assert (seen[0][..., 1] >= 5.0).all() and (seen[0].abs() < 20.0).all()
