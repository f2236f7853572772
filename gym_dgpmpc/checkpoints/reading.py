"""Reading files that strangers may have made: every size is checked against the bytes there are, before it is used.

`checkpoint.py` says what a file holds; here is how its zip, JSON and safetensors parts are opened. The libraries that
do the work check most of this too; what they leave to the caller is how much memory a small file may make them take.
"""

import io
import json
import math
import os
import struct
import zipfile
from collections.abc import Mapping
from typing import IO, Any

import torch
from safetensors.torch import load as load_tensors
from torch import Tensor

MAX_FILE_BYTES = (1 << 31) - 1
"""Larger zips need the format's 64-bit extension, whose tables could claim anything; an agent has some megabytes."""
MAX_JSON_BYTES = 2 << 20
MAX_HEADER_BYTES = 1 << 20
MAX_MEMBERS = 64
MAX_NESTING = 32
MAX_DIGITS = 400
MAX_MEMBER_ENTRY_BYTES = 1024  # of one member's entry in the zip's table

ITEM_BYTES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "U8": 1, "BOOL": 1}
"""The kinds of tensors that agents hold, and the bytes of a number."""

_END = struct.Struct("<4s4H2LH")
_END_SIGNATURE, _LOCATOR_SIGNATURE, _LOCATOR_BYTES = b"PK\x05\x06", b"PK\x06\x07", 20


class UnsafeFileError(ValueError):
    """A part of a file is not what it may be; the message says which and why."""


def open_members(file: IO[bytes] | io.BufferedIOBase) -> dict[str, bytes]:
    """All members of a zip whose members are stored as they are.

    Raises:
        UnsafeFileError: too large, too many or repeated members, compressed ones, or sizes beyond the file's own.
        Exception: whatever `zipfile` raises for damaged bytes.
    """
    size = file.seek(0, os.SEEK_END)
    if size > MAX_FILE_BYTES:
        raise UnsafeFileError(f"it has {size} bytes, more than an agent's file may have ({MAX_FILE_BYTES})")
    _check_table(file, size)
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if len({entry.filename for entry in entries}) != len(entries):
            raise UnsafeFileError("it has repeated members")
        for entry in entries:
            stored = entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size
            if not stored or entry.file_size > size:
                raise UnsafeFileError(f"its member {entry.filename!r} is compressed or larger than the file")
            _check_member_size(entry.filename, entry.file_size)
        if sum(entry.file_size for entry in entries) > size:
            raise UnsafeFileError("its members overlap")
        return {entry.filename: archive.read(entry) for entry in entries}


def check_members(members: Mapping[str, bytes]) -> None:
    """Refuse what could not be read again, before it is written: the limits of a reader are those of a writer.

    Raises:
        UnsafeFileError: a member is larger than it may be, or not what `parse_json` or `parse_tensors` takes.
    """
    size = sum(map(len, members.values())) + MAX_MEMBERS * MAX_MEMBER_ENTRY_BYTES
    if size > MAX_FILE_BYTES:
        raise UnsafeFileError(f"it would have {size} bytes, more than an agent's file may have ({MAX_FILE_BYTES})")
    for name, data in members.items():
        _check_member_size(name, len(data))
        if name.endswith(".json"):
            parse_json(data)
        else:
            _check_tensors(data)


def parse_json(data: bytes) -> dict[str, Any]:
    """A JSON object of standard values: no repeated names, no NaN, bounded depth and numbers.

    Raises:
        UnsafeFileError: it is none.
        ValueError, RecursionError: it is not JSON at all.
    """
    _check_nesting(data)
    value = json.loads(
        data, object_pairs_hook=_without_repetition, parse_constant=_refuse_constant, parse_int=_bounded_int
    )
    if not isinstance(value, dict):
        raise UnsafeFileError(f"it holds a {type(value).__name__}, not an object")
    return value


def parse_tensors(data: bytes) -> dict[str, Tensor]:
    """The tensors of a safetensors member, once its header is known to describe exactly its bytes.

    Raises:
        UnsafeFileError: it does not.
        SafetensorError: the library finds something else.
    """
    _check_tensors(data)
    with torch.device("cpu"):  # the library takes the default device
        return load_tensors(data)


