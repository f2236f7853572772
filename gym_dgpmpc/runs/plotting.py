"""The figures of runs from what their folders hold: of one run as it left them, of several in one chart.

Nothing here needs the environment, or holds a folder: a run that goes on may be drawn too.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray

from gym_dgpmpc.formats import FORMATS
from gym_dgpmpc.runs.figures import (
    RANDOM_COLOUR,
    RETURN,
    Paths,
    files_of,
    plot_learning_curve,
    plot_prediction_fan,
    write_figure,
)
from gym_dgpmpc.runs.folder import (
    EPISODES_FILE,
    FORECASTS,
    LEARNING_CURVE,
    PREDICTION_FAN,
    EpisodeRow,
    RunFolderError,
    read_rows,
    read_settings,
)
from gym_dgpmpc.runs.forecasts import KeptForecasts

NUM_COLOURS = 10
LINE_STYLES = ("-", "--", ":")
"""Of the first ten methods, the next ten, and the rest."""

MOST_NAMED = 3
"""Settings that tell methods apart in a legend; where more differ, the folders' names do."""


class RecordedRun(NamedTuple):
    """What a run's folder says of it."""

    path: Path
    settings: Mapping[str, Any]
    rows: Sequence[EpisodeRow]

    @classmethod
    def read(cls, path: Path) -> "RecordedRun":
        """The run in a folder.

        Raises:
            RunFolderError: there is none, or no episode of it has ended.
            OSError: a file cannot be read.
        """
        settings, file = read_settings(path)["settings"], path / EPISODES_FILE
        try:
            rows = read_rows(file)
        except (ValueError, KeyError, TypeError) as error:
            raise RunFolderError(f"{file} cannot be read: {error!r}") from error
        if not rows:
            raise RunFolderError(f"no episode of the run in {path} has ended: there is nothing to draw")
        return cls(path, settings, rows)


def title_of(settings: Mapping[str, Any]) -> str:
    """What figures call the run of these settings."""
    seed = f", seed {settings['seed']}" if "seed" in settings else ""
    return f"{settings.get('environment')}, {model_of(settings)}{seed}"


def model_of(settings: Mapping[str, Any]) -> str:
    """What figures call the method of a run of these settings."""
    if "method" in settings:  # of a benchmark
        return str(settings["method"])
    if settings.get("members"):
        return " and ".join(settings["members"])
    return f"L = {settings['num_layers']}, {settings['kernel']}" if "kernel" in settings else str(settings.get("agent"))


def draw_run(folder: Path, title: str, formats: Sequence[str] = FORMATS[:1], out: Path | None = None) -> list[Path]:
    """Draw the learning curve, and the prediction fan if there are forecasts, and return the files that were written.

    Args:
        folder: of the run.
        title: heading of the figures.
        formats: some of `FORMATS`.
        out: the folder to write to; default: the run's.

    Raises:
        ValueError: the forecasts cannot be read.
        OSError: a file cannot be read or written.
    """
    out, written = out or folder, []
    rows = read_rows(folder / EPISODES_FILE)
    if rows:
        written += (files := files_of(out, LEARNING_CURVE, formats))
        plot_learning_curve(
            [row.episode_return for row in rows],
            files,
            title=title,
            num_random=sum(row.actions == "random" for row in rows),
            episode_steps=[row.steps for row in rows],
        )
    if (folder / FORECASTS).is_file():
        kept = KeptForecasts.read(folder / FORECASTS)
        written += (files := files_of(out, PREDICTION_FAN, formats))
        plot_prediction_fan(
            kept.forecasts,
            files,
            labels=kept.labels,
            title=f"Predicted before it happened: episode {kept.episode}, {title}",
            step_seconds=kept.step_seconds,
        )
    return written


def draw_runs(
    runs: Sequence[RecordedRun], name: Path, formats: Sequence[str] = FORMATS[:1], title: str | None = None
) -> list[Path]:
    """Draw the learning curves of several runs in one chart, and return the files that were written.

    Args:
        runs: of one environment.
        name: of the files, without their suffix.
        formats: some of `FORMATS`.
        title: heading of the figure; default: the environment, and the model if it is the same of all.

    Raises:
        ValueError: they are of several environments, whose returns do not compare.
        OSError: a file cannot be written.
    """
    environments = sorted({str(run.settings.get("environment")) for run in runs})
    if len(environments) > 1:
        raise ValueError(f"returns of different tasks do not compare: draw {' and '.join(environments)} one at a time")
    methods, files = by_method(runs), files_of(name.parent, name.name, formats)
    models = {model_of(run.settings) for run in runs}
    known = f"{environments[0]}, {models.pop()}" if len(models) == 1 else environments[0]
    plot_learning_curves(methods, files, title=title or known)
    return files


