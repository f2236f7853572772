"""The checkpoints of a run in its folder: the two newest, held by one process, and what becomes of a damaged one."""

import json
import os
import socket
import warnings
from datetime import datetime, timezone
from pathlib import Path

from filelock import FileLock, Timeout

from gym_dgpmpc.checkpoints.files import remove_temporaries, replace_text
from gym_dgpmpc.checkpoints.format import Checkpoint, read_checkpoint, write_checkpoint
from gym_dgpmpc.errors import CheckpointError, CheckpointWriteError, ReliabilityWarning, RunInUseError

NEWEST, PREVIOUS = "agent.zip", "agent.previous.zip"
LOCK, HOLDER = ".lock", ".lock-holder.json"


class RunCheckpoints:
    """The checkpoints in one folder, held by this process until `close`.

    The operating system gives the lock of a process that died to the next one that asks.

    Args:
        folder: made if there is none.

    Raises:
        RunInUseError: another process (or another object of this one) holds the folder.
        CheckpointWriteError: the folder cannot be made or written to.
    """

    def __init__(self, folder: str | os.PathLike[str]):
        self.folder = Path(folder)
        self.newest, self.previous = self.folder / NEWEST, self.folder / PREVIOUS
        self._lock = FileLock(self.folder / LOCK, is_singleton=False)
        self._newest_is_damaged = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(blocking=False)
            replace_text(self.folder / HOLDER, json.dumps(_this_process()))
        except Timeout:
            raise RunInUseError(
                f"{self.folder} is in use by {self._holder()}: wait until it has finished, or choose another folder"
            ) from None
        except OSError as error:
            self._lock.release()
            raise CheckpointWriteError(
                error.errno, f"the folder {self.folder} cannot be written to: {error.strerror or error}"
            ) from error
        remove_temporaries(self.folder)

    def __enter__(self) -> "RunCheckpoints":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let another process have the folder."""
        if self._lock.is_locked:
            (self.folder / HOLDER).unlink(missing_ok=True)
            self._lock.release()

    @property
    def exist(self) -> bool:
        """Whether there is anything to go on from."""
        return self.newest.exists() or self.previous.exists()

    def save(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint; the newest becomes the previous one, unless it was found to be damaged.

        Raises:
            CheckpointWriteError: it cannot be written; those there are stay as they are.
        """
        if not self._lock.is_locked:
            raise RuntimeError(f"the folder {self.folder} was closed")
        write_checkpoint(checkpoint, self.newest, None if self._newest_is_damaged else self.previous)
        self._newest_is_damaged = False

    def load(self) -> Checkpoint | None:
        """The newest checkpoint that is whole, or None if there is none at all; warns of a damaged one.

        Raises:
            CheckpointError: all there are are damaged.
        """
        if not self.exist:
            return None
        if not self.newest.exists():
            return read_checkpoint(self.previous)
        try:
            return read_checkpoint(self.newest)
        except CheckpointError as damage:
            if not self.previous.exists():
                raise
            try:
                checkpoint = read_checkpoint(self.previous)
            except CheckpointError as error:
                raise CheckpointError(f"no checkpoint in {self.folder} can be read: {damage}; {error}") from damage
            warnings.warn(f"{damage}; going on from the one before it", ReliabilityWarning, stacklevel=2)
            self._newest_is_damaged = True
            return checkpoint

    def delete(self) -> None:
        """Remove the checkpoints, to begin anew."""
        for path in (self.newest, self.previous):
            path.unlink(missing_ok=True)

    def _holder(self) -> str:
        try:
            holder = json.loads((self.folder / HOLDER).read_text())
            return f"process {holder['process']} on {holder['host']} since {holder['since']}"
        except (OSError, ValueError, KeyError, TypeError):
            return "another process"


def _this_process() -> dict[str, str | int]:
    since = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return {"process": os.getpid(), "host": socket.gethostname(), "since": since}
