"""A training run and its folder: results as they come, a saved agent after every episode, figures at the end.

The folder holds `settings.json` (what was asked, with which versions), `episodes.csv` (raw results), `agent.zip` (and
`agent.previous.zip`, the one before), `tensorboard/`, and when the run ends `learning_curve.png`, `prediction_fan.png`
and `last_episode.gif`. A run that was killed goes on to the same files; only what tells the time differs.
"""

import csv
import io
import json
import shutil
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.checkpoints.files import replace_text
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.checkpoints.safeguard import resume_from
from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.runs.figures import observation_labels, plot_learning_curve, plot_prediction_fan
from gym_dgpmpc.runs.provenance import machine, revision, versions
from gym_dgpmpc.runs.recording import EpisodeRecorder, ForecastCallback
from gym_dgpmpc.runs.rendering import write_gif

SETTINGS_FILE, EPISODES_FILE, LOGS, LOG_NAME = "settings.json", "episodes.csv", "tensorboard", "DGPMPC"
FIGURES = LEARNING_CURVE, PREDICTION_FAN, LAST_EPISODE = "learning_curve.png", "prediction_fan.png", "last_episode.gif"


class RunFolderError(DGPMPCError, ValueError):
    """A folder holds something else than the run that is asked for."""


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
    """The part of it in which plans were made."""
    success: bool | None = None
    """Whether the goal was reached in the last step, of tasks that say so in ``info["is_success"]``."""

    @classmethod
    def from_text(cls, row: dict[str, str]) -> "EpisodeRow":
        """A row as `csv.DictReader` reads it; one of an older version lacks the last columns."""
        success = row.get("success") or None
        return cls(
            int(row["episode"]),
            row["actions"],
            float(row["episode_return"]),
            int(row["steps"]),
            int(row["total_steps"]),
            float(row["seconds"]),
            float(row.get("planning_seconds", 0.0)),
            None if success is None else success == str(True),
        )


