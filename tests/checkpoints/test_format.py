"""Saved agents: nothing is lost, learning goes on as if it had not stopped, and only named errors come of bad files."""

import io
import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces

from gym_dgpmpc import MPCAgent
from gym_dgpmpc.checkpoints import reading
from gym_dgpmpc.checkpoints.format import Checkpoint, read_checkpoint, write_checkpoint
from gym_dgpmpc.errors import CheckpointError, CheckpointWriteError, ReliabilityWarning, UnknownRewardError
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

OBSERVATIONS = np.random.default_rng(0).normal(size=(4, 2))


def load(path, env=None, **arguments):
    env = KnownPointMass(fixed_start=True) if env is None else env
    return MPCAgent.load(path, env=env, dynamics=LinearModel(), planner=planner(), **arguments)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "agent.zip"
    agent(KnownPointMass(fixed_start=True), actions_per_plan=2).learn(25).save(path)
    return path


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


@pytest.mark.parametrize("name", ["agent", "agent.zip", "folder/new/agent_20_steps.zip", "agent.v1"])
def test_paths_are_sb3s(name, tmp_path):
    agent().learn(12).save(str(tmp_path / name))
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    expected = tmp_path / (name if "." in name else f"{name}.zip")
    assert written == [expected]
    assert load(str(tmp_path / name)).num_timesteps == load(expected).num_timesteps == 12


def test_file_objects():
    buffer = io.BytesIO()
    agent().learn(12).save(buffer)
    assert load(buffer).num_timesteps == 12


def test_the_same_agent_gives_the_same_bytes(tmp_path):
    for name in ("one", "other"):
        agent(tensorboard_log=None).learn(9).save(tmp_path / name)
    one, other = (read_checkpoint(tmp_path / name) for name in ("one", "other"))
    for checkpoint_ in (one, other):
        checkpoint_.tensors["agent"].pop("record.0.seconds")  # wall-clock time
    assert one.config == other.config
    assert all(torch.equal(one.tensors[p][n], other.tensors[p][n]) for p in one.tensors for n in one.tensors[p])


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


def test_arguments_can_be_replaced(saved):
    other = load(saved, num_particles=9, verbose=0)
    assert other.num_particles == 9
    assert load(saved).num_particles == 5
    reseeded = load(saved, seed=77)
    assert reseeded.seed == 77
    assert not torch.equal(reseeded.generators.planning.get_state(), load(saved).generators.planning.get_state())
    with pytest.raises(CheckpointError, match="no_such_argument"):
        load(saved, no_such_argument=1)


def test_a_new_seed_seeds_the_environment_of_an_agent_that_had_none(tmp_path):
    agent(seed=None).learn(LENGTH).save(tmp_path / "agent")

    def first_observation(**arguments):
        loaded = load(tmp_path / "agent", env=KnownPointMass(), **arguments).learn(1)
        return loaded.store.transitions().observation[LENGTH].tolist()

    assert first_observation(seed=5) == first_observation(seed=5) != first_observation(seed=6)
    assert first_observation() != first_observation()


@pytest.mark.parametrize("replaced", [{"planner": planner(horizon=7)}, {"actions_per_plan": 1}])
def test_a_plan_that_no_longer_fits_begins_anew(replaced, saved):
    assert load(saved)._running[0].carried.age == 1
    replaced = {"env": KnownPointMass(), "dynamics": LinearModel(), "planner": planner(), **replaced}
    loaded = MPCAgent.load(saved, **replaced)
    assert loaded.collector.running[0].carried is loaded.controller.cold
    assert loaded.learn(LENGTH, reset_num_timesteps=False).num_timesteps == 25 + LENGTH


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
    about = ("environment", "observation_parts", "reset_options", "has_terminated_fn")
    assert one["environment"] == "tests.runs.toy:ToyPush-v0"
    assert [one[name] for name in about] == [other[name] for name in about]


