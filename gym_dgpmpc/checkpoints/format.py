"""The file an agent is saved in: a zip of JSON and safetensors, with checksums, written atomically, read safely.

    manifest.json          what the file is, its schema, and size and SHA-256 of every other member
    config.json            plain values
    NAME.safetensors       the tensors of one part

Nothing is unpickled, ever, and no size in a file is believed (`reading.py`).
"""

import hashlib
import io
import json
import math
import os
import re
import zipfile
from pathlib import Path
from typing import IO, Any, NamedTuple

from safetensors import SafetensorError
from safetensors.numpy import save as save_arrays
from torch import Tensor

from gym_dgpmpc.checkpoints.files import replace_file
from gym_dgpmpc.checkpoints.reading import UnsafeFileError, check_members, open_members, parse_json, parse_tensors
from gym_dgpmpc.checkpoints.upgrade import upgraded
from gym_dgpmpc.errors import CheckpointError, CheckpointWriteError
from gym_dgpmpc.types import StateDict

FORMAT = "gym_dgpmpc agent"
SCHEMA = 6
"""`upgrade.py` has the older ones. A field that is added needs no new number: its noun reads older files."""

CheckpointPath = str | os.PathLike[str] | IO[bytes] | io.BufferedIOBase


class Checkpoint(NamedTuple):
    """What a file holds, in the layout of the present schema.

    Attributes:
        config: plain values; those of each noun under "values".
        tensors: of each noun, and of "spaces".
        schema: that the file had, if it was read.
    """

    config: dict[str, Any]
    tensors: dict[str, dict[str, Tensor]]
    schema: int = SCHEMA

    def state(self, noun: str) -> StateDict:
        """The state of one noun: its tensors, and its plain values.

        Raises:
            CheckpointError: the file does not hold it.
        """
        tensors, values = self.tensors.get(noun), self.config.get("values")
        own = values.get(noun, {}) if isinstance(values, dict) else None
        if tensors is None or not isinstance(own, dict):
            raise CheckpointError(f"the file does not hold the agent's {noun}")
        twice = sorted(set(tensors) & set(own))
        if twice:
            raise CheckpointError(f"the file holds {twice} of the agent's {noun} twice")
        return {**tensors, **{name: _from_plain(value) for name, value in own.items()}}


def split(state: StateDict) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The plain values of a noun's state, as JSON has them, and its tensors; `Checkpoint.state` is the inverse."""
    tensors = {name: value for name, value in state.items() if isinstance(value, Tensor)}
    return {name: _to_plain(value) for name, value in state.items() if name not in tensors}, tensors


NOT_FINITE = ("nan", "inf", "-inf")


