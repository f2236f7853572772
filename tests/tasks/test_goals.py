"""Dict observations as vectors, and environments with goals: read, rewarded, predicted for, saved and resumed."""

import re

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.errors import CheckpointError, EnvironmentDataError
from gym_dgpmpc.tasks.dict_observations import FlatDict, flatten
from gym_dgpmpc.tasks.environment import wrapped_env
from gym_dgpmpc.tasks.functions import find_functions, find_observation_spec
from gym_dgpmpc.types import ObservationSpec
from tests.agents.point_mass import LENGTH, TIME_STEP, LinearModel, agent, planner
from tests.agents.test_dgp_mpc import TINY


class Goal(gym.Env):
    """The point mass with a place to go to, which is another in each episode."""

    can_replay = True

    def __init__(self, reward_type="dense"):
        self.reward_type = reward_type
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-np.inf, np.inf, (2,), np.float64),
                "desired_goal": spaces.Box(-5.0, 5.0, (1,), np.float64),
                "achieved_goal": spaces.Box(-np.inf, np.inf, (1,), np.float64),
            }
        )
        self.action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def compute_reward(self, achieved_goal, desired_goal, info):
        assert achieved_goal.shape == desired_goal.shape
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return -distance if self.reward_type == "dense" else -(distance > 0.1).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.time = np.array([0.0, 0.0]), 0
        self.goal = self.np_random.uniform(-1.0, 1.0, 1)
        return self.observe(), {}

    def step(self, action):
        velocity = self.state[1] + TIME_STEP * float(action[0])
        self.state = np.array([self.state[0] + TIME_STEP * velocity, velocity])
        self.time += 1
        seen = self.observe()
        reward = float(self.compute_reward(seen["achieved_goal"], self.goal, {}))
        return seen, reward, False, self.time >= LENGTH, {"is_success": reward > -0.1}

    def observe(self):
        return {"observation": self.state.copy(), "achieved_goal": self.state[:1].copy(), "desired_goal": self.goal}


def logged():
    """An episode of random actions."""
    env, generator, steps = Goal(), np.random.default_rng(0), []
    before, _ = env.reset(seed=0)
    for _ in range(LENGTH):
        action = generator.uniform(-2, 2, 1)
        after, reward, *_ = env.step(action)
        steps.append((flatten(before), action, flatten(after), reward))
        before = after
    names = ("observation", "action", "next_observation", "reward")
    return dict(zip(names, map(np.array, zip(*steps, strict=True)), strict=True))


OBSERVATION = {
    "observation": np.array([0.3, 0.1]),
    "desired_goal": np.array([0.5]),
    "achieved_goal": np.array([0.3]),
}


def test_the_parts_stand_in_alphabetical_order():
    assert flatten(OBSERVATION).tolist() == [0.3, 0.5, 0.3, 0.1]
    assert flatten({key: np.stack([part] * 3) for key, part in OBSERVATION.items()}).shape == (3, 4)
    env = wrapped_env(Goal())
    assert isinstance(env, FlatDict)
    assert env.layout == {"achieved_goal": slice(0, 1), "desired_goal": slice(1, 2), "observation": slice(2, 4)}
    assert env.observation_space == spaces.Box(
        np.array([-np.inf, -5.0, -np.inf, -np.inf]), np.array([np.inf, 5.0, np.inf, np.inf]), dtype=np.float64
    )


def test_an_episodes_last_observation_is_a_vector_too():
    env = wrapped_env(Goal())
    env.seed(3)
    first = env.reset()
    for _ in range(LENGTH):
        observation, _, dones, infos = env.step(np.full((1, 1), 0.5, dtype=np.float32))
    assert dones[0] and observation.shape == first.shape == (1, 4)
    last = infos[0]["terminal_observation"]
    assert last.shape == (4,) and last[1] == first[0, 1] != observation[0, 1] and last[2] > 0.1


@pytest.mark.parametrize(
    "part",
    [spaces.Box(0, 255, (3, 8, 8), np.uint8), spaces.Box(-1.0, 1.0, (2, 2), np.float64), spaces.Discrete(3)],
    ids=str,
)
def test_parts_that_are_not_vectors_of_floats_are_named(part):
    env = Goal()
    env.observation_space = spaces.Dict({**env.observation_space.spaces, "extra": part})
    with pytest.raises(ValueError, match=rf"{re.escape(str(part))} for 'extra'"):
        agent(env)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_compute_reward_is_the_known_reward(vec_env_cls):
    env = wrapped_env(make_vec_env(Goal, n_envs=1, vec_env_cls=vec_env_cls))
    try:
        task = find_functions(env, None, None, (env.observation_space, env.action_space))
        assert task.reward_source == "compute_reward"
        observation = env.reset()
        for action in np.linspace(-2, 2, 5, dtype=np.float32):
            after, reward, _, _ = env.step(np.array([[action]]))
            batch = (torch.tensor(each, dtype=torch.float64) for each in (observation, np.array([[action]]), after))
            assert task.reward_fn(*batch).tolist() == pytest.approx(reward, rel=1e-6)
            observation = after
        states = torch.randn(6, 5, 3, 4, generator=torch.Generator().manual_seed(0))
        reward = task.reward_fn(states, states[..., :1], states)
        assert reward.dtype == torch.float32 and reward.shape == (6, 5, 3)
        torch.testing.assert_close(reward, -(states[..., 0] - states[..., 1]).abs())
    finally:
        env.close()


def test_the_goal_is_constant_and_only_the_reward_depends_on_it():
    assert find_observation_spec(wrapped_env(Goal()), None) == ObservationSpec(constant=(1,), not_inputs=(1,))


