"""Saved agents: nothing is lost, learning goes on as if it had not stopped, and what does not fit is named."""

import numpy as np
import pytest
import torch
from gymnasium import spaces

from gym_dgpmpc import MPCAgent
from gym_dgpmpc.agents import collector
from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.checkpoints.format import read_checkpoint
from gym_dgpmpc.errors import CheckpointError, ReliabilityWarning, UnknownRewardError
from tests.agents.point_mass import (
    LENGTH,
    KnownPointMass,
    LinearModel,
    PointMass,
    actions_of,
    agent,
    planner,
    reward_fn,
)
from tests.checkpoints.common import OBSERVATIONS, changed, load


def test_the_loaded_agent_is_the_saved_one(tmp_path):
    learned = agent(actions_per_plan=2, num_particles=3).learn(25)
    learned.save(tmp_path / "agent")
    loaded = load(tmp_path / "agent")
    assert (loaded.num_timesteps, loaded._episode_num, loaded.num_particles) == (25, 2, 3)
    for one, other in zip(learned.store.state_dict().values(), loaded.store.state_dict().values(), strict=True):
        assert torch.equal(one, other)
    for deterministic in (True, False):
        state, other_state = None, None
        for observation in OBSERVATIONS:
            action, state = learned.predict(observation, state, deterministic=deterministic)
            other, other_state = loaded.predict(observation, other_state, deterministic=deterministic)
            np.testing.assert_array_equal(action, other)