def by_method(runs: Sequence[RecordedRun]) -> dict[str, list[RecordedRun]]:
    """Runs that differ in nothing but their seed together, under a name made of what differs from the others.

    Runs of the same settings and seed, of two versions of the code for instance, are told apart by their folders.
    """
    groups: dict[str, list[RecordedRun]] = {}
    for run in runs:
        groups.setdefault(json.dumps(_method(run), sort_keys=True), []).append(run)
    apart: list[list[RecordedRun]] = []
    for group in groups.values():
        seeds = {run.settings.get("seed") for run in group}
        apart += [group] if len(seeds) == len(group) else [[run] for run in group]
    names = _names([_method(group[0]) for group in apart])
    if names is None:
        others = [f" and {len(group) - 1} more" if len(group) > 1 else "" for group in apart]
        names = [f"{group[0].path}{more}" for group, more in zip(apart, others, strict=True)]
    return dict(zip(names, apart, strict=True))


def _method(run: RecordedRun) -> dict[str, Any]:
    return {name: value for name, value in run.settings.items() if name != "seed"}


def _names(methods: Sequence[Mapping[str, Any]]) -> list[str] | None:
    """Names that tell the methods apart, made of their settings; None if none are short enough, or two are the same."""
    if len(methods) == 1:
        return [model_of(methods[0])]
    names = [model_of(method) for method in methods]
    if len(set(names)) == len(names):
        return names
    keys = dict.fromkeys(name for method in methods for name in method)
    differing = [key for key in keys if len({json.dumps(method.get(key)) for method in methods}) > 1]
    names = [", ".join(f"{key} = {method.get(key)}" for key in differing) for method in methods]
    return names if len(differing) <= MOST_NAMED and len(set(names)) == len(names) else None


def plot_learning_curves(methods: Mapping[str, Sequence[RecordedRun]], path: Paths, *, title: str) -> None:
    """Draw the return of every run against environment steps, thin, and each method's mean and standard deviation.

    Args:
        methods: the runs of each, which differ by their seeds.
        path: the file or files; their suffix decides the format.
        title: the figure's heading.
    """
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    for place, (name, runs) in enumerate(methods.items()):
        look: dict[str, Any] = {
            "color": f"C{place % NUM_COLOURS}",
            "linestyle": LINE_STYLES[place // NUM_COLOURS % len(LINE_STYLES)],
        }
        lines = [_line(run) for run in runs]
        for line in lines if len(runs) > 1 else ():
            axes.plot(*line, **look, linewidth=0.6, alpha=0.4, zorder=1)
        at, values = earned_by_then(lines)
        if not at.size:  # one run ended before another one's first episode did
            axes.plot([], [], **look, label=f"{name}: {len(runs)} seeds that do not overlap")
            continue
        mean, spread = values.mean(0), values.std(0, ddof=1) if len(runs) > 1 else None
        told = name if spread is None else f"{name}: mean ± standard deviation of {len(runs)} seeds"
        axes.plot(at, mean, **look, linewidth=1.8, label=told, zorder=3)
        if spread is not None:
            axes.fill_between(at, mean - spread, mean + spread, color=look["color"], alpha=0.2, linewidth=0)
    at_random = [row for runs in methods.values() for run in runs for row in run.rows if row.actions == "random"]
    if at_random:
        steps, returns = [row.total_steps for row in at_random], [row.episode_return for row in at_random]
        axes.scatter(steps, returns, s=14, color=RANDOM_COLOUR, label="random actions", zorder=2)
    axes.set_xlabel("environment steps")
    axes.set_ylabel(RETURN)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize="small")
    write_figure(figure, path, dpi=150)


def _line(run: RecordedRun) -> tuple[Float[ndarray, " E"], Float[ndarray, " E"]]:
    """Environment steps at the end of each episode, and its return."""
    at = np.array([row.total_steps for row in run.rows], dtype=np.float64)
    return at, np.array([row.episode_return for row in run.rows], dtype=np.float64)


def earned_by_then(
    lines: Sequence[tuple[Float[ndarray, "_"], Float[ndarray, "_"]]],  # each run has a number of episodes of its own
) -> tuple[Float[ndarray, " T"], Float[ndarray, "R T"]]:
    """At each end of an episode of any of R runs, the return of the last episode that each had ended by then.

    It begins where every run has ended an episode and ends where the first of them ends, so that all T points are of
    the same runs; without any, if the one comes after the other.
    """
    begin, end = max(at[0] for at, _ in lines), min(at[-1] for at, _ in lines)
    grid = np.unique(np.concatenate([at for at, _ in lines]))
    grid = grid[(begin <= grid) & (grid <= end)]
    return grid, np.array([returns[np.searchsorted(at, grid, side="right") - 1] for at, returns in lines])