def as_if_saved_on_cuda(config, tensors):
    config["device"] = "cuda"
    for state in tensors["generators"].values():
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, t: c.update(versions="x" * reading.MAX_JSON_BYTES), r"'config.json' has \d+ bytes, more than"),
        (lambda c, t: c.update(versions={"a": np.int64(3)}), "int64 is not JSON serializable"),
        (lambda c, t: c.update(versions={"a": np.nan}), "not JSON compliant"),
        (lambda c, t: c.update(versions=10**500), "a number of 501 digits"),
        (lambda c, t: t["agent"].update({"x" * reading.MAX_HEADER_BYTES: torch.zeros(1)}), "its header claims"),
        (lambda c, t: t["agent"].update(bound=torch.zeros(1, dtype=torch.complex64)), "of the kind 'C64'"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(change, message, saved, tmp_path):
    path = Path(shutil.copy(saved, tmp_path / "agent.zip"))
    with pytest.raises(CheckpointWriteError, match=f"agent.zip is not written, .*{message}"):
        changed(saved, path, change)
    assert path.read_bytes() == saved.read_bytes()


def test_a_file_that_would_be_too_large_is_not_written(saved, tmp_path, monkeypatch):
    checkpoint = read_checkpoint(saved)
    monkeypatch.setattr(reading, "MAX_FILE_BYTES", 100)
    with pytest.raises(CheckpointWriteError, match=r"bytes, more than an agent's file may have \(100\)"):
        write_checkpoint(checkpoint, io.BytesIO())


def test_an_agent_that_could_not_be_loaded_again_is_not_saved(tmp_path):
    larger = agent(num_particles=20_000)
    with pytest.raises(CheckpointWriteError, match=r"could not be loaded again: .*num_particles = 20000 is larger"):
        larger.learn(LENGTH, run_folder=tmp_path)
    assert larger.num_timesteps == 0  # before anything can be lost


def test_numbers_of_numpy_and_paths_are_saved_as_pythons(tmp_path, unchecked):
    from gym_dgpmpc import DGPMPCAgent
    from tests.runs.toy import SMALLEST_AGENT

    numbers = {"horizon": np.int64(4), "step_size": np.float32(0.5), "time_budget": np.float64(9)}
    DGPMPCAgent("ToyPush-v0", **{**SMALLEST_AGENT, **numbers}).save(tmp_path / "agent")
    loaded = DGPMPCAgent.load(tmp_path / "agent")
    for name, number in numbers.items():
        assert getattr(loaded, name) == number
        assert type(getattr(loaded, name)) is type(number.item())
    agent(tensorboard_log=tmp_path / "logs").learn(12).save(tmp_path / "agent")
    assert load(tmp_path / "agent").tensorboard_log == str(tmp_path / "logs")
    assert (tmp_path / "logs" / "MPC_1").is_dir()


def test_other_spaces_are_named(saved):
    env = KnownPointMass()
    env.action_space = spaces.Box(-3.0, 3.0, (1,), np.float32)
    with pytest.raises(CheckpointError, match=r"actions Box\(-2.0, 2.0.*has .*Box\(-3.0, 3.0"):
        load(saved, env=env)


def test_a_missing_file_is_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match="is a folder"):
        load(tmp_path)


def members_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(path, members, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def changed(saved, path, change):
    """The saved file with its config edited, checksums right."""
    config, tensors, _ = read_checkpoint(saved)
    change(config, tensors)
    write_checkpoint(Checkpoint(config, tensors), path)
    return path


def test_no_pickle_is_inside(saved):
    assert sorted(members_of(saved)) == [
        "agent.safetensors", "config.json", "dynamics.safetensors", "generators.safetensors", "manifest.json",
        "transitions.safetensors",
    ]  # fmt: skip


class Bomb:
    def __reduce__(self):
        return os.putenv, ("THE_FILE_RAN_CODE", "1")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a checkpoint"),
        (b"nonsense", "not a checkpoint"),
        (pickle.dumps(Bomb()), "not a checkpoint"),
        (b"PK\x03\x04" + bytes(100), "not a checkpoint"),
    ],
)
def test_files_that_are_not_ours(content, message, tmp_path, monkeypatch):
    monkeypatch.setattr(pickle, "loads", None)
    monkeypatch.setattr(torch, "load", None)
    (tmp_path / "file.zip").write_bytes(content)
    with pytest.raises(CheckpointError, match=f"file.zip is {message}"):
        load(tmp_path / "file.zip")