def _to_plain(value: Any) -> Any:
    """A value as JSON has it, which knows no NaN and no infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if isinstance(value, list | tuple):
        return [_to_plain(each) for each in value]
    return {name: _to_plain(each) for name, each in value.items()} if isinstance(value, dict) else value


def _from_plain(value: Any) -> Any:
    """The inverse of `_to_plain`."""
    if isinstance(value, dict):
        if set(value) == {"float"} and value["float"] in NOT_FINITE:
            return float(value["float"])
        return {name: _from_plain(each) for name, each in value.items()}
    return [_from_plain(each) for each in value] if isinstance(value, list) else value


def checkpoint_path(path: str | os.PathLike[str]) -> Path:
    """Where a checkpoint of this name is written: ".zip" is added to what has no suffix."""
    target = Path(path)
    return target.with_name(f"{target.name}.zip") if target.suffix == "" else target


def write_checkpoint(checkpoint: Checkpoint, path: CheckpointPath, previous: Path | None = None) -> None:
    """Write to a file, replacing an old one only when the new one is complete and on disk.

    Args:
        checkpoint: its config is plain values that JSON has.
        path: see `checkpoint_path`; missing folders are made. A binary file object is written to as it is, without
            those guarantees.
        previous: keep the old file under this name.

    Raises:
        CheckpointWriteError: the file cannot be written, or could not be read again; an old one is untouched. It is
            an OSError too.
    """
    try:
        members = _members(checkpoint)
        check_members(members)
    except (TypeError, ValueError, RecursionError) as error:
        raise CheckpointWriteError(f"{_named(path)} is not written, for it could not be read again: {error}") from error
    if not isinstance(path, str | os.PathLike):
        _write_zip(members, path)
        return
    target = checkpoint_path(path)
    try:
        replace_file(target, lambda file: _write_zip(members, file), previous)
    except OSError as error:
        kept = "; the one before it is whole" if target.exists() else ""
        raise CheckpointWriteError(error.errno, f"could not write {target}: {error.strerror or error}{kept}") from error


def _members(checkpoint: Checkpoint) -> dict[str, bytes]:
    """Everything that the file holds, by name.

    Raises:
        TypeError, ValueError: a value of the config is not one that JSON has.
    """
    members = {"config.json": _to_json(checkpoint.config)}
    for name, tensors in checkpoint.tensors.items():
        # As arrays: for tensors safetensors makes a ctypes type of each size, which Python keeps for ever.
        arrays = {key: tensor.detach().cpu().contiguous().numpy() for key, tensor in tensors.items()}
        members[f"{name}.safetensors"] = save_arrays(arrays)
    table = {name: {"bytes": len(data), "sha256": _sha256(data)} for name, data in members.items()}
    members["manifest.json"] = _to_json({"format": FORMAT, "schema": SCHEMA, "members": table})
    return members


def read_checkpoint(path: CheckpointPath) -> Checkpoint:
    """Read and verify a file; "PATH.zip" is tried where PATH does not exist.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: it is not a checkpoint, is damaged, or was written by a newer version of this package.
    """
    if not isinstance(path, str | os.PathLike):
        return _read(path, _named(path))
    source = Path(path)
    if not source.exists() and source.with_name(f"{source.name}.zip").exists():
        source = source.with_name(f"{source.name}.zip")
    if not source.exists():
        raise FileNotFoundError(f"there is no file {source}: give the path that `save` was given, or a run's agent.zip")
    if source.is_dir():
        raise CheckpointError(f"{source} is a folder, not a checkpoint file")
    if not source.is_file():
        raise CheckpointError(f"{source} is not a regular file")
    with open(source, "rb") as file:
        return _read(file, str(source))


def _named(path: CheckpointPath) -> str:
    """What an error calls the file."""
    if isinstance(path, str | os.PathLike):
        return str(checkpoint_path(path))
    return str(getattr(path, "name", "the given file object"))


def _read(file: IO[bytes] | io.BufferedIOBase, where: str) -> Checkpoint:
    try:
        members = open_members(file)
    # What zipfile raises for damaged or hostile bytes is not limited to its own errors.
    except Exception as error:
        raise CheckpointError(f"{where} is not a checkpoint of this package, or is damaged: {error}") from error
    if "manifest.json" not in members:
        raise CheckpointError(f"{where} is not a checkpoint of this package: it has no manifest.json")
    manifest = _json(members.pop("manifest.json"), "manifest.json", where)
    if manifest.get("format") != FORMAT:
        raise CheckpointError(f"{where} is not a checkpoint of this package: its format is {manifest.get('format')!r}")
    schema = manifest.get("schema")
    if not isinstance(schema, int) or isinstance(schema, bool) or not 1 <= schema <= SCHEMA:
        raise CheckpointError(
            f"{where} has schema {schema!r}; this version of gym_dgpmpc reads up to {SCHEMA}. "
            "Load it with the version that wrote it, or a newer one"
        )
    table = manifest.get("members")
    if not isinstance(table, dict) or set(table) != set(members) or "config.json" not in table:
        raise CheckpointError(f"{where} is damaged: its members are not those of its manifest")
    for name, data in members.items():
        if table[name] != {"bytes": len(data), "sha256": _sha256(data)}:
            raise CheckpointError(f"{where} is damaged: the checksum of {name!r} does not match")
    config = _json(members.pop("config.json"), "config.json", where)
    tensors = {_part(name, where): _tensors(data, name, where) for name, data in members.items()}
    try:
        return Checkpoint(*upgraded(config, tensors, schema), schema)
    except Exception as error:  # whatever a file that was made by hand lacks
        raise CheckpointError(f"{where} is damaged: it is not laid out as schema {schema} is: {error!r}") from error


def _part(name: str, where: str) -> str:
    if not re.fullmatch(r"[a-z_]+\.safetensors", name):
        raise CheckpointError(f"{where} holds an unknown member {name!r}")
    return name.removesuffix(".safetensors")


def _tensors(data: bytes, name: str, where: str) -> dict[str, Tensor]:
    try:
        return parse_tensors(data)
    except (SafetensorError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{where}: the tensors of {name!r} cannot be read: {error}") from error


def _json(data: bytes, name: str, where: str) -> dict[str, Any]:
    try:
        return parse_json(data)
    except UnsafeFileError as error:
        raise CheckpointError(f"{where} is damaged: {name}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{where} is damaged: {name} cannot be read: {error}") from error


def _write_zip(members: dict[str, bytes], file: IO[bytes] | io.BufferedIOBase) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            # A fixed date: the same agent gives the same bytes.
            archive.writestr(zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0)), data)


def _to_json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, indent=1, allow_nan=False).encode()


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
