"""TensorBoard's files of a run that goes on: what was logged after the checkpoint is dropped, for it comes again."""

from pathlib import Path

from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.summary.writer.record_writer import RecordWriter

from gym_dgpmpc.checkpoints.files import remove_temporaries, replace_file


def drop_events_after(step: int, run: Path) -> None:
    """Remove the points beyond ``step`` from a folder of logs; a last one that a kill cut in two goes with them."""
    remove_temporaries(run)
    for path in sorted(run.glob("events.out.tfevents.*")):
        if path.stat().st_size == 0:  # killed before its first record; the reader takes an empty file for an error
            path.unlink()
            continue
        records = list(RawEventFileLoader(str(path)).Load())
        kept = [record for record in records if Event.FromString(record).step <= step]
        # Written anew only where something goes: 16 bytes of length and checksums belong to each record.
        if sum(16 + len(record) for record in kept) != path.stat().st_size:
            replace_file(path, lambda file, kept=kept: _write(file, kept))  # type: ignore[misc]


def _write(file: object, records: list[bytes]) -> None:
    writer = RecordWriter(file)
    for record in records:
        writer.write(record)