def _check_member_size(name: str, size: int) -> None:
    if name.endswith(".json") and size > MAX_JSON_BYTES:
        raise UnsafeFileError(f"its member {name!r} has {size} bytes, more than it may have ({MAX_JSON_BYTES})")


def _check_tensors(data: bytes) -> None:
    if len(data) < 8:
        raise UnsafeFileError(f"it has {len(data)} bytes, less than a header")
    (header_size,) = struct.unpack("<Q", data[:8])
    if header_size > min(MAX_HEADER_BYTES, len(data) - 8):
        raise UnsafeFileError(
            f"its header claims {header_size} bytes of {len(data) - 8}, and may have {MAX_HEADER_BYTES}"
        )
    header = parse_json(data[8 : 8 + header_size])
    header.pop("__metadata__", None)
    end = 0
    for name, entry in sorted(header.items(), key=lambda item: _offsets(*item)):
        begin, tensor_end = _offsets(name, entry)
        if begin != end or tensor_end - begin != _byte_count(name, entry):
            raise UnsafeFileError(f"the shape, kind and place of its tensor {name!r} do not agree: {entry}")
        end = tensor_end
    if end != len(data) - 8 - header_size:
        raise UnsafeFileError(f"its tensors claim {end} bytes of {len(data) - 8 - header_size}")


def _check_table(file: IO[bytes] | io.BufferedIOBase, size: int) -> None:
    """Refuse a zip whose table of members is not small, before it is read; a file of ours ends with that table."""
    file.seek(max(0, size - _END.size - _LOCATOR_BYTES))
    tail = file.read()
    file.seek(0)
    if len(tail) < _END.size or not tail[-_END.size :].startswith(_END_SIGNATURE):
        raise UnsafeFileError("it is no complete zip file without a comment")
    if tail.startswith(_LOCATOR_SIGNATURE):
        raise UnsafeFileError("it is a zip of the 64-bit kind")
    _, _, _, _, count, table_size, _, _ = _END.unpack(tail[-_END.size :])
    if count > MAX_MEMBERS or table_size > MAX_MEMBERS * MAX_MEMBER_ENTRY_BYTES:
        raise UnsafeFileError(f"it claims {count} members in a table of {table_size} bytes: too many members")


def _check_nesting(data: bytes) -> None:
    """Brackets inside texts are counted too, which can only make the check stricter."""
    depth = 0
    for byte in data.translate(None, delete=bytes(set(range(256)) - set(b"[]{}"))):
        depth += 1 if byte in b"[{" else -1
        if depth > MAX_NESTING:
            raise UnsafeFileError(f"it is nested more than {MAX_NESTING} levels deep")


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        raise UnsafeFileError("it names something twice")
    return value


def _refuse_constant(text: str) -> None:
    raise UnsafeFileError(f"it holds the number {text}, which JSON does not have")


def _bounded_int(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise UnsafeFileError(f"it holds a number of {len(text)} digits")
    return int(text)


def _offsets(name: str, entry: Any) -> tuple[int, int]:
    """Where a tensor's bytes lie, as its entry in the header says."""
    offsets = entry.get("data_offsets") if isinstance(entry, dict) else None
    if not isinstance(offsets, list) or len(offsets) != 2 or not all(_is_count(offset) for offset in offsets):
        raise UnsafeFileError(f"its tensor {name!r} has no place: {entry}")
    return offsets[0], offsets[1]


def _byte_count(name: str, entry: dict[str, Any]) -> int:
    shape, kind = entry.get("shape"), entry.get("dtype")
    if not isinstance(kind, str) or kind not in ITEM_BYTES:
        raise UnsafeFileError(f"its tensor {name!r} is of the kind {kind!r}, not one of {', '.join(ITEM_BYTES)}")
    if not isinstance(shape, list) or len(shape) > 8 or not all(_is_count(length) for length in shape):
        raise UnsafeFileError(f"its tensor {name!r} has no shape: {shape}")
    return math.prod(shape) * ITEM_BYTES[kind]


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62
