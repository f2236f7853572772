"""Bars on the terminal while an agent learns: the steps of the call, and how far a training is that takes a while.

In place of Stable-Baselines3's, which knows nothing of trainings, and after an error leaves the terminal without a
cursor. What can only print (a log file, a terminal of `TERM=dumb`, a notebook without ipywidgets) gets one line at the
end, without control characters.
"""

import importlib.util
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from rich import get_console
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from gym_dgpmpc.types import DynamicsModel, ProgressFn, ReportsProgress

SHOWN_AFTER = 1.0
"""Seconds that a training takes before its bar is shown."""


class Bars:
    """The bars of one call of `learn`, a context manager.

    Args:
        wanted: whether to show them.
    """

    def __init__(self, wanted: bool):
        self._wanted = wanted
        self._progress: Progress | None = None
        self._steps: TaskID | None = None

    def __enter__(self) -> "Bars":
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress is not None:
            self._progress.stop()
        self._progress = None

    def begin(self, num_steps: int) -> None:
        """Show the bar of so many environment steps, if there are any to take."""
        console = _console()
        if not self._wanted or (num_steps <= 0 and not console.is_interactive):
            return
        self._progress = Progress(
            TextColumn("{task.description:8}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("<"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[loss]}"),
            console=console,
        )
        if num_steps > 0:
            self._steps = self._progress.add_task("steps", total=num_steps, loss="")
        self._progress.start()

    def step(self, num_steps: int) -> None:
        """So many more environment steps were taken."""
        if self._progress is not None and self._steps is not None:
            self._progress.advance(self._steps, num_steps)

    @contextmanager
    def training(self, model: DynamicsModel) -> Iterator[list[float]]:
        """Listen to the model's training; if bars are wanted, show how far it is once it takes `SHOWN_AFTER`.

        Yields:
            The losses that the model reports, as they come; none of a model that does not.
        """
        losses = list[float]()
        with self._bar() as show:
            if not isinstance(model, ReportsProgress):
                yield losses
                return
            listener = model.on_progress

            def report(done: int, total: int, loss: float) -> None:
                losses.append(loss)
                show(done, total, loss)
                if listener is not None:
                    listener(done, total, loss)

            model.on_progress = report
            try:
                yield losses
            finally:
                model.on_progress = listener

    @contextmanager
    def _bar(self) -> Iterator[ProgressFn]:
        """A bar below that of the steps, while it lasts; yields how to move it on."""
        progress = self._progress
        if progress is None:
            yield _show_nothing
            return
        # Without a total a bar moves to and fro, as that of a model that does not report.
        task = progress.add_task("training", total=None, visible=False, loss="")
        timer = threading.Timer(SHOWN_AFTER, lambda: progress.update(task, visible=True))
        timer.daemon = True
        timer.start()
        try:
            yield lambda done, total, loss: progress.update(task, completed=done, total=total, loss=f"loss {loss:.4g}")
        finally:
            timer.cancel()
            timer.join()  # lest it moves a bar that is gone
            progress.remove_task(task)


def _console() -> Console:
    """Rich's own, but in a notebook without ipywidgets, where that would draw no bar and warn at each attempt."""
    console = get_console()
    if console.is_jupyter and importlib.util.find_spec("ipywidgets") is None:
        return Console(force_jupyter=False, force_terminal=False)  # a kernel sets FORCE_COLOR
    return console


def _show_nothing(done: int, total: int, loss: float) -> None:
    """Where no bars are wanted."""
