"""What keeps a run safe while it learns: checkpoints as it goes, a last one when it fails, and clean stops."""

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import Protocol, runtime_checkable

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback

from gym_dgpmpc.checkpoints.collect import collect
from gym_dgpmpc.checkpoints.event_files import drop_events_after
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.checkpoints.interface import Checkpointed
from gym_dgpmpc.checkpoints.resume import resume_agent
from gym_dgpmpc.checkpoints.signals import StopRequests
from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.errors import CheckpointError, ReliabilityWarning


@runtime_checkable
class Guard(Protocol):
    """What `MPCAgent.learn` asks of what stands around it."""

    @property
    def is_on(self) -> bool:
        """Whether there is a run's folder."""
        ...

    @property
    def goes_on(self) -> bool:
        """Whether the folder held a run, which the agent goes on with."""
        ...

    def begin(self, tb_log_name: str) -> None:
        """The environments are reset; the next thing is the logger."""
        ...

    def callback(self) -> BaseCallback:
        """To be called after each step, behind the user's callbacks."""
        ...

    def training(self) -> AbstractContextManager[None]:
        """Around each training."""
        ...


class Unguarded:
    """A `Guard` of a call without a run's folder: nothing is written, and signals do what they always do."""

    is_on = goes_on = False

    def begin(self, tb_log_name: str) -> None:
        """Nothing to do."""

    def callback(self) -> BaseCallback:
        return _AfterEachStep(lambda *, episode_ended: None)

    def training(self) -> AbstractContextManager[None]:
        return nullcontext()


def safeguard(
    agent: Checkpointed,
    run_folder: str | os.PathLike[str] | RunCheckpoints | None,
    *,
    resume: bool,
    checkpoint_every: int | None,
) -> "AbstractContextManager[Guard]":
    """What stands around one call of `MPCAgent.learn`: a `Safeguard` if there is a folder, else an `Unguarded`.

    Raises:
        ValueError: there is no folder to resume from or to write to; or see `Safeguard`.
    """
    if run_folder is not None:
        return Safeguard(agent, run_folder, resume=resume, checkpoint_every=checkpoint_every)
    if resume or checkpoint_every is not None:
        raise ValueError("resume and checkpoint_every need a run_folder")
    return nullcontext(Unguarded())


