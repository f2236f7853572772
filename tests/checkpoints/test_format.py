"""The file: whole or an error, whatever its bytes; nothing in it is believed, and nothing is run."""

import io
import json
import math
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from gym_dgpmpc.checkpoints import reading
from gym_dgpmpc.checkpoints.format import SCHEMA, read_checkpoint, split, write_checkpoint
from gym_dgpmpc.errors import CheckpointError, CheckpointWriteError
from tests.agents.point_mass import agent
from tests.checkpoints.common import OBSERVATIONS, changed, load, members_of, zipped


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
    for checkpoint in (one, other):
        for clock in ("seconds", "cpu_seconds"):
            checkpoint.tensors["episodes"].pop(f"0.record.{clock}")
    assert one.config == other.config
    assert all(torch.equal(one.tensors[p][n], other.tensors[p][n]) for p in one.tensors for n in one.tensors[p])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, t: c.update(versions="x" * reading.MAX_JSON_BYTES), r"'config.json' has \d+ bytes, more than"),
        (lambda c, t: c.update(versions={"a": np.int64(3)}), "int64 is not JSON serializable"),
        (lambda c, t: c.update(versions={"a": np.nan}), "not JSON compliant"),
        (lambda c, t: c.update(versions=10**500), "a number of 501 digits"),
        (lambda c, t: t["progress"].update({"x" * reading.MAX_HEADER_BYTES: torch.zeros(1)}), "its header claims"),
        (lambda c, t: t["spaces"].update(bound=torch.zeros(1, dtype=torch.complex64)), "of the kind 'C64'"),
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


def test_a_missing_file_is_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing.* agent\.zip"):
        load(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match="is a folder"):
        load(tmp_path)


def test_no_pickle_is_inside(saved):
    tensors = ["dynamics", "episodes", "logs", "progress", "random", "spaces", "task", "transitions"]
    assert sorted(members_of(saved)) == sorted(["config.json", "manifest.json", *(f"{n}.safetensors" for n in tensors)])


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
    with pytest.raises(CheckpointError, match=rf"schema 99.*reads up to {SCHEMA}"):
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


def test_numbers_that_json_does_not_have_come_back(saved, tmp_path):
    values = {"a": [math.inf, {"b": -math.inf}], "c": math.nan, "d": {"float": 3}, "e": {"float": "x"}}

    def add(config, tensors):
        config["values"]["logs"], tensors["logs"] = split(values | {"t": torch.ones(2)})

    state = read_checkpoint(changed(saved, tmp_path / "file.zip", add)).state("logs")
    assert torch.equal(state.pop("t"), torch.ones(2))
    assert math.isnan(state.pop("c"))
    assert state == {name: value for name, value in values.items() if name != "c"}


@pytest.mark.parametrize(
    "change",
    [
        lambda c, t: t.pop("logs"),
        lambda c, t: c["values"].update(logs=[1]),
        lambda c, t: c.update(values=3),
        lambda c, t: c.pop("values"),
        lambda c, t: c["values"]["logs"].update(ep_successes=[]),  # which the tensors have too
    ],
)
def test_a_noun_that_is_not_held_is_named(change, saved, tmp_path):
    with pytest.raises(CheckpointError, match="logs"):
        read_checkpoint(changed(saved, tmp_path / "file.zip", change)).state("logs")