@pytest.mark.parametrize("stop", [LENGTH // 2, LENGTH, 5 * LENGTH // 2, 3 * LENGTH])
def test_learning_goes_on_as_if_it_had_not_stopped(stop, tmp_path):
    """From an episode's start, and, in an environment that still runs, from its middle."""
    whole = agent(KnownPointMass(fixed_start=True))
    whole.learn(5 * LENGTH)
    part = agent(KnownPointMass(fixed_start=True))
    part.learn(stop)
    part.save(tmp_path / "part")
    loaded = load(tmp_path / "part", env=part.env, force_reset=stop % LENGTH == 0)
    loaded.learn(5 * LENGTH - stop, reset_num_timesteps=False)
    assert loaded.num_timesteps == 5 * LENGTH
    np.testing.assert_array_equal(actions_of(whole.env.envs[0]), actions_of(loaded.env.envs[0]))


def test_a_checkpoint_from_a_callback_goes_on_too(tmp_path):
    whole = agent(KnownPointMass(fixed_start=True))
    whole.learn(40, callback=lambda locals_, _: whole.num_timesteps != 20 or whole.save(tmp_path / "at_20") is None)
    loaded = load(tmp_path / "at_20")
    assert loaded.num_fitted == 10
    loaded.learn(20, reset_num_timesteps=False)
    np.testing.assert_array_equal(actions_of(whole.env.envs[0])[20:], actions_of(loaded.env.envs[0]))


def test_an_environment_is_not_seeded_twice_with_the_same_number(tmp_path):
    learned = agent(KnownPointMass()).learn(2 * LENGTH)
    learned.save(tmp_path / "agent")
    starts = []
    for _ in range(2):
        loaded = load(tmp_path / "agent", env=KnownPointMass()).learn(LENGTH, reset_num_timesteps=False)
        starts.append(loaded.store.transitions().observation[2 * LENGTH].tolist())
    first = learned.store.transitions().observation[[0, LENGTH]].tolist()
    assert starts[0] == starts[1]
    assert starts[0] not in first


def test_an_untrained_agent_and_one_before_its_first_training(tmp_path):
    agent().save(tmp_path / "fresh")
    loaded = load(tmp_path / "fresh")
    assert not loaded.is_fitted
    loaded.learn(4).save(tmp_path / "exploring")
    assert load(tmp_path / "exploring").learn(8, reset_num_timesteps=False).dynamics.fits == []


def test_rewards_that_were_given_are_given_again(tmp_path):
    agent(PointMass(), reward_fn=reward_fn).learn(12).save(tmp_path / "agent")
    with pytest.raises(UnknownRewardError, match="reward_fn="):
        load(tmp_path / "agent", env=PointMass())
    assert load(tmp_path / "agent", env=PointMass(), reward_fn=reward_fn).task.functions.reward_fn is reward_fn


def test_without_an_environment_an_agent_predicts_if_it_is_given_the_reward(saved):
    parts = {"dynamics": LinearModel(), "planner": planner()}
    with pytest.raises(UnknownRewardError, match="the agent has no environment and no reward_fn was passed"):
        MPCAgent.load(saved, **parts).predict(OBSERVATIONS[0])
    alone = MPCAgent.load(saved, reward_fn=reward_fn, **parts)
    expected = load(saved).predict(OBSERVATIONS[0], deterministic=True)[0]
    np.testing.assert_array_equal(alone.predict(OBSERVATIONS[0], deterministic=True)[0], expected)
    with pytest.raises(ValueError, match=r"no environment to learn in.*set_env"):
        alone.learn(10)
    later = MPCAgent.load(saved, **parts)
    later.set_env(KnownPointMass())
    np.testing.assert_array_equal(later.predict(OBSERVATIONS[0], deterministic=True)[0], expected)


def test_a_new_seed_seeds_the_environment_of_an_agent_that_had_none(tmp_path):
    agent(seed=None).learn(LENGTH).save(tmp_path / "agent")

    def first_observation(**arguments):
        loaded = load(tmp_path / "agent", env=KnownPointMass(), **arguments).learn(1)
        return loaded.store.transitions().observation[LENGTH].tolist()

    assert first_observation(seed=5) == first_observation(seed=5) != first_observation(seed=6)
    assert first_observation() != first_observation()


class Ending(KnownPointMass):
    """Offers a function that says when its episodes end."""

    terminated_fn = staticmethod(lambda after: after[..., 0].abs() > 9.0)


@pytest.fixture(scope="module")
def saved_with_termination(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "agent.zip"
    agent(Ending()).learn(LENGTH).save(path)
    return path


def test_a_termination_function_that_is_missing_is_told_of(saved_with_termination, tmp_path):
    parts = {"dynamics": LinearModel(), "planner": planner(), "reward_fn": reward_fn}
    alone = MPCAgent.load(saved_with_termination, **parts)
    with pytest.warns(UserWarning, match=r"planned with a termination function.*terminated_fn="):
        alone.predict(OBSERVATIONS[0])
    with pytest.warns(UserWarning, match="planned with a termination function"):
        load(saved_with_termination, env=KnownPointMass())
    alone.save(tmp_path / "again")
    with pytest.warns(UserWarning, match="planned with a termination function"):
        MPCAgent.load(tmp_path / "again", **parts).predict(OBSERVATIONS[0])


@pytest.mark.filterwarnings("error")
def test_a_termination_function_that_is_given_again_or_not_wanted_needs_no_warning(saved_with_termination, saved):
    parts = {"dynamics": LinearModel(), "planner": planner(), "reward_fn": reward_fn}
    given = MPCAgent.load(saved_with_termination, terminated_fn=Ending.terminated_fn, **parts)
    given.predict(OBSERVATIONS[0])
    assert given.task.functions.terminated_fn is Ending.terminated_fn
    MPCAgent.load(saved_with_termination, terminated_fn="learned", **parts).predict(OBSERVATIONS[0])
    MPCAgent.load(saved, **parts).predict(OBSERVATIONS[0])
    never = KnownPointMass()
    never.terminated_fn = None
    load(saved_with_termination, env=never)
    later = MPCAgent.load(saved_with_termination, dynamics=LinearModel(), planner=planner())
    later.set_env(Ending())
    later.predict(OBSERVATIONS[0])


def test_an_agent_without_environment_saves_what_its_file_said_of_one(tmp_path):
    from gym_dgpmpc import DGPMPCAgent
    from tests.runs.toy import SMALLEST_AGENT

    DGPMPCAgent("ToyPush-v0", seed=0, **SMALLEST_AGENT).save(tmp_path / "one")
    DGPMPCAgent.load(tmp_path / "one").save(tmp_path / "other")
    one, other = (read_checkpoint(tmp_path / name).config for name in ("one", "other"))
    assert one["values"]["task"] == other["values"]["task"]
    assert one["values"]["task"]["about_environment"]["environment"] == "tests.runs.toy:ToyPush-v0"


def as_if_saved_on_cuda(config, tensors):
    config["values"]["random"]["device"] = "cuda"
    for state in tensors["random"].values():
        state.resize_(16)  # what CUDA's have


def test_a_file_of_another_kind_of_device_begins_new_random_streams(saved, tmp_path):
    path = changed(saved, tmp_path / "cuda.zip", as_if_saved_on_cuda)
    loaded = []
    for _ in range(2):
        with pytest.warns(ReliabilityWarning, match=r"saved on the device 'cuda'.*'cpu'"):
            loaded.append(load(path))
    one, other = (each.generators.state_dict() for each in loaded)
    assert all(torch.equal(one[name], other[name]) for name in one)
    fresh = agent(KnownPointMass(), actions_per_plan=2).generators
    assert not torch.equal(one["planning"], fresh.planning.get_state())  # would repeat the first run's numbers
    assert loaded[0].learn(LENGTH, reset_num_timesteps=False).num_timesteps == 25 + LENGTH


def test_the_episodes_of_logged_means_come_back_however_many_they_are(tmp_path):
    learned = agent(stats_window_size=300_000).learn(12)
    infos = [{"r": -1.5 * i, "l": 10.0, "t": 0.1 * i, "a_keyword_of_a_monitor": 1 / (i + 1)} for i in range(10_000)]
    infos[7]["only_here"] = 3.0
    learned.ep_info_buffer.extend(infos)
    learned.ep_success_buffer.extend([True, False] * 150_000)
    learned.save(tmp_path / "agent")
    loaded = load(tmp_path / "agent")
    assert loaded.ep_info_buffer == learned.ep_info_buffer
    assert loaded.ep_success_buffer == learned.ep_success_buffer
    assert loaded.ep_info_buffer.maxlen == loaded.ep_success_buffer.maxlen == 300_000


def test_what_is_no_number_in_a_monitors_summary_is_left_out(tmp_path):
    learned = agent().learn(1)
    learned.ep_info_buffer.extend([{"r": np.float32(1.0), "l": 3, "map": "maze"}, {"r": 2.0, "l": 4, "map": None}])
    learned.save(tmp_path / "agent")
    assert list(load(tmp_path / "agent").ep_info_buffer) == [{"r": 1.0, "l": 3.0}, {"r": 2.0, "l": 4.0}]


def test_other_spaces_are_named(saved):
    env = KnownPointMass()
    env.action_space = spaces.Box(-3.0, 3.0, (1,), np.float32)
    with pytest.raises(CheckpointError, match=r"actions Box\(-2.0, 2.0.*has .*Box\(-3.0, 3.0"):
        load(saved, env=env)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, t: c.update(num_envs=0), "says 0"),
        (lambda c, t: c.update(num_envs=10**6), "says 1000000"),
        (lambda c, t: c.update(num_envs="1"), "says '1'"),
        (lambda c, t: c.pop("num_envs"), "says None"),
        (lambda c, t: c.update(values=3), "task"),
        (lambda c, t: c["values"].update(progress=[]), "progress"),
        (lambda c, t: c["values"].update(evil={}), "'evil'"),
        (lambda c, t: t.update(evil={}), "'evil'"),
        (lambda c, t: t.pop("dynamics"), "dynamics"),
        (lambda c, t: t.pop("logs"), "logs"),
        (lambda c, t: c["values"].pop("task"), "KeyError"),
        (lambda c, t: c["values"]["task"].pop("reward"), "'reward'"),
        (lambda c, t: c["values"]["task"].update(reward="no"), "'no'"),
        (lambda c, t: c["values"]["task"].update(reward=True), "predicts the reward or termination too"),
        (lambda c, t: c["values"]["task"].update(to_learn={"env": True}), "'env'"),
        (lambda c, t: c["values"]["task"].update(to_learn=[1]), "1"),
        (lambda c, t: c["values"]["task"].update(about_environment=[1]), "1"),
        (lambda c, t: about(c).update(reset_options=3), "3"),
        (lambda c, t: about(c).update(reset_options=[{}, 3]), "3"),
        (lambda c, t: c["values"]["progress"].update(num_timesteps="x"), "num_timesteps .*'x'"),
        (lambda c, t: c["values"]["progress"].update(num_timesteps=-1), "num_timesteps .*-1"),
        (lambda c, t: c["values"]["progress"].update(num_timesteps=True), "num_timesteps .*True"),
        (lambda c, t: c["values"]["progress"].update(num_episodes=10**30), "num_episodes .*10{30}"),
        (lambda c, t: c["values"]["progress"].pop("num_fitted"), "num_fitted"),
        (lambda c, t: t["progress"].update(last_observation=torch.zeros(1, 3)), r"\(1, 3\)"),
        (lambda c, t: t["progress"].update(last_observation=torch.zeros(())), "does not fit"),
        (lambda c, t: t["progress"].pop("last_episode_starts"), "last_episode_starts"),
        (lambda c, t: t["transitions"].pop("reward"), "fields"),
        (lambda c, t: t["transitions"].update(action=torch.zeros(25, 3)), "action"),
        (lambda c, t: t["transitions"]["observation"].fill_(torch.nan), "finite"),
        (lambda c, t: t["random"].update(fit=torch.zeros(3, dtype=torch.uint8)), "RuntimeError"),
        (lambda c, t: t["random"].pop("planning"), "planning"),
        (lambda c, t: c["values"]["random"].pop("seeds_environment"), "seeds_environment"),
        (lambda c, t: c["values"]["logs"].update(run="../elsewhere"), "'../elsewhere'"),
        (lambda c, t: c["values"]["logs"].update(run=3), "does not fit"),
        (lambda c, t: c["values"]["logs"].update(waiting=[["a", 1.0, -1, None]]), "-1"),
        (lambda c, t: c["values"]["logs"].update(waiting=[["a", 1.0, 0, [3]]]), "3"),
        (lambda c, t: c["values"]["logs"].update(waiting=[["a", 1.0]]), "does not fit"),
        (lambda c, t: t["logs"].pop("ep_info.r"), "'r'"),
        (lambda c, t: t["episodes"].pop("plan.mean"), "plan.mean"),
        (lambda c, t: t["episodes"].update({"plan.mean": torch.zeros(1, 6, 1)}), r"\(1, 6, 1\)"),
        (lambda c, t: t["episodes"].update({"plan.mean": torch.full((1, 5, 1), torch.nan)}), "nan"),
        (lambda c, t: t["episodes"].update({"plan.age": torch.tensor([7])}), r"\[7\]"),
        (lambda c, t: t["episodes"].pop("plan.age"), "plan.age"),
        (lambda c, t: t["episodes"].pop("0.record.rewards"), "rewards"),
        (lambda c, t: t["episodes"].update({"0.record.plan_steps": torch.zeros(99)}), "99"),
        (lambda c, t: c["values"]["episodes"].pop("0.has_explored"), "0.has_explored"),
        (lambda c, t: c["values"]["episodes"].update({"0.index": 10**30}), "10{30}"),
        (lambda c, t: c["values"]["episodes"].update({"0.index": "0"}), "'0'"),
        (lambda c, t: c["values"]["episodes"].update({"0.number": -2}), "-2"),
        (lambda c, t: t["spaces"].pop("action_space.low"), "spaces"),
        (lambda c, t: c["space_dtypes"].update(action_space="object"), "spaces"),
        (lambda c, t: t["spaces"].update({"action_space.low": torch.zeros(2)}), "spaces"),
    ],
)
def test_contents_that_do_not_fit_are_named(change, message, saved, tmp_path):
    with pytest.raises(CheckpointError, match=message):
        load(changed(saved, tmp_path / "changed.zip", change))


