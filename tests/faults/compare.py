"""Whether two runs left the same: every number of their checkpoints, results, logs and figures, but for the clock's."""

import csv
import math
import re
from pathlib import Path

import torch
from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
from tensorboard.compat.proto.event_pb2 import Event

from gym_dgpmpc.checkpoints.format import read_checkpoint

CLOCK = re.compile(r"\d+\.record\.(plan_|cpu_)?seconds|ep_info\.t")
"""Names of tensors of a checkpoint that tell the time."""
CLOCK_COLUMNS = {"seconds", "planning_seconds", "cpu_seconds"}
CLOCK_TAGS = ("time/", "train/seconds")


def checkpoint_differences(one, other):
    """Names of what differs between two checkpoint files."""
    one, other = read_checkpoint(one), read_checkpoint(other)
    found = []
    for name in {*one.config, *other.config}:
        if _without_clock(name, one.config.get(name)) != _without_clock(name, other.config.get(name)):
            found.append(f"config: {name}: {one.config.get(name)} != {other.config.get(name)}")
    for part in {*one.tensors, *other.tensors}:
        first, second = one.tensors.get(part, {}), other.tensors.get(part, {})
        names = {name for name in (*first, *second) if not CLOCK.fullmatch(name)}
        found += [f"{part}: {name}" for name in sorted(names) if not _same(first.get(name), second.get(name))]
    return found


def folder_differences(one, other):
    """Names of what differs between the folders of two runs of `dgpmpc train`."""
    one, other = Path(one), Path(other)
    found = checkpoint_differences(one / "agent.zip", other / "agent.zip")
    found += ["episodes.csv"] if _rows(one) != _rows(other) else []
    found += log_differences(one / "tensorboard", other / "tensorboard")
    names = {path.name for folder in (one, other) for path in (*folder.glob("*.png"), *folder.glob("*.gif"))}
    for name in sorted(names):
        if not all((folder / name).exists() for folder in (one, other)):
            found.append(f"{name} is missing in one")
        elif (one / name).read_bytes() != (other / name).read_bytes():
            found.append(name)
    return found


def log_differences(one, other):
    """Tags whose points differ, and tags with a step that does not come after the one before."""
    one, other = points(one), points(other)
    found = [f"log: {tag}" for tag in sorted({*one, *other}) if not _same_points(tag, one.get(tag), other.get(tag))]
    for tag, series in other.items():
        steps = [step for step, _ in series]
        found += [f"log: steps of {tag}: {steps}"] if steps != sorted(set(steps)) else []
    return found


def points(folder):
    """Tag -> list of (step, value), in the order of the files and of what is in them.

    Files of one second are told apart by a number that counts a process's writers: 10 comes after 9.
    """
    found = {}
    files = Path(folder).rglob("events*")
    for path in sorted(
        files, key=lambda path: (str(path.parent), [int(part) for part in re.findall(r"\d+", path.name)])
    ):
        for record in RawEventFileLoader(str(path)).Load():
            event = Event.FromString(record)
            for value in event.summary.value:
                number = value.tensor.float_val[0] if value.tensor.float_val else value.simple_value
                found.setdefault(value.tag, []).append((event.step, number))
    return found


def _same_points(tag, one, other):
    if one is None or other is None or [step for step, _ in one] != [step for step, _ in other]:
        return False
    if tag.startswith(CLOCK_TAGS):
        return True
    return all(a == b or (math.isnan(a) and math.isnan(b)) for (_, a), (_, b) in zip(one, other, strict=True))


def _without_clock(name, value):
    if name == "values":
        waiting = [entry for entry in value["logs"]["waiting"] if not entry[0].startswith(CLOCK_TAGS)]
        return value | {"logs": value["logs"] | {"waiting": waiting}}
    if name == "arguments":
        return {key: argument for key, argument in value.items() if key != "tensorboard_log"}  # the folders' names
    return value


def _same(one, other):
    return one is not None and other is not None and one.dtype == other.dtype and torch.equal(one, other)


def _rows(folder):
    with (folder / "episodes.csv").open(newline="") as file:
        return [{name: row[name] for name in row.keys() - CLOCK_COLUMNS} for row in csv.DictReader(file)]