def test_an_sb3_file_is_refused_without_being_unpickled(tmp_path):
    zipped(
        tmp_path / "sb3.zip", {"data": b"{}", "policy.pth": pickle.dumps(Bomb()), "_stable_baselines3_version": b"2"}
    )
    with pytest.raises(CheckpointError, match=r"no manifest.json"):
        load(tmp_path / "sb3.zip")


def test_every_truncation_is_an_error(saved, tmp_path):
    data = saved.read_bytes()
    for length in sorted({*range(0, len(data), len(data) // 60), *range(len(data) - 40, len(data), 3)}):
        (tmp_path / "cut.zip").write_bytes(data[:length])
        with pytest.raises(CheckpointError):
            load(tmp_path / "cut.zip")


def test_every_flipped_byte_is_an_error_or_harmless(saved, tmp_path):
    data = bytearray(saved.read_bytes())
    expected = load(saved).predict(OBSERVATIONS[0], deterministic=True)[0]
    for place in np.random.default_rng(1).integers(0, len(data), 60):
        damaged = data.copy()
        damaged[place] ^= 0x55
        (tmp_path / "flipped.zip").write_bytes(damaged)
        try:
            loaded = load(tmp_path / "flipped.zip")
        except CheckpointError:
            continue
        np.testing.assert_array_equal(loaded.predict(OBSERVATIONS[0], deterministic=True)[0], expected)


def test_a_checksum_that_does_not_match_names_the_member(saved, tmp_path):
    members = members_of(saved)
    members["dynamics.safetensors"] = members["dynamics.safetensors"][:-1] + b"\0"
    with pytest.raises(CheckpointError, match=r"checksum of 'dynamics.safetensors'"):
        load(zipped(tmp_path / "file.zip", members))


def test_a_newer_schema_says_what_to_do(saved, tmp_path):
    members = members_of(saved)
    manifest = json.loads(members["manifest.json"])
    members["manifest.json"] = json.dumps(manifest | {"schema": 99}).encode()
    with pytest.raises(CheckpointError, match=r"schema 99.*reads up to 4.*version that wrote it"):
        load(zipped(tmp_path / "file.zip", members))
    members["manifest.json"] = json.dumps(manifest | {"format": "something else"}).encode()
    with pytest.raises(CheckpointError, match="its format is 'something else'"):
        load(zipped(tmp_path / "file.zip", members))
    members["manifest.json"] = b"[" * 100_000
    with pytest.raises(CheckpointError, match="damaged"):
        load(zipped(tmp_path / "file.zip", members))
    members["manifest.json"] = b'{"a": 1, "a": 2}'
    with pytest.raises(CheckpointError, match="names something twice"):
        load(zipped(tmp_path / "file.zip", members))
    members["manifest.json"] = b'{"a": NaN}'
    with pytest.raises(CheckpointError, match="the number NaN"):
        load(zipped(tmp_path / "file.zip", members))
    members["manifest.json"] = b'{"a": ' + b"9" * 500 + b"}"
    with pytest.raises(CheckpointError, match="500 digits"):
        load(zipped(tmp_path / "file.zip", members))
    members["manifest.json"] = b"[]"
    with pytest.raises(CheckpointError, match="not an object"):
        load(zipped(tmp_path / "file.zip", members))


def test_compressed_additional_and_repeated_members(saved, tmp_path):
    members = members_of(saved)
    with pytest.raises(CheckpointError, match="compressed"):
        load(zipped(tmp_path / "bomb.zip", members, compression=zipfile.ZIP_DEFLATED))
    with pytest.raises(CheckpointError, match="not those of its manifest"):
        load(zipped(tmp_path / "more.zip", {**members, "../../evil.py": b"1"}))
    with zipfile.ZipFile(tmp_path / "more.zip", "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("config.json", b"{}")
    with pytest.raises(CheckpointError, match="repeated"):
        load(tmp_path / "more.zip")


def test_sizes_are_bounded(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MAX_JSON_BYTES", 100)
    with pytest.raises(CheckpointError, match=r"'config.json' has \d+ bytes, more than it may"):
        load(saved)
    monkeypatch.setattr(reading, "MAX_FILE_BYTES", 100)
    with pytest.raises(CheckpointError, match="more than an agent's file may have"):
        load(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, t: c.update({"class": "os.system"}), "class 'os.system'"),
        (lambda c, t: c.update({"class": ["MPCAgent"]}), "class"),
        (lambda c, t: c.pop("class"), "class None"),
        (lambda c, t: c["arguments"].pop("seed"), "arguments are not those"),
        (lambda c, t: c["arguments"].update(env="evil:Env-v0"), "arguments are not those"),
        (lambda c, t: c["arguments"].update(num_particles="many"), "no MPCAgent can be made"),
        (lambda c, t: c["arguments"].update(num_particles=10**12), "num_particles = 1000000000000 is larger"),
        (lambda c, t: c["arguments"].update(num_particles=10**5), "num_particles = 100000 is larger"),
        (lambda c, t: c["arguments"].update(seed=-3), "no MPCAgent can be made"),
        (lambda c, t: c["arguments"].update(verbose={"a": 1}), "argument that cannot be read"),
        (lambda c, t: c.pop("arguments"), "arguments are not those"),
        (lambda c, t: c.pop("counters"), "does not fit"),
        (lambda c, t: c.update(modelled=[]), "does not fit"),
        (lambda c, t: c["modelled"].update(reward=True), "the file's model predicts the reward or termination too"),
        (lambda c, t: c.update(to_learn={"env": True}), "what was to be learned"),
        (lambda c, t: c.pop("running"), "does not describe the episodes"),
        (lambda c, t: c.update(running=[]), "0 environments"),
        (lambda c, t: c.update(running=[{"index": 0}]), "does not describe the episodes"),
        (lambda c, t: c.update(running=[{"index": 10**30, "has_explored": True}]), "does not describe the episodes"),
        (lambda c, t: c["counters"].update(num_timesteps="x"), "counter num_timesteps = x is none"),
        (lambda c, t: c["counters"].update(num_timesteps=-1), "counter num_timesteps = -1 is none"),
        (lambda c, t: c["counters"].update(_episode_num=10**30), "counter _episode_num = 10{30} is none"),
        (lambda c, t: c.update(values=3), "does not fit"),
        (lambda c, t: t.pop("dynamics"), "does not fit"),
        (lambda c, t: t["transitions"].pop("reward"), "fields"),
        (lambda c, t: t["transitions"].update(action=torch.zeros(25, 3)), "action"),
        (lambda c, t: t["transitions"]["observation"].fill_(torch.nan), "finite"),
        (lambda c, t: t["generators"].update(fit=torch.zeros(3, dtype=torch.uint8)), "does not fit"),
        (lambda c, t: t["agent"].pop("plan.mean"), "does not fit"),
        (lambda c, t: t["agent"].update({"plan.age": torch.tensor([7])}), "does not fit"),
        (lambda c, t: t["agent"].pop("action_space.low"), "does not describe the spaces"),
        (lambda c, t: c["space_dtypes"].update(action_space="object"), "spaces"),
        (lambda c, t: t["agent"].update({"action_space.low": torch.zeros(2)}), "spaces"),
    ],
)
def test_contents_that_do_not_fit_are_named(change, message, saved, tmp_path):
    with pytest.raises(CheckpointError, match=message):
        load(changed(saved, tmp_path / "changed.zip", change))


def test_a_file_of_the_third_schema_goes_on():
    """Written by the package when it still kept the episodes of logged means as plain values."""
    from tests.runs.toy import EPISODE_STEPS

    path = Path(__file__).parent / "files" / "schema3.zip"
    assert read_checkpoint(path).schema == 3
    loaded = MPCAgent.load(path, env="ToyPush-v0")
    assert [info["l"] for info in loaded.ep_info_buffer] == [EPISODE_STEPS] * 2
    assert loaded.num_timesteps == len(loaded.store) == 2 * EPISODE_STEPS + 1
    assert len(loaded.learn(EPISODE_STEPS, reset_num_timesteps=False).ep_info_buffer) == 3


def test_a_file_of_the_second_schema_goes_on():
    """Written within an episode, by the package before it knew of several environments and of learned rewards."""
    from tests.runs import toy

    path = Path(__file__).parent / "files" / "schema2.zip"
    assert read_checkpoint(path).schema == 2
    loaded = MPCAgent.load(path, env=toy.gymnasium.make("ToyPush-v0"))
    (running,) = loaded.collector.running
    assert (running.index, running.has_explored, len(running.record.rewards)) == (2, True, 1)
    assert not loaded.task.modelled.reward and loaded.train_freq is None
    assert loaded.num_timesteps == len(loaded.store) == 2 * toy.EPISODE_STEPS + 1
    loaded.learn(toy.EPISODE_STEPS, reset_num_timesteps=False)
    assert loaded.store.episodes.unique().tolist() == [0, 1, 2, 3]


def test_a_file_of_the_first_schema_goes_on():
    """Written by the package before it kept what a running episode needs."""
    from gym_dgpmpc import DGPMPCAgent
    from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT

    path = Path(__file__).parent / "files" / "schema1.zip"
    assert read_checkpoint(path).schema == 1
    loaded = MPCAgent.load(path, env="ToyPush-v0")
    assert isinstance(loaded, DGPMPCAgent)
    assert loaded.num_timesteps == len(loaded.store) == loaded.num_fitted == 2 * EPISODE_STEPS
    assert loaded.num_inducing == SMALLEST_AGENT["num_inducing"]
    assert loaded.time_budget is None
    assert loaded.action_space.contains(loaded.predict(np.zeros(2), deterministic=True)[0])
    assert len(loaded.learn(EPISODE_STEPS, reset_num_timesteps=False).store) == 3 * EPISODE_STEPS


def test_a_run_of_the_first_schema_goes_on(tmp_path):
    from gym_dgpmpc import DGPMPCAgent
    from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT

    shutil.copy(Path(__file__).parent / "files" / "schema1.zip", tmp_path / "agent.zip")
    learner = DGPMPCAgent("ToyPush-v0", seed=0, **SMALLEST_AGENT)
    learner.learn(3 * EPISODE_STEPS, run_folder=tmp_path, resume=True)
    assert learner.num_timesteps == 3 * EPISODE_STEPS
    assert read_checkpoint(tmp_path / "agent.zip").schema == 4


def test_classes_are_checked(saved, tmp_path):
    from gym_dgpmpc import DGPMPCAgent

    with pytest.raises(CheckpointError, match=r"MPCAgent.load, not DGPMPCAgent.load"):
        DGPMPCAgent.load(saved)

    class Mine(MPCAgent):
        pass

    Mine(KnownPointMass(), LinearModel(), planner()).save(tmp_path / "mine")
    with pytest.raises(CheckpointError, match="class 'Mine'"):
        load(tmp_path / "mine")
    assert isinstance(Mine.load(tmp_path / "mine", KnownPointMass(), dynamics=LinearModel(), planner=planner()), Mine)


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_whole(failing, tmp_path, monkeypatch):
    agent().learn(12).save(tmp_path / "agent")
    before = (tmp_path / "agent.zip").read_bytes()
    longer = agent().learn(15)

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, failing, full)
    with pytest.raises(OSError, match="No space left"):
        longer.save(tmp_path / "agent")
    assert [path.name for path in tmp_path.iterdir()] == ["agent.zip"]
    assert (tmp_path / "agent.zip").read_bytes() == before


def test_permissions_are_those_of_any_new_file(tmp_path):
    agent().save(tmp_path / "agent")
    (tmp_path / "other").write_bytes(b"")
    assert (tmp_path / "agent.zip").stat().st_mode == (tmp_path / "other").stat().st_mode
