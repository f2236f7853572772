"""Checkpoints whose writing is cut short: by a kill at every kind of offset, a full disk, a read-only folder."""

import errno
import io
import os
import shutil
import subprocess
import warnings
import zipfile
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from gym_dgpmpc.checkpoints.collect import collect
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.checkpoints.format import read_checkpoint, write_checkpoint
from gym_dgpmpc.errors import CheckpointWriteError, RunInUseError
from tests.agents.point_mass import agent
from tests.faults.compare import checkpoint_differences


def two_agents(folder):
    """A folder with two checkpoints, and a third that is to be written there."""
    with RunCheckpoints(folder) as held:
        learner = agent()
        for steps in (10, 15):
            learner.learn(steps - learner.num_timesteps, reset_num_timesteps=False)
            held.save(collect(learner))
        learner.learn(3, reset_num_timesteps=False)
        return collect(learner)


def offsets_by_kind(data, per_kind):
    """Offsets into a checkpoint file, ``per_kind`` or fewer in each of its kinds of content."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries, table = archive.infolist(), archive.start_dir
    kinds = {"zip header": [], "checksums": [], "plain values": [], "tensor header": [], "tensor": []}
    for entry, end in zip(entries, [*(e.header_offset for e in entries[1:]), table], strict=True):
        begin = end - entry.file_size
        kinds["zip header"] += range(entry.header_offset, begin)
        if entry.filename == "manifest.json":
            kinds["checksums"] += range(begin, end)
        elif entry.filename.endswith(".json"):
            kinds["plain values"] += range(begin, end)
        else:
            header = begin + 8 + int.from_bytes(data[begin : begin + 8], "little")
            kinds["tensor header"] += range(begin, header)
            kinds["tensor"] += range(header, end)
    kinds["zip table"] = range(table, len(data))
    return {kind: spread(list(offsets), per_kind) for kind, offsets in kinds.items()}


def spread(items, count):
    """At most ``count`` of the items, evenly, with the first and the last."""
    if len(items) <= count:
        return items
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]


class Killed(BaseException):
    """Instead of a kill: nothing of ours may handle it."""


@contextmanager
def cut_at(offset, error):
    """Every write to a temporary file raises once ``offset`` bytes have been written, and those are on disk."""
    opened = open

    class Cut(io.FileIO):
        def write(self, data):
            room = offset - self.tell()
            if len(data) > room:
                super().write(bytes(data)[: max(room, 0)])
                raise error
            return super().write(data)

    def open_cut(path, mode="r", *arguments, **keywords):
        return Cut(path, mode) if str(path).endswith(".tmp") else opened(path, mode, *arguments, **keywords)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("builtins.open", open_cut)
        if isinstance(error, Killed):  # a dead process cleans nothing up
            patch.setattr(Path, "unlink", lambda *_, **__: None)
        yield


def run_cuts(folder, per_kind):
    """Cut the writing of a third checkpoint at many offsets, by a kill and by an error; then read such files too.

    Returns:
        (counts by kind, what was lost).
    """
    folder = Path(folder) / "cuts"
    checkpoint = two_agents(folder)
    buffer = io.BytesIO()
    write_checkpoint(checkpoint, buffer)
    data = buffer.getvalue()
    before = {name: (folder / name).read_bytes() for name in ("agent.zip", "agent.previous.zip")}
    counts, lost = {}, []
    for kind, offsets in offsets_by_kind(data, per_kind).items():
        for offset in offsets:
            for error in (Killed(), OSError(errno.ENOSPC, "No space left on device")):
                counts[kind] = counts.get(kind, 0) + 1
                with RunCheckpoints(folder) as held, suppress(Killed, CheckpointWriteError):
                    with cut_at(offset, error):
                        held.save(checkpoint)
                    lost.append(f"{kind} at {offset}: the cut was not noticed")
                changed = [name for name, old in before.items() if (folder / name).read_bytes() != old]
                lost += [f"{kind} at {offset}: {name} changed" for name in changed]
            # The same bytes under the final name, as a file system that renames before it writes may leave them.
            shutil.copytree(folder, folder.with_name("torn"), dirs_exist_ok=True)
            (folder.with_name("torn") / "agent.zip").write_bytes(data[:offset])
            counts[kind] += 1
            lost += [f"{kind} at {offset}: {text}" for text in previous_is_used(folder.with_name("torn"))]
    with RunCheckpoints(folder) as held:
        held.save(checkpoint)
    write_checkpoint(checkpoint, folder / "expected.zip")
    lost += checkpoint_differences(folder / "agent.zip", folder / "expected.zip")
    return counts, lost


def previous_is_used(folder):
    """Nothing, or how reading a folder with a damaged newest checkpoint went wrong."""
    with RunCheckpoints(folder) as held, warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        steps = held.load().config["values"]["progress"]["num_timesteps"]
    return [] if steps == 10 and len(warned) == 1 else [f"{steps} steps, {len(warned)} warnings"]


def run_full_disk(folder, num_sizes):
    """Save to a small tmpfs that is filled to leave less and less room; a file-size limit where mounting is forbidden.

    Returns:
        (how it was done, number of writes, what was lost).
    """
    folder = Path(folder) / "disk"
    folder.mkdir(parents=True)
    source = folder.parent / "full-source"
    checkpoint = two_agents(source)
    size = (source / "agent.zip").stat().st_size
    mount = ["mount", "-t", "tmpfs", "-o", f"size={4 * size + (1 << 18)}", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True).returncode:
        return *_limited_files(source, checkpoint, size, num_sizes), []
    try:
        lost, refused = [], 0
        for step in range(num_sizes):
            for name in ("agent.zip", "agent.previous.zip"):
                shutil.copy(source / name, folder / name)
            room = os.statvfs(folder)
            free = room.f_bavail * room.f_frsize
            (folder / "ballast").write_bytes(bytes(max(0, free - size * step // num_sizes)))
            before = (folder / "agent.zip").read_bytes()
            try:
                with RunCheckpoints(folder) as held:
                    held.save(checkpoint)
            except CheckpointWriteError:
                refused += 1
                lost += [] if (folder / "agent.zip").read_bytes() == before else [f"{step}: the old one changed"]
                lost += [str(path) for path in folder.glob(".agent*.tmp")]
            steps = read_checkpoint(folder / "agent.zip").config["values"]["progress"]["num_timesteps"]
            lost += [] if steps in (15, 18) else [f"{step}: {steps} steps"]
            (folder / "ballast").unlink()
        lost += [] if refused else ["the disk was never full"]
        return "a tmpfs of a few checkpoints' size", num_sizes, lost
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def _limited_files(source, checkpoint, size, num_sizes):
    """In forked children, whose files may only have a part of the size."""
    import resource

    for step in range(num_sizes):
        child = os.fork()
        if not child:
            with suppress(BaseException):
                import signal

                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                limit = max(4096, size * step // num_sizes)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
                with RunCheckpoints(source) as held:
                    held.save(checkpoint)
            os._exit(0)
        os.waitpid(child, 0)
        assert read_checkpoint(source / "agent.zip").config["values"]["progress"]["num_timesteps"] in (15, 18)
    return "a limit on the size of files", num_sizes


def run_read_only(folder):
    """Folders that cannot be written to, as an ordinary user meets them.

    Returns:
        (number of attempts, what was lost).
    """
    folder = Path(folder) / "read_only"
    checkpoint = two_agents(folder)
    before = (folder / "agent.zip").read_bytes()
    lost, attempts = [], 0

    def refused(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    for owner, name in ((os, "replace"), (os, "fsync"), ("builtins", "open")):
        attempts += 1
        with RunCheckpoints(folder) as held, pytest.MonkeyPatch.context() as patch:
            if owner == "builtins":
                patch.setattr("builtins.open", refused)
            else:
                patch.setattr(owner, name, refused)
            try:
                held.save(checkpoint)
                lost.append(f"{name}: not noticed")
            except CheckpointWriteError:
                pass
        lost += [] if (folder / "agent.zip").read_bytes() == before else [f"{name}: the old one changed"]
    folder.chmod(0o500)
    try:
        attempts += 1
        _as_nobody(folder)
    except AssertionError as error:
        lost.append(str(error))
    finally:
        folder.chmod(0o700)
    read_checkpoint(folder / "agent.zip")
    return attempts, lost


def _as_nobody(folder):
    """Root may write anywhere, so a child becomes someone else; elsewhere the mode of the folder suffices."""
    child = os.fork()
    if not child:
        status = 1
        try:
            if os.getuid() == 0:
                for path in folder.parents:
                    with suppress(OSError):
                        path.chmod(path.stat().st_mode | 0o055)
                folder.chmod(0o555)
                os.setgid(65534)
                os.setuid(65534)
            RunCheckpoints(folder)
        except (CheckpointWriteError, RunInUseError):
            status = 0
        finally:
            os._exit(status)
    _, status = os.waitpid(child, 0)
    assert status == 0, "a read-only folder was not refused"
