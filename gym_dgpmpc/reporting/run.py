"""A training run and its folder: results as they come, a saved agent after every episode, figures at the end.

The folder holds `settings.json` (what was asked, with which versions), `episodes.csv` (raw results), `agent.zip`,
`tensorboard/`, and after the run `learning_curve.png`, `prediction_fan.png` and `last_episode.gif`.
"""

import csv
import importlib.metadata
import json
import os
import platform
import shutil
import time
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import torch
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from gym_dgpmpc.agents import DGPMPCAgent
from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.reporting.figures import observation_labels, plot_learning_curve, plot_prediction_fan
from gym_dgpmpc.reporting.recording import EpisodeRecorder, ForecastCallback
from gym_dgpmpc.reporting.rendering import write_gif

PACKAGES = ("gym-dgpmpc", "gymnasium", "mujoco", "numpy", "stable-baselines3", "torch")
AGENT_FILE, SETTINGS_FILE, EPISODES_FILE, LOGS = "agent.zip", "settings.json", "episodes.csv", "tensorboard"
FIGURES = LEARNING_CURVE, PREDICTION_FAN, LAST_EPISODE = "learning_curve.png", "prediction_fan.png", "last_episode.gif"


class RunFolderError(DGPMPCError, ValueError):
    """A folder holds something else than the run that is asked for."""


class EpisodeRow(NamedTuple):
    """One line of `episodes.csv`."""

    episode: int
    """Counts from 1, the random ones included."""
    actions: str
    """"random" or "planned"."""
    episode_return: float
    steps: int
    total_steps: int
    """Environment steps of the run up to the episode's end."""
    seconds: float
    """Wall-clock time since the last episode's end, training included."""

    @classmethod
    def from_text(cls, row: dict[str, str]) -> "EpisodeRow":
        return cls(
            int(row["episode"]),
            row["actions"],
            float(row["episode_return"]),
            int(row["steps"]),
            int(row["total_steps"]),
            float(row["seconds"]),
        )