def test_a_learned_reward_is_fed_the_goal():
    learner = DGPMPCAgent(Goal(), reward_fn="learned", **TINY)
    assert 1 in learner.dynamics.encoder.plain and 1 not in learner.dynamics.encoder.predicted


def test_sparse_rewards_warn():
    with pytest.warns(UserWarning, match="sparse rewards, in which a planner has nothing to climb"):
        agent(Goal("sparse"))


def test_a_compute_reward_that_takes_no_batches_is_named():
    class Single(Goal):
        def compute_reward(self, achieved_goal, desired_goal, info):
            return -float(abs(achieved_goal[0] - desired_goal[0]))

    with pytest.raises(ValueError, match=r"(?s)compute_reward.*must map goals.*raised TypeError.*learned"):
        agent(Single())


def test_it_goes_to_the_goal():
    """The linear model is exact, so ten steps suffice to get there from any place: about 0.3 m each way and back."""
    learner = agent(Goal()).learn(5 * LENGTH)
    returns = learner.store.rewards.reshape(5, LENGTH).sum(1)
    goals = learner.store.transitions().observation[::LENGTH, 1].abs()
    assert len(goals.unique()) == 5
    # Standing still costs ten times the goal's distance.
    assert (returns[2:] > -5.0 * goals[2:] - 0.5).all()
    dones = learner.ep_success_buffer
    assert len(dones) == 5


@pytest.mark.parametrize(
    "changed",
    [
        {"observation": np.zeros(3)},
        {"observation": None},
        {"other": np.zeros(2), "observation": None},
        {"achieved_goal": np.zeros((2, 1))},
        {"observation": np.zeros(())},
    ],
)
def test_a_dict_of_other_parts_is_named(changed):
    parts = {"observation": np.zeros(2), "achieved_goal": np.zeros(1), "desired_goal": np.zeros(1)} | changed
    received = {name: part for name, part in parts.items() if part is not None}
    expected = {"achieved_goal": (1,), "desired_goal": (1,), "observation": (2,)}
    shapes = {name: part.shape for name, part in received.items()}
    with pytest.raises(ValueError, match=rf"{re.escape(str(expected))}.*got {re.escape(str(shapes))}"):
        agent(Goal()).predict(received)


def test_sb3s_helpers_take_dicts(tmp_path):
    learner = agent(Goal()).learn(2 * LENGTH)
    action, state = learner.predict(OBSERVATION, deterministic=True)
    flat, _ = learner.predict(flatten(OBSERVATION), deterministic=True)
    np.testing.assert_array_equal(action, flat)
    batch = {key: np.stack([part] * 2) for key, part in OBSERVATION.items()}
    actions, states = learner.predict(batch, deterministic=True)
    np.testing.assert_array_equal(actions, [action, action])
    assert state[0].shape[0] == 1 and states[0].shape[0] == 2
    assert len(evaluate_policy(learner, Monitor(Goal()), 2, return_episode_rewards=True)[0]) == 2
    with pytest.raises(ValueError, match=r"got \{'observation': \(2,\)\}"):
        learner.predict({"observation": np.zeros(2)})
    with pytest.raises(EnvironmentDataError, match="not finite"):
        learner.predict({**OBSERVATION, "observation": np.array([np.nan, 0.0])})


@pytest.mark.filterwarnings("error")
def test_evaluation_while_it_learns():
    watched = agent(Goal())
    watched.add_transitions(logged())
    watch = EvalCallback(Monitor(Goal()), eval_freq=7, n_eval_episodes=1, verbose=0)
    watched.learn(2 * LENGTH, callback=watch)
    assert watch.last_mean_reward > -10.0
    assert isinstance(watched.get_env().observation_space, spaces.Dict)
    watched.set_env(watched.get_env())
    assert len(watched.learn(LENGTH, reset_num_timesteps=False).store) == 4 * LENGTH


def test_saved_loaded_and_resumed(tmp_path):
    whole = agent(Goal()).learn(34)
    learner = agent(Goal()).learn(2 * LENGTH)
    learner.save(tmp_path / "agent")
    parts = {"dynamics": LinearModel(), "planner": planner()}
    loaded = MPCAgent.load(tmp_path / "agent", env=Goal(), **parts)
    expected = learner.predict(OBSERVATION, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(OBSERVATION, deterministic=True)[0], expected)
    agent(Goal()).learn(26, run_folder=tmp_path / "run")
    resumed = agent(Goal()).learn(34, run_folder=tmp_path / "run", resume=True)
    for one, other in zip(whole.store.transitions(), resumed.store.transitions(), strict=True):
        assert torch.equal(one, other)

    class Renamed(Goal):
        def __init__(self):
            super().__init__()
            parts = dict(self.observation_space.spaces)
            self.observation_space = spaces.Dict({"a": parts.pop("achieved_goal"), **parts})

        def observe(self):
            seen = super().observe()
            return {"a": seen.pop("achieved_goal"), **seen}

    with pytest.raises(CheckpointError, match=r"saved for Dict observations of .*achieved_goal"):
        MPCAgent.load(tmp_path / "agent", env=Renamed(), reward_fn=lambda o, a, n: n[..., 0], **parts)


def test_the_papers_agent_reads_the_goal_as_it_should():
    learner = DGPMPCAgent(Goal(), **{**TINY, "num_layers": 1}).learn(LENGTH + 2)
    assert learner.dynamics.encoder.predicted == [0, 2, 3]
    assert learner.dynamics.encoder.plain == [0, 2, 3]
