"""What cannot be planned for is refused at construction, with the name of what was received."""

import re

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from gym_dgpmpc.errors import UnknownRewardError
from gym_dgpmpc.types import ObservationSpec
from tests.agents.point_mass import KnownPointMass, LinearModel, PointMass, agent, reward_fn


def with_spaces(observation=None, action=None):
    env = KnownPointMass()
    env.observation_space = observation or env.observation_space
    env.action_space = action or env.action_space
    return env


def test_discrete_actions_get_the_message_of_sb3():
    with pytest.raises(AssertionError, match=r"The algorithm only supports .*Box.* as action spaces but Discrete\(3\)"):
        agent(with_spaces(action=spaces.Discrete(3)))


@pytest.mark.parametrize(
    ("env", "told"),
    [
        (KnownPointMass, "got the class KnownPointMass: make an instance"),
        (lambda: KnownPointMass(), "got function"),
        (gym.vector.SyncVectorEnv([KnownPointMass]), "not Gymnasium's own vector environments.*got SyncVectorEnv"),
        (3, "got int 3"),
    ],
)
def test_what_is_no_environment(env, told, unchecked):
    with pytest.raises(TypeError, match=f"env must be a Gymnasium environment, .*{told}"):
        agent(env)


def test_unbounded_actions():
    with pytest.raises(ValueError, match=r"finite action bounds, got low = \[-inf\] and high = \[1\.\]"):
        agent(with_spaces(action=spaces.Box(-np.inf, 1.0, (1,), np.float32)))


def test_whole_numbers_as_actions():
    with pytest.raises(ValueError, match=r"must be a Box of floats, got Box\(0, 5, \(1,\), int64\)"):
        agent(with_spaces(action=spaces.Box(0, 5, (1,), np.int64)))


def test_mixed_action_bounds_name_the_ones_that_are_missing():
    low, high = np.array([-1.0, 0.0, -np.inf]), np.array([1.0, np.inf, 3.0])
    with pytest.raises(ValueError, match=r"those at \[\[1\], \[2\]\] are not\), got low = \[ -1"):
        agent(with_spaces(action=spaces.Box(low, high, dtype=np.float64)))


def test_a_planner_for_other_actions_is_refused():
    """What it plans would be broadcast to the environment's actions, and learned from without a word."""
    three = spaces.Box(-1.0, 1.0, (3,), np.float32)
    with pytest.raises(ValueError, match="planner plans actions of 1 numbers, the action space has 3"):
        agent(with_spaces(action=three))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(4),
        spaces.Box(0, 255, (8, 8, 3), np.uint8),
        spaces.Box(-1.0, 1.0, (2, 2), np.float64),
        spaces.Box(0, 9, (2,), np.int64),
    ],
)
def test_observations_that_are_not_vectors_of_reals(space):
    with pytest.raises(ValueError, match=r"one-dimensional Box of floats, or a Dict of such, got (Discrete|Box)"):
        agent(with_spaces(observation=space))


def test_normalised_observations():
    with pytest.raises(ValueError, match=r"VecNormalize\(norm_obs=True\)"):
        agent(VecNormalize(DummyVecEnv([KnownPointMass])))
    learner = agent(VecNormalize(DummyVecEnv([KnownPointMass]), norm_obs=False))
    learner.learn(12)
    stored = learner.store.transitions()
    torch.testing.assert_close(learner.store.rewards, reward_fn(*stored), rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match=r"VecNormalize\(norm_obs=True\)"):
        learner.set_env(VecNormalize(DummyVecEnv([KnownPointMass])))


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_one_environment_in_a_vec_env(vec_env_cls):
    env = make_vec_env(KnownPointMass, n_envs=1, vec_env_cls=vec_env_cls)
    learner = agent(env).learn(12)
    env.close()
    assert len(learner.store) == 12


def test_a_refused_environment_changes_nothing():
    learner = agent(dynamics=lambda *sizes: LinearModel())
    before, dynamics = learner.env, learner.dynamics
    other = with_spaces(action=spaces.Box(-1.0, 1.0, (2,), np.float32))
    other.reward_fn = None
    with pytest.raises(ValueError, match="Action spaces do not match"):
        learner.set_env(DummyVecEnv([lambda: other]))
    with pytest.raises(ValueError, match="Action spaces do not match"):
        learner.set_env(DummyVecEnv([lambda: with_spaces(action=other.action_space)] * 3))
    assert learner.n_envs == 1
    assert learner.env is before
    assert learner.dynamics is dynamics
    assert not learner.task.modelled.reward