class RunFolder:
    """The files of one run.

    Args:
        path: the folder; made if there is none.
        settings: what identifies the run: going on with another run's folder is refused.
        overwrite: begin anew even if the folder holds a run.

    Raises:
        RunFolderError: the folder holds a run with other settings.
        OSError: it cannot be written.
    """

    def __init__(self, path: Path, settings: dict[str, Any], *, overwrite: bool = False):
        self.path, self.settings = path, json.loads(json.dumps(settings))
        self.agent_file, self.episodes_file = path / AGENT_FILE, path / EPISODES_FILE
        if overwrite:
            for name in (AGENT_FILE, SETTINGS_FILE, EPISODES_FILE, *FIGURES):
                (path / name).unlink(missing_ok=True)
            shutil.rmtree(path / LOGS, ignore_errors=True)
        self.goes_on = self.agent_file.exists()
        if self.goes_on:
            self._refuse_other_settings()
        path.mkdir(parents=True, exist_ok=True)

    def write_settings(self, **facts: Any) -> None:
        """Write settings, versions and machine; ``facts`` are told but do not identify the run."""
        content = {
            "settings": self.settings,
            **facts,
            "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "versions": {"python": platform.python_version()}
            | {name: importlib.metadata.version(name) for name in PACKAGES},
            "machine": {
                "system": platform.system(),
                "processor": platform.machine(),
                "cores": os.cpu_count(),
                "threads": torch.get_num_threads(),
            },
        }
        (self.path / SETTINGS_FILE).write_text(json.dumps(content, indent=2) + "\n")

    def rows(self) -> list[EpisodeRow]:
        """All episodes so far."""
        if not self.episodes_file.exists():
            return []
        with self.episodes_file.open(newline="") as file:
            return [EpisodeRow.from_text(row) for row in csv.DictReader(file)]

    def write_rows(self, rows: list[EpisodeRow]) -> None:
        """Replace all rows, the column names included."""
        with self.episodes_file.open("w", newline="") as file:
            csv.writer(file).writerows([EpisodeRow._fields, *rows])

    def append_row(self, row: EpisodeRow) -> None:
        with self.episodes_file.open("a", newline="") as file:
            csv.writer(file).writerow(row)

    def _refuse_other_settings(self) -> None:
        try:
            before = json.loads((self.path / SETTINGS_FILE).read_text())["settings"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunFolderError(f"{self.path} holds an agent without readable {SETTINGS_FILE}: {error}") from error
        differing = [
            f"{name} was {before.get(name)}, now {self.settings.get(name)}"
            for name in sorted({*before, *self.settings})
            if before.get(name) != self.settings.get(name)
        ]
        if differing:
            raise RunFolderError(
                f"{self.path} holds a run with other settings ({'; '.join(differing)}): "
                "choose another folder with --out, or --overwrite to begin anew"
            )


class TrainingRun:
    """One agent in one environment, recorded in a folder; goes on where the folder's last finished episode ended.

    Args:
        folder: where to record.
        env: the environment; if it renders `rgb_array` the last episode becomes a GIF.
        agent_arguments: of `DGPMPCAgent`.
        num_episodes: planned episodes after which to stop, or None.
        total_timesteps: environment steps after which to stop, the random ones included.
    """

    def __init__(
        self,
        folder: RunFolder,
        env: gymnasium.Env,
        agent_arguments: dict[str, Any],
        *,
        num_episodes: int | None,
        total_timesteps: int,
    ):
        self.folder, self.num_episodes, self.total_timesteps = folder, num_episodes, total_timesteps
        self.recorder = EpisodeRecorder(env)
        always: dict[str, Any] = {"verbose": 1, "tensorboard_log": str(folder.path / LOGS)}
        self.agent: DGPMPCAgent
        if folder.goes_on:
            self.agent = DGPMPCAgent.load(folder.agent_file, env=self.recorder, **always)
            # An episode whose row was written but whose agent was not saved will be played again.
            rows = [row for row in folder.rows() if row.total_steps <= self.agent.num_timesteps]
        else:
            self.agent, rows = DGPMPCAgent(self.recorder, **agent_arguments, **always), []
        folder.write_rows(rows)
        self.forecasts = ForecastCallback(self.agent, self.recorder)

    @property
    def is_complete(self) -> bool:
        """Whether everything that was asked for has been done before."""
        planned = sum(row.actions == "planned" for row in self.folder.rows())
        enough = self.num_episodes is not None and planned >= self.num_episodes
        return enough or self.agent.num_timesteps >= self.total_timesteps

    def train(self, *, progress_bar: bool) -> None:
        """Learn until the end, and leave a model in the agent that has seen every finished episode.

        Raises:
            DGPMPCError: planning or the environment failed; the agent of the last finished episode stays saved.
        """
        callback = CallbackList([self.forecasts, _KeepEpisodes(self)])
        self.agent.learn(
            self.total_timesteps - self.agent.num_timesteps,
            callback,
            tb_log_name="DGPMPC",
            reset_num_timesteps=False,
            progress_bar=progress_bar,
        )
        # A run that the callback stops ends before its last episode is learned from; without steps `learn` only trains.
        self.agent.learn(0, reset_num_timesteps=False)
        self.agent.save(self.folder.agent_file)

    def write_figures(self, title: str) -> list[Path]:
        """Draw what there is to draw, and say which files were written."""
        rows, written = self.folder.rows(), []
        if rows:
            written.append(self.folder.path / LEARNING_CURVE)
            plot_learning_curve(
                [row.episode_return for row in rows],
                written[-1],
                title=title,
                num_random=sum(row.actions == "random" for row in rows),
                episode_steps=[row.steps for row in rows],
            )
        if self.forecasts.forecasts:
            env = self.recorder.unwrapped
            written.append(self.folder.path / PREDICTION_FAN)
            plot_prediction_fan(
                self.forecasts.forecasts,
                written[-1],
                labels=observation_labels(type(env), self.agent.observation_space.shape[0]),
                title=f"Predicted before it happened: episode {rows[-1].episode}, {title}",
                step_seconds=getattr(env, "dt", None),
            )
        last = self.recorder.last
        if last is not None and last.frames:
            written.append(self.folder.path / LAST_EPISODE)
            write_gif(last.frames, written[-1], last.frames_per_second)
        return written


class _KeepEpisodes(BaseCallback):
    """Writes each finished episode's row and saves the agent; stops after the planned episodes that were asked for."""

    def __init__(self, run: TrainingRun):
        super().__init__()
        self.run = run
        self._since = time.perf_counter()

    def _on_step(self) -> bool:
        if not self.locals["dones"][0]:
            return True
        folder, agent, episode = self.run.folder, self.run.agent, self.run.recorder.last
        assert episode is not None
        rows = folder.rows()
        row = EpisodeRow(
            episode=len(rows) + 1,
            actions="planned" if agent.is_fitted else "random",
            episode_return=float(episode.rewards.sum()),
            steps=len(episode.rewards),
            total_steps=agent.num_timesteps,
            seconds=round(time.perf_counter() - self._since, 3),
        )
        folder.append_row(row)
        agent.save(folder.agent_file)
        self._since = time.perf_counter()
        return sum(row.actions == "planned" for row in [*rows, row]) != self.run.num_episodes
