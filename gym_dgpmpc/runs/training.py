"""A training run: an agent learns in an environment, and a `RunFolder` takes its results as they come.

`dgpmpc train` and the benchmarks are made of it. A run that was killed goes on to the same files; only the columns of
wall-clock times differ then from those of a run that was not.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.checkpoints.safeguard import resume_from
from gym_dgpmpc.formats import FORMATS
from gym_dgpmpc.runs.figures import observation_labels
from gym_dgpmpc.runs.folder import FORECASTS, LAST_EPISODE, LOGS, EpisodeRow, RunFolder
from gym_dgpmpc.runs.forecasts import KeptForecasts
from gym_dgpmpc.runs.looking import LookInside
from gym_dgpmpc.runs.plotting import draw_run
from gym_dgpmpc.runs.recording import EpisodeRecorder, ForecastCallback
from gym_dgpmpc.runs.rendering import write_gif

LOG_NAME = "DGPMPC"
"""Name of the run within TensorBoard's folder."""


def step_limit(num_episodes: int, episode_steps: int, learning_starts: int | None) -> int:
    """Environment steps within which so many episodes are planned from their first step on, after random actions.

    Args:
        num_episodes: planned episodes.
        episode_steps: steps of an episode, at most.
        learning_starts: random actions; None means one episode of them.
    """
    # Planning may begin in the middle of an episode, which then does not count towards the number.
    at_random = episode_steps if learning_starts is None else learning_starts + episode_steps
    return at_random + num_episodes * episode_steps


class TrainingRun:
    """One agent in one environment, recorded in a folder; goes on where the folder's newest checkpoint was written.

    Args:
        folder: where to record.
        env: the environment; if it renders `rgb_array` the last episode becomes a GIF.
        make_agent: makes the agent: (environment, verbose=..., tensorboard_log=...) -> `MPCAgent`.
        num_episodes: planned episodes after which to stop, or None.
        total_timesteps: environment steps after which to stop, the random ones included. With ``num_episodes``, steps
            of an episode that was given up when the run was interrupted do not count.
        checkpoint_every: see `MPCAgent.learn`.
        title: heading of the figures.
        formats: of the figures; some of `FORMATS`.
        look: log what `LookInside` sees, too.
        results_only: print nothing, draw nothing, and skip the training after the last episode, which comes first if
            the run goes on to more episodes.

    Raises:
        CheckpointError: the folder's checkpoints are damaged or belong to another agent.
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
        formats: Sequence[str] = FORMATS[:1],
        look: bool = False,
        results_only: bool = False,
    ):
        self.folder, self.num_episodes, self.total_timesteps = folder, num_episodes, total_timesteps
        self.checkpoint_every, self.results_only = checkpoint_every, results_only
        self.title, self.formats = title, formats
        self.recorder = EpisodeRecorder(env)
        logs = str(folder.path / LOGS)
        self.agent = make_agent(self.recorder, verbose=0 if results_only else 1, tensorboard_log=logs)
        rows = []
        if resume_from(self.agent, folder.checkpoints):
            # An episode whose row was written but whose agent was not saved will be played again.
            rows = [row for row in folder.rows() if row.total_steps <= self.agent.num_timesteps]
            if num_episodes is not None and not self.agent.has_running_episode:
                # A new episode begins. Steps of episodes given up, which have no row, do not reduce the planned ones.
                self.total_timesteps += self.agent.num_timesteps - sum(row.steps for row in rows)
        folder.write_rows(rows)
        self.figures: list[Path] = []
        """The figures that were drawn, once the last episode has ended."""
        self.forecasts = None if results_only else ForecastCallback(self.agent, self.recorder)
        self.looking = LookInside() if look else None

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
        watching = [each for each in (self.forecasts, self.looking) if each is not None]
        callback = CallbackList([*watching, _KeepEpisodes(self)])
        # The callback stops a run before the training on its last episode; `learn` without steps does only that.
        steps = 0 if self._has_enough else self.total_timesteps - self.agent.num_timesteps
        for steps_of_call in (steps,) if self.results_only else (steps, 0):
            self.agent.learn(
                steps_of_call,
                callback,
                tb_log_name=LOG_NAME,
                reset_num_timesteps=not self.folder.checkpoints.exist,
                progress_bar=progress_bar,
                run_folder=self.folder.checkpoints,
                checkpoint_every=self.checkpoint_every,
            )
        if not self.figures and not self.results_only:
            self.figures = self.write_figures(self.title)

    def write_figures(self, title: str) -> list[Path]:
        """Draw what there is to draw, and return the files that were written."""
        path = self.folder.path
        if self.forecasts is not None and self.forecasts.forecasts:
            env, rows = self.recorder.unwrapped, self.folder.rows()
            KeptForecasts(
                self.forecasts.forecasts,
                observation_labels(type(env), self.agent.observation_space.shape[0]),
                episode=rows[-1].episode,
                step_seconds=getattr(env, "dt", None),
            ).write(path / FORECASTS)
        written = draw_run(path, title, self.formats)
        last = self.recorder.last
        if last is not None and last.frames:
            written.append(path / LAST_EPISODE)
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
            cpu_seconds=round(record.cpu_seconds, 3),
            training_iterations=record.training_iterations,
        )
        folder.write_rows([*rows, row])
        is_last = sum(row.actions == "planned" for row in [*rows, row]) == self.run.num_episodes
        if (is_last or agent.num_timesteps >= self.run.total_timesteps) and not self.run.results_only:
            self.run.figures = self.run.write_figures(self.run.title)
        return not is_last
