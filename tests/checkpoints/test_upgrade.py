"""Files of older schemas: they load, predict as they did, and go on; those that are laid out otherwise are refused."""

import json
import shutil
import tracemalloc

import numpy as np
import pytest

from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.checkpoints.format import SCHEMA, read_checkpoint
from gym_dgpmpc.checkpoints.reading import parse_tensors
from gym_dgpmpc.checkpoints.upgrade import upgraded
from gym_dgpmpc.errors import CheckpointError
from tests.checkpoints.common import members_of
from tests.checkpoints.predictions import FILES, SCHEMAS, predictions
from tests.faults.files import zipped as signed
from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT


def test_a_file_of_the_third_schema_goes_on():
    """Written by the package when it still kept the episodes of logged means as plain values."""
    path = FILES / "schema3.zip"
    assert read_checkpoint(path).schema == 3
    loaded = MPCAgent.load(path, env="ToyPush-v0")
    assert [info["l"] for info in loaded.ep_info_buffer] == [EPISODE_STEPS] * 2
    assert loaded.num_timesteps == len(loaded.store) == 2 * EPISODE_STEPS + 1
    assert len(loaded.learn(EPISODE_STEPS, reset_num_timesteps=False).ep_info_buffer) == 3


def test_a_file_of_the_second_schema_goes_on():
    """Written within an episode, by the package before it knew of several environments and of learned rewards."""
    path = FILES / "schema2.zip"
    assert read_checkpoint(path).schema == 2
    loaded = MPCAgent.load(path, env="ToyPush-v0")
    (running,) = loaded.collector.running
    assert (running.index, running.has_explored, len(running.record.rewards)) == (2, True, 1)
    assert not loaded.task.modelled.reward and loaded.train_freq is None
    assert loaded.num_timesteps == len(loaded.store) == 2 * EPISODE_STEPS + 1
    loaded.learn(EPISODE_STEPS, reset_num_timesteps=False)
    assert loaded.store.episodes.unique().tolist() == [0, 1, 2, 3]


def test_a_file_of_the_first_schema_goes_on():
    """Written by the package before it kept what a running episode needs."""
    path = FILES / "schema1.zip"
    assert read_checkpoint(path).schema == 1
    loaded = MPCAgent.load(path, env="ToyPush-v0")
    assert isinstance(loaded, DGPMPCAgent)
    assert loaded.num_timesteps == len(loaded.store) == loaded.num_fitted == 2 * EPISODE_STEPS
    assert loaded.num_inducing == SMALLEST_AGENT["num_inducing"]
    assert loaded.time_budget is None
    assert loaded.action_space.contains(loaded.predict(np.zeros(2), deterministic=True)[0])
    assert len(loaded.learn(EPISODE_STEPS, reset_num_timesteps=False).store) == 3 * EPISODE_STEPS


def test_a_run_of_the_first_schema_goes_on(tmp_path):
    shutil.copy(FILES / "schema1.zip", tmp_path / "agent.zip")
    learner = DGPMPCAgent("ToyPush-v0", seed=0, **SMALLEST_AGENT)
    learner.learn(3 * EPISODE_STEPS, run_folder=tmp_path, resume=True)
    assert learner.num_timesteps == 3 * EPISODE_STEPS
    assert read_checkpoint(tmp_path / "agent.zip").schema == SCHEMA


def test_a_file_of_the_fourth_schema_goes_on():
    """Written within an episode, with numbers that the logger had not written, when all nouns were one part."""
    path = FILES / "schema4.zip"
    assert read_checkpoint(path).schema == 4
    loaded = MPCAgent.load(path, env="ToyPush-v0")
    assert loaded.num_timesteps == len(loaded.store) == 2 * EPISODE_STEPS + 5
    (running,) = loaded.collector.running
    assert (running.index, running.record.number, len(running.record.rewards), len(running.record.plans)) == (
        2,
        3,
        5,
        5,
    )
    assert [info["l"] for info in loaded.ep_info_buffer] == [EPISODE_STEPS] * 2
    waiting = {each.name: each.value for each in loaded.logs.waiting()}
    assert waiting["rollout/ep_length"] == EPISODE_STEPS
    assert waiting["train/num_transitions"] == 2 * EPISODE_STEPS
    loaded.learn(EPISODE_STEPS, reset_num_timesteps=False)
    assert loaded.store.episodes.unique().tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("schema", SCHEMAS)
def test_files_of_every_schema_predict_as_they_did(schema, tmp_path):
    """As revision d6a075d predicted; `predictions` says with what command.

    The numbers were bit-equal where they were made. Actions are means of float32 candidates; on another CPU sums may be
    rounded otherwise, by some units of 2**-24 of numbers of the order of 1 in each of some hundred operations. With six
    candidates and one iteration a difference in returns of that size changes the elites in none of these plans.
    """
    path, kept = FILES / f"schema{schema}.zip", json.loads((FILES / "predictions.json").read_text())
    np.testing.assert_allclose(predictions(path), kept[f"schema{schema}"], rtol=0, atol=100 * 2**-24)
    DGPMPCAgent.load(path).save(tmp_path / "again")
    assert read_checkpoint(tmp_path / "again").schema == SCHEMA
    assert predictions(tmp_path / "again.zip") == predictions(path)


def test_an_agent_made_of_parts_never_had_its_planner_in_an_older_file():
    config, tensors = raw(FILES / "schema4.zip")
    del config["arguments"]["num_candidates"]
    config["class"] = "MPCAgent"
    assert upgraded(config, tensors, 4)[0]["arguments"]["planner"] is None


def raw(path):
    """Plain values and tensors as the file has them."""
    members = members_of(path)
    tensors = {
        name.removesuffix(".safetensors"): parse_tensors(data)
        for name, data in members.items()
        if name.endswith(".safetensors")
    }
    return json.loads(members["config.json"]), tensors


@pytest.mark.parametrize(
    "change",
    [
        lambda c, t: t.pop("agent"),
        lambda c, t: t.pop("dynamics"),
        lambda c, t: t["agent"].pop("plan.std"),
        lambda c, t: c.pop("counters"),
        lambda c, t: c["counters"].pop("_episode_num"),
        lambda c, t: c.update(modelled=[]),
        lambda c, t: c.update(running=3),
        lambda c, t: c.update(running=[{"index": 0}]),
        lambda c, t: c.update(running=[{"index": None, "has_explored": True}]),
        lambda c, t: c.update(values=3),
        lambda c, t: c.update(episode_infos=[{str(i): 1} for i in range(20_000)]),
        lambda c, t: c.update(episode_infos=[3]),
        lambda c, t: c.update(episode_successes=[[]]),
    ],
)
def test_older_files_that_are_not_laid_out_so_are_refused(change):
    config, tensors = raw(FILES / "schema3.zip")
    change(config, tensors)
    tracemalloc.start()
    with pytest.raises((LookupError, TypeError, ValueError, AttributeError)):
        upgraded(config, tensors, 3)
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()


@pytest.mark.parametrize(
    "running", [[], [{"index": 10**30, "has_explored": True}], [{"index": 0, "has_explored": True}] * 3]
)
def test_older_files_of_no_possible_episodes_are_refused(running, tmp_path):
    members = members_of(FILES / "schema3.zip")
    config = json.loads(members["config.json"])
    (tmp_path / "file.zip").write_bytes(
        signed({**members, "config.json": json.dumps(config | {"running": running}).encode()}, schema=3)
    )
    with pytest.raises(CheckpointError):
        DGPMPCAgent.load(tmp_path / "file.zip")