def about(config):
    return config["values"]["task"]["about_environment"]


@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize(
    "episode", [{}, [], "x", {"goes_on": True}, {"goes_on": True, "num_steps": 0}, {"goes_on": False, "now": 3}]
)
def test_a_run_whose_episode_is_not_described_is_refused(episode, seed, tmp_path):
    agent(seed=seed).learn(5, run_folder=tmp_path)
    changed(tmp_path / "agent.zip", tmp_path / "agent.zip", lambda c, t: c.update(episode=episode))
    with pytest.raises(CheckpointError, match="episode"):
        agent(seed=seed).learn(12, run_folder=tmp_path, resume=True)


class Counting(EpisodeRecord):
    """A record with one field more, which older files do not have."""

    num_rests = 0

    def add_reward(self, reward, *, terminated=False):
        super().add_reward(reward, terminated=terminated)
        self.num_rests += 1

    def state_dict(self):
        return {**super().state_dict(), "num_rests": torch.tensor(self.num_rests)}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.num_rests = int(state.get("num_rests", 0))


def test_a_field_of_a_noun_is_an_edit_of_that_noun_alone(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(collector, "EpisodeRecord", Counting)
    older = load(saved)
    assert [record.num_rests for record in older.episode_records] == [0]
    learned = agent(KnownPointMass()).learn(2 * LENGTH + 3)
    learned.save(tmp_path / "agent")
    loaded = load(tmp_path / "agent", env=learned.env, force_reset=False)
    assert [record.num_rests for record in loaded.episode_records] == [3]
    loaded.learn(4, reset_num_timesteps=False)
    assert [record.num_rests for record in loaded.episode_records] == [7]


def test_the_record_of_a_running_episode_comes_back(saved):
    (record,) = load(saved).episode_records
    assert (record.number, len(record.rewards)) == (3, 25 - 2 * LENGTH)
