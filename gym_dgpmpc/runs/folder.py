"""The folder of a training run: what it was asked to do, its results as they come, and its agent.

It holds `settings.json` (what was asked, with which versions), `episodes.csv` (raw results), `agent.zip` (and
`agent.previous.zip`, the one before), `tensorboard/`, and when the run ends `learning_curve.png`, `prediction_fan.png`
with its numbers in `prediction_fan.npz`, and `last_episode.gif`. `training.py` fills it; `plotting.py`, `inspection.py`
and the benchmarks read the same files.
"""

import csv
import io
import json
import shutil
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from gym_dgpmpc.checkpoints.files import replace_text
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.formats import FORMATS
from gym_dgpmpc.runs.provenance import machine, revision, versions

SETTINGS_FILE, EPISODES_FILE, LOGS = "settings.json", "episodes.csv", "tensorboard"
LEARNING_CURVE, PREDICTION_FAN = "learning_curve", "prediction_fan"
"""Names of figures, whose suffix is their format."""
FORECASTS, LAST_EPISODE = f"{PREDICTION_FAN}.npz", "last_episode.gif"
PICTURES = (
    FORECASTS,
    LAST_EPISODE,
    *(f"{name}.{kind}" for name in (LEARNING_CURVE, PREDICTION_FAN) for kind in FORMATS),
)
"""All that a run draws, in any format, and what is kept to draw it again."""


class RunFolderError(DGPMPCError, ValueError):
    """A folder holds another run than the one that was asked for."""


class EpisodeRow(NamedTuple):
    """One line of `episodes.csv`."""

    episode: int
    """Counts from 1, the random ones included."""
    actions: str
    """"random" if its first actions were, else "planned"."""
    episode_return: float
    steps: int
    total_steps: int
    """Environment steps of the run up to the episode's end."""
    seconds: float
    """Wall-clock time that it took, with the training before it."""
    planning_seconds: float = 0.0
    """The part of that time in which plans were made."""
    success: bool | None = None
    """Whether the goal was reached in the last step, for tasks that say so in ``info["is_success"]``."""
    cpu_seconds: float | None = None
    """Time on the processor in ``seconds``; None in older files."""
    training_iterations: int | None = None
    """Iterations of the training before it; None in older files."""

    @classmethod
    def from_text(cls, row: dict[str, str]) -> "EpisodeRow":
        """A row as `csv.DictReader` reads it; older versions lack the last columns."""
        success, cpu_seconds, iterations = (
            row.get(name) or None for name in ("success", "cpu_seconds", "training_iterations")
        )
        return cls(
            int(row["episode"]),
            row["actions"],
            float(row["episode_return"]),
            int(row["steps"]),
            int(row["total_steps"]),
            float(row["seconds"]),
            float(row.get("planning_seconds", 0.0)),
            None if success is None else success == str(True),
            None if cpu_seconds is None else float(cpu_seconds),
            None if iterations is None else int(iterations),
        )


def read_rows(path: Path) -> list[EpisodeRow]:
    """All episodes in an `episodes.csv`; an empty list if the file does not exist."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [EpisodeRow.from_text(row) for row in csv.DictReader(file)]


def read_settings(path: Path) -> dict[str, Any]:
    """What is in the `settings.json` of a run's folder, "settings" among it.

    Raises:
        RunFolderError: there is none, or it is not one of a run.
    """
    file = path / SETTINGS_FILE
    if not file.is_file():
        raise RunFolderError(f"expected a folder of `dgpmpc train`, but there is no file {file}")
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise RunFolderError(f"{file} cannot be read: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("settings"), dict):
        raise RunFolderError(f"{file} is not one of a run: it has no object of settings")
    return content


class RunFolder:
    """The files of one run, held by this process until `close`.

    Args:
        path: the folder; made if it does not exist.
        settings: what identifies the run. A folder that holds a run with others is refused.
        defaults: the values of settings in runs that are older than these settings.
        overwrite: delete the run that the folder holds, and begin anew.
        otherwise: what the error about another run's folder advises.

    Raises:
        RunFolderError: the folder holds a run with other settings.
        RunInUseError: another process holds it.
        CheckpointWriteError: it cannot be written to. It is an OSError too.
    """

    def __init__(
        self,
        path: Path,
        settings: dict[str, Any],
        *,
        defaults: Mapping[str, Any] = MappingProxyType({}),
        overwrite: bool = False,
        otherwise: str = "choose another folder with --out, or --overwrite to begin anew",
    ):
        self.path, self.settings = path, json.loads(json.dumps(settings))
        self._defaults = json.loads(json.dumps(dict(defaults)))
        self._advice = otherwise
        self.checkpoints = RunCheckpoints(path)
        self.agent_file, self.episodes_file = self.checkpoints.newest, path / EPISODES_FILE
        try:
            if overwrite:
                self.checkpoints.delete()
                for name in (SETTINGS_FILE, EPISODES_FILE, *PICTURES):
                    (path / name).unlink(missing_ok=True)
                shutil.rmtree(path / LOGS, ignore_errors=True)
            self.goes_on = self.checkpoints.exist
            if self.goes_on:
                self._refuse_other_settings()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let another process have the folder."""
        self.checkpoints.close()

    def write_settings(self, **facts: Any) -> None:
        """Write settings, versions and machine; ``facts`` are recorded but do not identify the run.

        A run that goes on keeps the time at which it started.
        """
        now = datetime.now(timezone.utc).isoformat(timespec="seconds")
        content = {
            "settings": self.settings,
            **facts,
            "started": self.read_settings().get("started", now) if self.goes_on else now,
            "revision": revision(),
            "versions": versions(),
            "machine": machine(),
        }
        replace_text(self.path / SETTINGS_FILE, json.dumps(content, indent=2) + "\n")

    def read_settings(self) -> dict[str, Any]:
        """What `write_settings` wrote the last time."""
        return read_settings(self.path)

    def rows(self) -> list[EpisodeRow]:
        """All episodes so far."""
        return read_rows(self.episodes_file)

    def write_rows(self, rows: list[EpisodeRow]) -> None:
        """Replace all rows, the column names included; a kill leaves the old rows or the new ones."""
        text = io.StringIO(newline="")
        csv.writer(text).writerows([EpisodeRow._fields, *rows])
        replace_text(self.episodes_file, text.getvalue())

    def _refuse_other_settings(self) -> None:
        try:
            before = {**self._defaults, **self.read_settings()["settings"]}
        except RunFolderError as error:
            raise RunFolderError(f"{self.path} holds an agent, but {error}: {self._advice}") from error
        differing = [
            f"{name} was {before.get(name)}, now {self.settings.get(name)}"
            for name in sorted({*before, *self.settings})
            if before.get(name) != self.settings.get(name)
        ]
        if differing:
            raise RunFolderError(
                f"{self.path} holds a run with other settings ({'; '.join(differing)}): {self._advice}"
            )
