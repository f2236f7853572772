"""Several environments at once, tasks that never end, and actions of any scale."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.errors import CheckpointError, EnvironmentDataError, EnvironmentFailedError
from gym_dgpmpc.planning import CEM
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, agent, planner
from tests.agents.test_dgp_mpc import TINY


def several(count=3, **arguments):
    return DummyVecEnv([lambda: KnownPointMass(**arguments)] * count)


def steps_of(env):
    return [each.unwrapped.steps for each in env.unwrapped.envs]


def test_one_store_holds_what_all_did_with_an_episode_for_each():
    learner = agent(several()).learn(3 * 25)
    assert learner.num_timesteps == len(learner.store) == 75
    data, episodes = learner.store.transitions(), learner.store.episodes
    for index, steps in enumerate(steps_of(learner.env)):
        rows = torch.arange(index, 75, 3)
        for stored, column in zip(data, zip(*steps, strict=True), strict=True):
            np.testing.assert_allclose(stored[rows], np.array(column), atol=1e-6)
        assert episodes[rows].tolist() == [3 * (i // LENGTH) + index for i in range(25)]
        # Within an episode one step begins where the last one ended.
        same = (episodes[rows].diff() == 0).nonzero().squeeze()
        assert torch.equal(data.next_observation[rows][same], data.observation[rows][same + 1])


def test_it_learns_the_point_mass_in_each():
    learner = agent(several(fixed_start=True)).learn(3 * 3 * LENGTH)
    returns = learner.store.rewards.reshape(3, LENGTH, 3).sum(1)
    assert learner.dynamics.fits == [30, 60, 90]
    assert learner.dynamics.resamples == 2 * LENGTH
    assert (returns[1:] > -4.0).all()


def test_plans_of_one_moment_share_their_worlds_and_nothing_else():
    drawn, starts = [], []

    class Counting(LinearModel):
        def draw(self, num_particles, horizon, generator):
            drawn.append(num_particles)
            return super().draw(num_particles, horizon, generator)

    learner = agent(several(), dynamics=Counting(), actions_per_plan=2)
    make = learner.planner.plan

    def recorded(objective, plan, generator, deadline):
        starts.append(plan.mean.clone())
        return make(objective, plan, generator, deadline)

    learner.planner.plan = recorded
    learner.learn(3 * 2 * LENGTH)
    assert drawn == [5] * (LENGTH // 2)
    assert len(starts) == 3 * LENGTH // 2
    cold = learner.planner.initial_plan().mean
    assert all(torch.equal(start, cold) for start in starts[:3])
    assert not torch.equal(starts[3], starts[4])


class Uneven(KnownPointMass):
    """Terminates after as many steps as it is told."""

    terminated_fn = staticmethod(lambda after: after[..., 0].abs() > 1e6)

    def __init__(self, length):
        super().__init__()
        self.length = length

    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, self.time >= self.length, info


def test_episodes_that_end_at_different_times():
    """All act at random until each has finished an episode; training follows each episode that begins."""
    learner = agent(DummyVecEnv([lambda: Uneven(4), lambda: Uneven(7)]))
    learner.learn(2 * 15)
    assert learner.dynamics.fits == [14, 16, 24, 28]
    assert learner.dynamics.resamples == 15 - 7
    of_first, of_second = learner.store.episodes[::2].tolist(), learner.store.episodes[1::2].tolist()
    assert [len(list(group)) for group in _groups(of_first)] == [4, 4, 4, 3]
    assert [len(list(group)) for group in _groups(of_second)] == [7, 7, 1]
    assert not set(of_first) & set(of_second)
    assert learner._episode_num == 5


def _groups(numbers):
    return [[n for n in numbers if n == each] for each in dict.fromkeys(numbers)]


def test_the_seed_decides_everything_and_envs_differ():
    runs = [agent(several(), seed=seed).learn(60) for seed in (3, 3, 4)]
    data = [run.store.transitions().next_observation for run in runs]
    assert torch.equal(data[0], data[1]) and not torch.equal(data[0], data[2])
    assert len(data[0][:3].unique(dim=0)) == 3


def test_a_failing_environment_costs_that_step_of_all():
    env = DummyVecEnv([KnownPointMass, lambda: KnownPointMass(fail_at=4), KnownPointMass])
    learner = agent(env)
    with pytest.raises(EnvironmentDataError, match=r"step 13: next_observation\[0\] .*nan"):
        learner.learn(60)
    assert len(learner.store) == learner.num_timesteps == 12
    learner.learn(48, reset_num_timesteps=False)
    assert len(learner.store) == 60
    raising = DummyVecEnv([KnownPointMass, lambda: KnownPointMass(fail_at=2, failure=OSError("gone"))])
    with pytest.raises(EnvironmentFailedError, match=r"step 4: .*OSError: gone"):
        agent(raising).learn(20)


def test_a_run_goes_on_with_its_data_and_new_episodes(tmp_path):
    agent(several()).learn(3 * 14, run_folder=tmp_path)
    resumed = agent(several())
    resumed.learn(3 * 33, run_folder=tmp_path, resume=True)
    assert resumed.num_timesteps == len(resumed.store) == 99
    assert resumed.dynamics.fits == [3 * 14, 3 * 24]
    assert len(torch.unique(resumed.store.episodes)) == 3 * (2 + 2)
    with pytest.raises(CheckpointError, match=r"\b3 environments.*\b2\b"):
        agent(several(2)).learn(1, run_folder=tmp_path, resume=True)


def test_checkpoints_within_an_episode(tmp_path):
    learner = agent(several())
    with pytest.raises(KeyboardInterrupt):
        learner.learn(300, _stop_at(27), run_folder=tmp_path, checkpoint_every=10)
    assert len(agent(several()).learn(24, run_folder=tmp_path, resume=True).store) == 24


def _stop_at(step):
    def callback(locals_, globals_):
        if locals_["self"].num_timesteps >= step:
            raise KeyboardInterrupt
        return True

    return callback


@pytest.mark.parametrize("count", [1, 4])
def test_a_file_of_several_serves_another_number(count, tmp_path):
    learner = agent(several()).learn(3 * 13)
    learner.save(tmp_path / "agent")
    parts = {"dynamics": LinearModel(), "planner": planner()}
    loaded = MPCAgent.load(tmp_path / "agent", env=several(count), **parts)
    observation = np.array([0.4, 0.1])
    expected = learner.predict(observation, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], expected)
    loaded.learn(count * 7, reset_num_timesteps=False)
    assert len(loaded.store) == 39 + 7 * count
    learner.set_env(several(count))
    assert len(learner.learn(count * 2, reset_num_timesteps=False).store) == 39 + 2 * count
    same = MPCAgent.load(tmp_path / "agent", env=learner.env if count == 3 else several(3), **parts, force_reset=False)
    assert [running.index for running in same.collector.running] == [3, 4, 5]


def test_environments_in_other_processes():
    env = make_vec_env(KnownPointMass, n_envs=2, vec_env_cls=SubprocVecEnv)
    try:
        assert len(agent(env).learn(2 * 12).store) == 24
    finally:
        env.close()


class Endless(KnownPointMass):
    """Goes on for ever."""

    terminated_fn = None

    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


def test_a_task_that_never_ends_trains_every_so_many_steps(tmp_path):
    learner = agent(Endless(), learning_starts=12, train_freq=8)
    learner.learn(41)
    assert learner.dynamics.fits == [12, 20, 28, 36]
    assert learner.dynamics.resamples == 29
    assert (learner.store.episodes == 0).all()
    whole = learner.store.transitions()
    part = agent(Endless(), learning_starts=12, train_freq=8)
    part.learn(23)
    part.save(tmp_path / "agent")
    loaded = MPCAgent.load(
        tmp_path / "agent", env=part.env, dynamics=LinearModel(), planner=planner(), force_reset=False
    )
    assert loaded.train_freq == 8
    loaded.learn(18, reset_num_timesteps=False)
    assert torch.equal(loaded.store.transitions().next_observation, whole.next_observation)


def test_a_task_that_never_ends_is_explored_until_the_first_training_is_due():
    learner = agent(Endless(), train_freq=8).learn(20)
    assert learner.dynamics.fits == [8, 16]
    assert not learner.is_exploring


def test_an_agent_that_waits_for_an_end_says_so(monkeypatch):
    monkeypatch.setattr("gym_dgpmpc.agents.exploration.ENDLESS", 30)
    with pytest.warns(UserWarning, match=r"\b30 random steps.*TimeLimit.*learning_starts"):
        assert agent(Endless()).learn(40).is_exploring


def test_training_every_so_many_steps_goes_before_episodes():
    learner = agent(train_freq=15).learn(50)
    assert learner.dynamics.fits == [10, 25, 40]
    with pytest.raises(ValueError, match=r"train_freq .* 0$"):
        agent(train_freq=0)


class Scales(KnownPointMass):
    """Pushed by two forces, of which one is given in thousandths and the other in thousands."""

    def __init__(self):
        super().__init__(fixed_start=True)
        self.action_space = spaces.Box(np.array([-1e-3, 0.0]), np.array([1e-3, 2e3]), dtype=np.float32)

    @staticmethod
    def reward_fn(observation, action, next_observation):
        return -(next_observation[..., 0] ** 2)

    def step(self, action):
        assert self.action_space.contains(action)
        observation, _, *rest = super().step(np.array([1e3 * action[0] + 1e-3 * (action[1] - 1e3)]))
        return observation, float(-(observation[0] ** 2)), *rest


def test_actions_of_mixed_scales():
    """Standing still costs ten, the middle of the action range being no force at all."""
    low, high = (torch.as_tensor(bound) for bound in (Scales().action_space.low, Scales().action_space.high))
    cem = CEM(action_low=low, action_high=high, horizon=6, num_candidates=80, num_elites=8, num_iterations=5)
    learner = DGPMPCAgent(Scales(), **{**TINY, "num_layers": 1, "first_training_iterations": 300})
    assert torch.equal(learner.planner.action_high, high)

    class Standardising(LinearModel):
        """A regression that gives each number its own scale, as every model of the package does."""

        scale = torch.tensor([1e3, 1e-3])

        def _solve(self, data, generator):
            super()._solve(data._replace(action=data.action * self.scale), generator)

        def draw(self, *arguments):
            sampler = super().draw(*arguments)
            return lambda observation, action, step: sampler(observation, action * self.scale, step)

    made = MPCAgent(Scales(), Standardising(), cem, seed=0).learn(4 * LENGTH)
    returns = made.store.rewards.reshape(4, LENGTH).sum(1)
    assert (returns[1:] > -4.0).all()
    learner.learn(3 * LENGTH)
    assert learner.store.rewards[LENGTH:].reshape(2, LENGTH).sum(1).max() > -7.0


def test_the_papers_agent_in_two_environments(tmp_path):
    def made():
        return DGPMPCAgent(several(2, fixed_start=True), **{**TINY, "num_layers": 2})

    learner = made().learn(2 * (LENGTH + 3))
    learner.save(tmp_path / "agent")
    loaded = DGPMPCAgent.load(tmp_path / "agent", env=learner.env, force_reset=False)
    loaded.learn(6, reset_num_timesteps=False)
    whole = made().learn(2 * (LENGTH + 3) + 6)
    for one, other in zip(whole.store.state_dict().values(), loaded.store.state_dict().values(), strict=True):
        assert torch.equal(one, other)
