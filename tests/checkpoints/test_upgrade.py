"""Files of older schemas: they load with the posterior they hold, and go on; those laid out otherwise are refused."""

import json
import shutil
import tracemalloc

import numpy as np
import pytest
import torch

from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.checkpoints.format import SCHEMA, read_checkpoint
from gym_dgpmpc.checkpoints.reading import parse_tensors
from gym_dgpmpc.checkpoints.upgrade import OLD_DEFAULTS, ONE_CHAIN, upgraded
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.gp.deep_gp import posterior_mean
from tests.checkpoints.common import members_of
from tests.checkpoints.predictions import FILES, SCHEMAS, predictions
from tests.faults.files import zipped as signed
from tests.oracles import gaussian_process
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
    with pytest.raises(CheckpointError, match=r"add_noise was False.*num_chains was 1"):
        DGPMPCAgent("ToyPush-v0", seed=0, **SMALLEST_AGENT).learn(30, run_folder=tmp_path, resume=True)
    learner = DGPMPCAgent("ToyPush-v0", seed=0, **(OLD_DEFAULTS | SMALLEST_AGENT | ONE_CHAIN))
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


def test_a_file_of_the_fifth_schema_goes_on(tmp_path):
    """Written within an episode, of a deep Gaussian process of two layers, one chain and an odd number of features."""
    path = FILES / "schema5.zip"
    assert read_checkpoint(path).schema == 5
    loaded = MPCAgent.load(path, env="ToyPush-v0")
    assert (loaded.dynamics.num_chains, loaded.dynamics.num_features, loaded.dynamics.num_samples) == (1, 6, 3)
    rows = len(loaded.store)
    assert rows == 2 * EPISODE_STEPS + 5
    # Latents are drawn when they are needed, for all rows; before that a file keeps that there are none.
    assert loaded.dynamics.state_dict()["latents.0"].shape == (1, 0, 3)
    loaded.save(tmp_path / "unused")
    again = MPCAgent.load(tmp_path / "unused", env="ToyPush-v0")
    assert again.dynamics.state_dict()["latents.0"].shape == (1, 0, 3)
    again.learn(1, reset_num_timesteps=False)
    assert again.dynamics.state_dict()["latents.0"].shape == (1, rows + 1, 3)
    again.learn(EPISODE_STEPS - 1, reset_num_timesteps=False)
    assert again.store.episodes.unique().tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("schema", SCHEMAS)
def test_a_deep_gaussian_process_keeps_being_trained_as_it_was(schema):
    """One chain with optimised hyperparameters, under the defaults that files of that time left out."""
    settings = DGPMPCAgent.load(FILES / f"schema{schema}.zip").dynamics
    assert settings.num_chains == 1
    found = settings.inference
    assert (found.hyperparameters, found.window_size, found.hyperparameters_every) == ("optimised", 100, 1)
    assert (found.learning_rate, found.step_size) == (0.01, 0.03 if schema == 5 else 0.02)


@pytest.mark.parametrize(
    ("older", "present"),
    [
        ({"resample_steps": 10}, {}),
        ({"resample_steps": 10, "resample_samples": 3}, {"resample_samples": 3}),
        ({"resample_steps": 0, "resample_samples": 3}, {"resample_samples": 0}),
        ({"resample_samples": 3}, {"resample_samples": 3}),
        ({}, {}),
    ],
)
def test_an_agent_that_did_not_follow_its_data_within_an_episode_does_not_now(older, present):
    """Steps of SG-HMC did so in files up to schema 5; no steps left the samples as they were."""
    config, tensors = raw(FILES / "schema5.zip")
    arguments = {name: value for name, value in config["arguments"].items() if not name.startswith("resample")}
    found = upgraded(config | {"arguments": arguments | older}, tensors, 5)[0]["arguments"]
    assert {name: value for name, value in found.items() if name.startswith("resample")} == present


@pytest.mark.parametrize("schema", SCHEMAS)
def test_files_of_every_schema_hold_the_posterior_that_they_held(schema, tmp_path):
    """Every number of hyperparameters, chain and pool, bit by bit; and the mean that they stand for, by the oracle.

    Actions cannot be compared with those of the version that wrote the file: the random features of a plan's worlds
    come in pairs now, so that the same seed draws other worlds of the same posterior.
    """
    path = FILES / f"schema{schema}.zip"
    held = raw(path)[1]["dynamics"]
    agent = DGPMPCAgent.load(path, env="ToyPush-v0")
    state = agent.dynamics.state_dict()
    for name, value in held.items():
        axis = 1 if name == "pool" else 0
        assert torch.equal(state[name], value.unsqueeze(axis) if has_chains(name) else value), name
    new = {"oldest", "seen.lowest", "seen.highest"}
    assert set(state) - set(held) == new | ({"latents.0"} if schema == 5 else set())
    assert state["seen.lowest"].isneginf().all() and state["seen.highest"].isposinf().all(), "which bounds nothing"

    x = np.random.default_rng(0).normal(size=(6, 3))
    expected = np.mean([oracle_mean(held, flat.numpy(), x) for flat in held["pool"][:: -(-len(held["pool"]) // 2)]], 0)
    fitted = agent.dynamics._fitted
    found = posterior_mean(fitted.factorised, fitted.pool)(torch.from_numpy(x))
    # float64 rounding times the condition number of K_zz, at most M / jitter.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)

    agent.save(tmp_path / "again")
    assert read_checkpoint(tmp_path / "again").schema == SCHEMA
    assert predictions(tmp_path / "again.zip") == predictions(path)


def has_chains(name):
    """Whether a tensor of a deep Gaussian process has an axis of chains now."""
    return name in ("log_noise", "pool") or name.startswith(("chain.", "layers."))


def oracle_mean(held, flat, x):
    """The composition of the layers' means, from the tensors of a file alone."""
    num_layers = sum(name.endswith(".inducing_inputs") for name in held)
    for index in range(num_layers):
        centres, lengthscale, variance = (
            held[f"layers.{index}.{name}"].numpy() for name in ("inducing_inputs", "log_lengthscale", "log_variance")
        )
        layer = gaussian_process.DenseLayer(centres, np.exp(lengthscale), float(np.exp(variance)))
        outputs = 2 if index == num_layers - 1 else 3
        own, flat = flat[: len(centres) * outputs], flat[len(centres) * outputs :]
        mean, _ = gaussian_process.conditional("matern32", layer, own.reshape(-1, outputs), x)
        x = mean if index == num_layers - 1 else x + mean
    return x


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