def test_an_unknown_reward_says_what_to_pass():
    with pytest.raises(UnknownRewardError, match=r"PointMass.*reward_fn=.*S = 2, A = 1"):
        agent(PointMass())
    learner = agent(PointMass(), reward_fn=reward_fn).learn(12)
    assert learner.task.functions.reward_fn is reward_fn
    with pytest.raises(UnknownRewardError, match="<PointMass"):
        agent(KnownPointMass()).set_env(PointMass())


def test_a_given_reward_goes_before_the_environments():
    def other(observation, action, next_observation):
        return next_observation[..., 0]

    assert agent(KnownPointMass(), reward_fn=other).task.functions.reward_fn is other
    learner = agent(KnownPointMass(), reward_fn=other)
    learner.set_env(KnownPointMass())
    assert learner.task.functions.reward_fn is other


def test_a_reward_is_found_under_wrappers():
    env = gym.wrappers.TimeLimit(gym.wrappers.PassiveEnvChecker(KnownPointMass()), 5)
    assert agent(env).task.functions.reward_fn is reward_fn


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (lambda o, a, n: -n, ValueError, r"float tensor \[4, 3, 3\].*returned torch.float32 of shape \[4, 3, 3, 2\]"),
        (lambda o, a, n: -n.sum(), ValueError, r"returned torch.float32 of shape \[\]"),
        (lambda o, a, n: n[..., 0] > 0, ValueError, "returned torch.bool"),
        (lambda o, a, n: n[..., 0].int(), ValueError, "returned torch.int32"),
        (lambda o, a, n: n[..., 0].to("meta"), ValueError, "device.*cpu.*meta"),
        (lambda o, a, n: n[..., 5], ValueError, "raised IndexError"),
        (lambda o, a: a, ValueError, "raised TypeError"),
        (lambda o, a, n: -(n**2).sum(2), ValueError, r"returned torch.float32 of shape \[4, 3, 2\]"),
        (lambda o, a, n: -a.view(-1), ValueError, "raised RuntimeError: view size is not compatible"),
        (lambda o, a, n: n.sub_(1.0)[..., 0], ValueError, "changed its arguments"),
        (lambda o, a, n: n.numpy()[..., 0], TypeError, "returned ndarray"),
    ],
)
def test_a_reward_function_that_does_not_fit_is_tried_and_named(function, error, message):
    with pytest.raises(
        error, match=rf"(?s)reward_fn must map .*\[4, 3, 3, 2\], \[4, 3, 3, 1\], \[4, 3, 3, 2\].*{message}"
    ):
        agent(reward_fn=function)


def test_a_reward_that_is_no_function(unchecked):
    with pytest.raises(TypeError, match=r"reward_fn must be a function reward_fn\(.*got 3"):
        agent(reward_fn=3)


@pytest.mark.parametrize("function", [lambda n: n[..., 0], lambda n: n > 0])
def test_a_termination_function_that_does_not_fit(function):
    with pytest.raises(ValueError, match=r"terminated_fn must map .*bool tensor \[4, 3, 3\]"):
        agent(terminated_fn=function)


@pytest.mark.parametrize("name", ["num_particles", "actions_per_plan", "learning_starts"])
def test_counts_are_positive(name):
    with pytest.raises(ValueError, match=f"{name} must.* 1.*got 0"):
        agent(**{name: 0})


def test_a_plain_agent_needs_its_parts():
    from gym_dgpmpc import MPCAgent

    with pytest.raises(ValueError, match="dynamics="):
        MPCAgent(KnownPointMass())


def test_construction_does_not_advance_the_environment():
    env = KnownPointMass()
    env.action_space.seed(0)
    expected = KnownPointMass().action_space
    expected.seed(0)
    agent(env, seed=None)
    assert env.steps == []
    np.testing.assert_array_equal(env.action_space.sample(), expected.sample())


def test_actions_of_two_dimensions():
    """The model and the planner see a flat action; the environment sees its own shape."""

    class Grid(KnownPointMass):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(-2.0, 2.0, (1, 1), np.float64)

        def step(self, action):
            assert action.shape == (1, 1)
            return super().step(action[0])

    learner = agent(Grid()).learn(15)
    action, _ = learner.predict(np.zeros(2), deterministic=True)
    assert action.shape == (1, 1)
    assert action.dtype == np.float64


def test_an_observation_spec_holds_tuples_of_integers(unchecked):
    given = ObservationSpec(angles=[1], constant=tuple(np.flatnonzero([0, 1, 1])), body_frame=[[0, 1, 2]])
    assert given == ObservationSpec(angles=(1,), constant=(1, 2), body_frame=((0, 1, 2),))
    assert type(given.constant[0]) is int
    for name, given in (("angles", [1.0]), ("angles", 1), ("body_frame", (0, 1, 2))):
        with pytest.raises(TypeError, match=re.escape(f"got {given!r}")) as caught:
            ObservationSpec(**{name: given})
        assert str(caught.value).startswith(f"{name} must be ")
