"""The file an agent is saved in: a zip of JSON and safetensors, with checksums, written atomically, read safely.

    manifest.json          what the file is, its schema, and size and SHA-256 of every other member
    config.json            plain values
    NAME.safetensors       the tensors of one part

Nothing is unpickled, ever. Members are stored uncompressed, so no file can claim more memory than its own size.
"""

import hashlib
import io
import json
import os
import secrets
import zipfile
from pathlib import Path
from typing import IO, Any, NamedTuple

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from gym_dgpmpc.errors import CheckpointError

FORMAT = "gym_dgpmpc agent"
SCHEMA = 1
MAX_FILE_BYTES = 4 << 30
MAX_JSON_BYTES = 16 << 20
MAX_MEMBERS = 64

CheckpointPath = str | os.PathLike[str] | IO[bytes] | io.BufferedIOBase


class Checkpoint(NamedTuple):
    """What a file holds: plain values, and the tensors of each part by name."""

    config: dict[str, Any]
    tensors: dict[str, dict[str, Tensor]]


def write_checkpoint(checkpoint: Checkpoint, path: CheckpointPath) -> None:
    """Write to a file, replacing an old one only when the new one is complete and on disk.

    Args:
        checkpoint: its config must be JSON-serialisable.
        path: ".zip" is added to a path without a suffix, and missing folders are made. A binary file object is
            written to as it is, without those guarantees.

    Raises:
        OSError: the file cannot be written; an old one is untouched.
    """
    members = {"config.json": _to_json(checkpoint.config)}
    for name, tensors in checkpoint.tensors.items():
        # safetensors wants every tensor contiguous and in memory of its own.
        own = {key: tensor.detach().cpu().clone().contiguous() for key, tensor in tensors.items()}
        members[f"{name}.safetensors"] = save_tensors(own)
    table = {name: {"bytes": len(data), "sha256": _sha256(data)} for name, data in members.items()}
    members["manifest.json"] = _to_json({"format": FORMAT, "schema": SCHEMA, "members": table})
    if not isinstance(path, str | os.PathLike):
        _write_zip(members, path)
        return
    target = Path(path)
    if target.suffix == "":
        target = target.with_name(f"{target.name}.zip")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "xb") as file:
            _write_zip(members, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(target.parent)


def read_checkpoint(path: CheckpointPath) -> Checkpoint:
    """Read and verify a file; "PATH.zip" is tried where PATH does not exist.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: it is not a checkpoint, is damaged, or was written by a newer version of this package.
    """
    if not isinstance(path, str | os.PathLike):
        return _read(path, getattr(path, "name", "the given file object"))
    source = Path(path)
    if not source.exists() and source.with_name(f"{source.name}.zip").exists():
        source = source.with_name(f"{source.name}.zip")
    if source.is_dir():
        raise CheckpointError(f"{source} is a folder, not a checkpoint file")
    with open(source, "rb") as file:
        return _read(file, str(source))


def _read(file: IO[bytes] | io.BufferedIOBase, where: str) -> Checkpoint:
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if size > MAX_FILE_BYTES:
        raise CheckpointError(f"{where} has {size} bytes, more than a checkpoint may have ({MAX_FILE_BYTES})")
    try:
        with zipfile.ZipFile(file) as archive:
            return _read_archive(archive, size, where)
    except CheckpointError:
        raise
    # What zipfile and json raise for damaged or hostile bytes is not limited to their own errors.
    except Exception as error:
        raise CheckpointError(f"{where} is not a checkpoint of this package, or is damaged: {error}") from error


def _read_archive(archive: zipfile.ZipFile, size: int, where: str) -> Checkpoint:
    entries = {entry.filename: entry for entry in archive.infolist()}
    if "manifest.json" not in entries:
        raise CheckpointError(f"{where} is not a checkpoint of this package: it has no manifest.json")
    if len(entries) != len(archive.infolist()) or len(entries) > MAX_MEMBERS:
        raise CheckpointError(f"{where} is damaged: it has repeated or too many members")
    for name, entry in entries.items():
        limit = MAX_JSON_BYTES if name.endswith(".json") else size
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > limit:
            raise CheckpointError(f"{where}: the member {name!r} is compressed or larger than it may be")

    manifest = _from_json(archive.read("manifest.json"), "manifest.json", where)
    if manifest.get("format") != FORMAT:
        raise CheckpointError(f"{where} is not a checkpoint of this package: its format is {manifest.get('format')!r}")
    if not isinstance(manifest.get("schema"), int) or manifest["schema"] > SCHEMA:
        raise CheckpointError(
            f"{where} has schema {manifest.get('schema')!r}; this version of gym_dgpmpc reads up to {SCHEMA}. "
            "Load it with the version that wrote it, or a newer one"
        )
    table = manifest.get("members")
    if not isinstance(table, dict) or set(table) != set(entries) - {"manifest.json"} or "config.json" not in table:
        raise CheckpointError(f"{where} is damaged: its members are not those of its manifest")

    members = {name: archive.read(name) for name in table}
    for name, data in members.items():
        if table[name] != {"bytes": len(data), "sha256": _sha256(data)}:
            raise CheckpointError(f"{where} is damaged: the checksum of {name!r} does not match")
    config = _from_json(members.pop("config.json"), "config.json", where)
    tensors = {}
    for name, data in members.items():
        if not name.endswith(".safetensors"):
            raise CheckpointError(f"{where} holds an unknown member {name!r}")
        try:
            tensors[name.removesuffix(".safetensors")] = load_tensors(data)
        except SafetensorError as error:
            raise CheckpointError(f"{where}: the tensors of {name!r} cannot be read: {error}") from error
    return Checkpoint(config, tensors)


def _write_zip(members: dict[str, bytes], file: IO[bytes] | io.BufferedIOBase) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            # A fixed date: the same agent gives the same bytes.
            archive.writestr(zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0)), data)


def _to_json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, indent=1).encode()


def _from_json(data: bytes, name: str, where: str) -> dict[str, Any]:
    value = json.loads(data)
    if not isinstance(value, dict):
        raise CheckpointError(f"{where}: {name} holds a {type(value).__name__}, not an object")
    return value


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _sync_folder(folder: Path) -> None:
    """Make the renaming itself durable, where the system lets a folder be opened."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass
    finally:
        os.close(descriptor)