class Safeguard:
    """A context around one call of `MPCAgent.learn` with a run's folder.

    On entering, the folder is taken hold of, and the agent goes on from it if it should. Inside, `begin` writes a first
    checkpoint, so that a run killed within its first episode is known to be one; `callback` writes checkpoints and
    heeds requests to stop; `training` is around each training. On an exception everything gathered so far is written,
    unless the run never began.

    Args:
        agent: the `MPCAgent` that learns.
        run_folder: the folder, or the checkpoints of one that is held already.
        resume: go on from the folder's checkpoint, if there is one.
        checkpoint_every: environment steps between two checkpoints within an episode, beside those after each; None
            for the latter alone. See `after_step` for episodes that cannot be repeated.

    Raises:
        RunInUseError, CheckpointWriteError: see `RunCheckpoints`.
        CheckpointError: the folder holds a run although none is to be resumed; or see `resume_agent`.
        ValueError: ``checkpoint_every`` is not positive.
    """

    def __init__(
        self,
        agent: Checkpointed,
        run_folder: str | os.PathLike[str] | RunCheckpoints,
        *,
        resume: bool,
        checkpoint_every: int | None,
    ):
        if checkpoint_every is not None:
            check_counts(checkpoint_every=checkpoint_every)
        self.agent, self.run_folder, self.resume, self.every = agent, run_folder, resume, checkpoint_every
        self.stop = StopRequests()
        self._stack = ExitStack()
        self._saved: tuple[int, int] | None = None  # steps and fitted transitions of the last checkpoint

    def __enter__(self) -> "Safeguard":
        with ExitStack() as stack:
            if isinstance(self.run_folder, RunCheckpoints):
                self.checkpoints = self.run_folder
            else:
                self.checkpoints = stack.enter_context(RunCheckpoints(self.run_folder))
                if self.checkpoints.exist and not self.resume:
                    raise CheckpointError(
                        f"{self.checkpoints.folder} holds a run: pass resume=True to go on with it, or choose another "
                        "folder"
                    )
            if self.resume:
                resume_from(self.agent, self.checkpoints)
            self._goes_on = self.checkpoints.exist
            if self._goes_on:
                self._continue_logs()
            stack.enter_context(self.stop)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._stack:
            if error is None:
                if self._saved != self._present():
                    self._save()
                if self.stop.received is not None:  # after the last step
                    self.stop.stop()
            elif isinstance(error, Exception) and (self._goes_on or self._saved is not None):
                try:
                    self._save(gives_up=True)
                except Exception as another:  # must not hide what happened first
                    warnings.warn(
                        f"no checkpoint could be written after that error: {another}", ReliabilityWarning, stacklevel=2
                    )

    is_on = True

    @property
    def goes_on(self) -> bool:
        """Whether the folder held a run, which the agent goes on with."""
        return self._goes_on

    def begin(self, tb_log_name: str) -> None:
        """Choose where a new run logs, and write its first checkpoint, which says so before there is such a folder."""
        if self._goes_on:
            return
        self.agent.logs.choose_run(tb_log_name)
        self._save()

    def callback(self) -> BaseCallback:
        """Calls `after_step`, as the last of all callbacks."""
        return _AfterEachStep(self.after_step)

    def _continue_logs(self) -> None:
        """Drop what was logged after the checkpoint, for it will be logged again; see `event_files`."""
        folder, run = self.agent.tensorboard_log, self.agent.logs.run
        if folder is not None and run is not None:
            drop_events_after(self.agent.num_timesteps, Path(folder) / run)

    @contextmanager
    def training(self) -> Iterator[None]:
        """A context for a training, in which a signal stops at once: it begins with all steps on disk.

        At an episode's start they are there already.

        Raises:
            KeyboardInterrupt, SystemExit: see `StopRequests`.
            CheckpointWriteError: the checkpoint cannot be written.
        """
        starts = self.agent._last_episode_starts
        if self._saved != self._present() and starts is not None and not starts.any():
            self._save()
        with self.stop.at_any_time():
            yield

    def after_step(self, *, episode_ended: bool) -> None:
        """Write a checkpoint if one is due, and stop if that was asked for.

        A checkpoint within an episode that cannot be repeated, as in a plant, keeps the steps; a new episode begins
        when the run goes on.

        Raises:
            KeyboardInterrupt, SystemExit: see `StopRequests`.
            CheckpointWriteError: the checkpoint cannot be written.
        """
        stopping = self.stop.received is not None
        # A step of n environments is n timesteps, so it may pass over the multiple.
        every = self.every is not None and self.agent.num_timesteps % self.every < self.agent.n_envs
        if episode_ended or stopping or every:
            self._save()
        if stopping:
            self.stop.stop()

    def _save(self, *, gives_up: bool = False) -> None:
        self.checkpoints.save(collect(self.agent, gives_up=gives_up))
        self._saved = self._present()

    def _present(self) -> tuple[int, int]:
        return self.agent.num_timesteps, self.agent.num_fitted


def callbacks_before(guard: Guard, callback: MaybeCallback) -> list[BaseCallback]:
    """What `learn` was given, as SB3's callbacks, with the guard's behind them."""
    given = callback if isinstance(callback, list) else [callback]
    given = [each if isinstance(each, BaseCallback) else ConvertCallback(each) for each in given]
    return [*given, guard.callback()]


class _AfterEachStep(BaseCallback):
    """Says, after each step of all environments, whether an episode has ended."""

    def __init__(self, after_step: Callable[..., None]):
        super().__init__()
        self._after_step = after_step

    def _on_step(self) -> bool:
        self._after_step(episode_ended=bool(np.any(self.locals["dones"])))
        return True


def resume_from(agent: Checkpointed, checkpoints: RunCheckpoints) -> bool:
    """Go on from the newest checkpoint that is whole; False if there is none.

    Raises:
        CheckpointError: see `RunCheckpoints.load` and `resume_agent`.
    """
    checkpoint = checkpoints.load()
    if checkpoint is not None:
        resume_agent(agent, checkpoint)
    return checkpoint is not None