def read_rows(path: Path) -> list[EpisodeRow]:
    """All episodes in an `episodes.csv`; none if there is no such file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [EpisodeRow.from_text(row) for row in csv.DictReader(file)]


class RunFolder:
    """The files of one run, held by this process until `close`.

    Args:
        path: the folder; made if there is none.
        settings: what identifies the run: going on with another run's folder is refused.
        defaults: what a setting was in a run that began before there was such a setting.
        overwrite: begin anew even if the folder holds a run.
        otherwise: what the error over another run's folder advises.

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
        self._otherwise = otherwise
        self.checkpoints = RunCheckpoints(path)
        self.agent_file, self.episodes_file = self.checkpoints.newest, path / EPISODES_FILE
        try:
            if overwrite:
                self.checkpoints.delete()
                for name in (SETTINGS_FILE, EPISODES_FILE, *FIGURES):
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
        """Write settings, versions and machine; ``facts`` are told but do not identify the run.

        Of a run that goes on, the time at which it started stays.
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
        return json.loads((self.path / SETTINGS_FILE).read_text())

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
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunFolderError(f"{self.path} holds an agent without readable {SETTINGS_FILE}: {error}") from error
        differing = [
            f"{name} was {before.get(name)}, now {self.settings.get(name)}"
            for name in sorted({*before, *self.settings})
            if before.get(name) != self.settings.get(name)
        ]
        if differing:
            raise RunFolderError(
                f"{self.path} holds a run with other settings ({'; '.join(differing)}): {self._otherwise}"
            )


def step_limit(num_episodes: int, episode_steps: int, learning_starts: int | None) -> int:
    """Environment steps within which so many episodes are planned from their first step on, after random actions.

    Args:
        num_episodes: how many.
        episode_steps: the most that one has.
        learning_starts: random actions; None: one episode of them.
    """
    # Planning may begin in the middle of an episode, which then is none of those that are asked for.
    at_random = episode_steps if learning_starts is None else learning_starts + episode_steps
    return at_random + num_episodes * episode_steps


class TrainingRun:
    """One agent in one environment, recorded in a folder; goes on where the folder's newest checkpoint was written.

    Args:
        folder: where to record.
        env: the environment; if it renders `rgb_array` the last episode becomes a GIF.
        make_agent: makes the agent: (environment, verbose=..., tensorboard_log=...) -> `MPCAgent`.
        num_episodes: planned episodes after which to stop, or None.
        total_timesteps: environment steps after which to stop, the random ones included; with ``num_episodes``, those
            of an episode that was given up when the run was interrupted do not count.
        checkpoint_every: see `MPCAgent.learn`.
        title: of the figures.
        results_only: print nothing, draw nothing, and leave out what the agent would learn from the last episode,
            which it does first of all if the run goes on to more episodes.

    Raises:
        CheckpointError: the folder's checkpoints are damaged, or of another agent.
    """

    def __init__(
        self,
        folder: RunFolder,
        env: gymnasium.Env,
        make_agent: Callable[..., MPCAgent],
        *,
        num_episodes: int | None,
        total_timesteps: int,
        checkpoint_every: int | None = None,
        title: str = "",
        results_only: bool = False,
    ):
        self.folder, self.num_episodes, self.total_timesteps = folder, num_episodes, total_timesteps
        self.checkpoint_every, self.title, self.results_only = checkpoint_every, title, results_only
        self.recorder = EpisodeRecorder(env)
        logs = str(folder.path / LOGS)
        self.agent = make_agent(self.recorder, verbose=0 if results_only else 1, tensorboard_log=logs)
        rows = []
        if resume_from(self.agent, folder.checkpoints):
            # An episode whose row was written but whose agent was not saved will be played again.
            rows = [row for row in folder.rows() if row.total_steps <= self.agent.num_timesteps]
            if num_episodes is not None and not self.agent.has_running_episode:
                # A new episode begins. Steps of those given up, which have no row, cost none of the episodes asked for.
                self.total_timesteps += self.agent.num_timesteps - sum(row.steps for row in rows)
        folder.write_rows(rows)
        self.figures: list[Path] = []
        """The figures that were drawn, once the last episode has ended."""
        self.forecasts = None if results_only else ForecastCallback(self.agent, self.recorder)

    @property
    def is_complete(self) -> bool:
        """Whether everything that was asked for has been done before."""
        return self._has_enough and (self.results_only or not self.agent.is_training_due)

    @property
    def _has_enough(self) -> bool:
        """Whether there are as many episodes or steps as were asked for."""
        planned = sum(row.actions == "planned" for row in self.folder.rows())
        enough = self.num_episodes is not None and planned >= self.num_episodes
        return enough or self.agent.num_timesteps >= self.total_timesteps

    def train(self, *, progress_bar: bool) -> None:
        """Learn until the end, and (unless `results_only`) leave a model that has seen every finished episode.

        Raises:
            DGPMPCError: planning or the environment failed; everything that was observed is saved.
            KeyboardInterrupt, SystemExit: Ctrl-C or SIGTERM; see `MPCAgent.learn`.
        """
        callback = CallbackList([*([] if self.forecasts is None else [self.forecasts]), _KeepEpisodes(self)])
        # A run that the callback stops ends before its last episode is learned from; without steps `learn` only trains.
        steps = 0 if self._has_enough else self.total_timesteps - self.agent.num_timesteps
        for steps_of_call in (steps,) if self.results_only else (steps, 0):
            self.agent.learn(
                steps_of_call,
                callback,
                tb_log_name=LOG_NAME,
                reset_num_timesteps=not self.folder.checkpoints.exist,
                progress_bar=progress_bar and steps_of_call > 0,
                run_folder=self.folder.checkpoints,
                checkpoint_every=self.checkpoint_every,
            )
        if not self.figures and not self.results_only:
            self.figures = self.write_figures(self.title)

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
        if self.forecasts is not None and self.forecasts.forecasts:
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
    """Writes each finished episode's row; draws the figures and stops after those that were asked for.

    All this comes before the episode's checkpoint, so that a kill in between plays the episode again.
    """

    def __init__(self, run: TrainingRun):
        super().__init__()
        self.run = run

    def _on_step(self) -> bool:
        if not self.locals["dones"][0]:
            return True
        folder, agent, episode = self.run.folder, self.run.agent, self.run.recorder.last
        assert episode is not None
        rows = folder.rows()
        success = self.locals["infos"][0].get("is_success")
        record = agent.episode_records[0]
        row = EpisodeRow(
            episode=len(rows) + 1,
            actions="planned" if record.plan_steps[:1] == [0] else "random",  # as its first actions were
            episode_return=float(episode.rewards.sum()),
            steps=len(episode.rewards),
            total_steps=agent.num_timesteps,
            seconds=round(record.seconds, 3),
            planning_seconds=round(sum(record.plan_seconds), 3),
            success=None if success is None else bool(success),
        )
        folder.write_rows([*rows, row])
        is_last = sum(row.actions == "planned" for row in [*rows, row]) == self.run.num_episodes
        if (is_last or agent.num_timesteps >= self.run.total_timesteps) and not self.run.results_only:
            self.run.figures = self.run.write_figures(self.run.title)
        return not is_last
