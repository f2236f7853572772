"""Environments whose episodes follow on one another: a run that goes on, and an agent that is loaded, meet the next."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc import MPCAgent
from gym_dgpmpc.checkpoints.format import read_checkpoint, write_checkpoint
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.planning import CEM
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, agent


class Numbered(KnownPointMass):
    """Begins episode k at 0.5 + k / 100, whatever its seed."""

    can_replay = True

    def __init__(self):
        super().__init__()
        self.episode, self.has_stepped = 0, False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options:
            self.episode = options["episode"]
        elif seed is not None:
            self.episode = 0
        elif self.has_stepped:
            self.episode += 1
        self.has_stepped = False
        self.state = np.array([0.5 + self.episode / 100, 0.0])
        return self.state.copy(), {}

    def step(self, action):
        self.has_stepped = True
        return super().step(action)

    def options_to_reset(self, again):
        return {"episode": self.episode + (0 if again else int(self.has_stepped))}


class Plant(Numbered):
    can_replay = False


def starts(learner):
    first = np.flatnonzero(np.diff(learner.store.episodes.numpy(), prepend=-1))
    return [round(100 * (float(place) - 0.5)) for place in learner.store.transitions().observation[first, 0]]


@pytest.mark.parametrize("stop", [20, 23])
def test_a_resumed_run_is_the_whole_one(stop, tmp_path):
    whole = agent(Numbered()).learn(45)
    assert starts(whole) == [0, 1, 2, 3, 4]
    agent(Numbered()).learn(stop, run_folder=tmp_path)
    resumed = agent(Numbered()).learn(45, run_folder=tmp_path, resume=True)
    for one, other in zip(whole.store.state_dict().values(), resumed.store.state_dict().values(), strict=True):
        assert torch.equal(one, other)


def test_where_an_episode_cannot_go_on_the_next_one_begins(tmp_path):
    agent(Plant()).learn(23, run_folder=tmp_path)
    assert starts(agent(Plant()).learn(45, run_folder=tmp_path, resume=True)) == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(("stop", "expected"), [(20, [0, 1, 2, 3]), (23, [0, 1, 2, 2, 3])])
def test_a_loaded_agent_begins_the_running_episode_again(stop, expected, tmp_path):
    agent(Numbered()).learn(stop).save(tmp_path / "agent")
    loaded = MPCAgent.load(tmp_path / "agent", env=Numbered(), dynamics=LinearModel(), planner=agent().planner)
    assert starts(loaded.learn(2 * LENGTH, reset_num_timesteps=False)) == expected


def test_several_of_them(tmp_path):
    env = DummyVecEnv([Numbered] * 2)
    learner = agent(env).learn(2 * 13)
    learner.save(tmp_path / "agent")
    loaded = MPCAgent.load(
        tmp_path / "agent", env=DummyVecEnv([Numbered] * 2), dynamics=LinearModel(), planner=learner.planner
    )
    loaded.learn(4, reset_num_timesteps=False)
    assert loaded.store.transitions().observation[26:28, 0].tolist() == pytest.approx([0.51] * 2)


def test_options_of_the_wrong_kind_are_named(tmp_path):
    agent(Numbered()).learn(3).save(tmp_path / "agent")
    checkpoint = read_checkpoint(tmp_path / "agent")
    checkpoint.config["values"]["task"]["about_environment"]["reset_options"] = ["4"]
    write_checkpoint(checkpoint, tmp_path / "agent")
    with pytest.raises(CheckpointError, match="options for the environment's reset cannot be read"):
        MPCAgent.load(tmp_path / "agent", env=Numbered(), dynamics=LinearModel(), planner=agent().planner)


def reacher():
    """Random actions suffice: what is tested are the targets."""
    bound = torch.full((7,), 20.0)
    cem = CEM(action_low=-bound, action_high=bound, horizon=2, num_candidates=4, num_elites=2, num_iterations=1)
    env = gym.wrappers.TimeLimit(gym.make("BiasedReacher-v0").unwrapped, 6)
    return env, {"dynamics": LinearModel(), "planner": cem}


def targets(learner):
    return learner.store.transitions().observation[:, 7:10].unique_consecutive(dim=0)


def test_the_papers_reacher_meets_the_same_targets_however_it_is_interrupted(tmp_path):
    def made():
        env, parts = reacher()
        return MPCAgent(env, **parts, learning_starts=1000, seed=5)

    whole = made().learn(27)
    assert len(targets(whole)) == 5
    made().learn(15, run_folder=tmp_path)
    resumed = made().learn(27, run_folder=tmp_path, resume=True)
    assert torch.equal(resumed.store.transitions().next_observation, whole.store.transitions().next_observation)
    part = made().learn(15)
    part.save(tmp_path / "loaded")
    env, parts = reacher()
    loaded = MPCAgent.load(tmp_path / "loaded", env=env, **parts).learn(12, reset_num_timesteps=False)
    # The third episode, which had been begun, is begun again.
    assert torch.equal(targets(loaded), targets(whole)[:4])
