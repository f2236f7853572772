"""Writing files so that a kill, a full disk or a power cut leaves either the old one or the new one, whole."""

import os
import re
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import IO

TEMPORARY = ".tmp"


def replace_file(target: Path, write: Callable[[IO[bytes]], None], previous: Path | None = None) -> None:
    """Let ``write`` fill a temporary file in the same folder, flush it to disk and rename it to ``target``.

    Args:
        target: missing folders are made.
        write: is given the open file.
        previous: where to keep the old target under another name, replacing what is there.

    Raises:
        OSError: the file cannot be written; the old one is untouched, and no temporary file is left.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}{TEMPORARY}")
    try:
        with open(temporary, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if previous is not None and target.exists():
            _keep(target, previous)
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(target.parent)


def replace_text(target: Path, text: str) -> None:
    """`replace_file` for a text."""

    def write(file: IO[bytes]) -> None:
        file.write(text.encode())

    replace_file(target, write)


def remove_temporaries(folder: Path) -> None:
    """Remove what killed writers left behind in a folder; only for who knows that no other is writing there."""
    for path in folder.glob(f".*{TEMPORARY}"):
        if re.search(rf"\.[0-9a-f]{{8}}{TEMPORARY}$", path.name):
            path.unlink(missing_ok=True)


def _keep(target: Path, previous: Path) -> None:
    """Give the old file its second name without ever leaving none under the first, where links are possible."""
    link = previous.with_name(f".{previous.name}.{secrets.token_hex(4)}{TEMPORARY}")
    try:
        os.link(target, link)
    except OSError:
        os.replace(target, previous)  # a file system without links: for a moment there is only the previous one
        return
    try:
        os.replace(link, previous)  # does nothing where both are one file already
    finally:
        link.unlink(missing_ok=True)


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
