"""The two pictures of a run: what was earned, and what the model foresaw against what happened.

Figures are made through Matplotlib's object interface alone, so that drawing needs no display and leaves the
caller's pyplot state as it was.
"""

import math
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy import ndarray

from gym_dgpmpc.checkpoints.files import replace_file
from gym_dgpmpc.formats import FORMATS

MODEL_COLOUR, TRUTH_COLOUR, RANDOM_COLOUR = "tab:blue", "black", "tab:gray"
BANDS = {0.9: 0.2, 0.5: 0.35}
"""The bands of a fan, widest first: probability inside -> opacity."""

WIDEST = max(BANDS)

Paths = str | Path | Sequence[Path]
"""A file, or the same figure's files of several formats; the suffix decides which."""

NO_DATES: dict[str, dict[str, str | None]] = {
    "png": {"Software": None},
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
}
"""By format, metadata without what differs from one day or version to the next."""

RETURN = "return (sum of the episode's rewards)"
"""Label of an axis."""

NUM_SAMPLE_PATHS = 3
MAX_DIMENSIONS = 12
"""Observation dimensions that one fan figure shows; more would not be readable."""


class Forecast(NamedTuple):
    """What a model predicted from one step of an episode for the actions that were then taken, and what came.

    ``predicted[0]`` and ``observed[0]`` are the observation the prediction starts from.
    """

    start_step: int
    predicted: Float[ndarray, "H_plus_1 P S"]
    observed: Float[ndarray, "H_plus_1 S"]
    actions: Float[ndarray, "H A"] | None = None
    """What was done, to be shown below; None shows nothing."""


def plot_learning_curve(
    returns: Sequence[float],
    path: Paths,
    *,
    title: str,
    num_random: int = 1,
    episode_steps: Sequence[int] | None = None,
) -> None:
    """Draw the return of every episode in the order they were played, and write the picture to ``path``.

    Args:
        returns: one per episode, the random ones included.
        path: the file or files; their suffix decides the format.
        title: what was trained on what.
        num_random: how many episodes, from the first, acted at random.
        episode_steps: environment steps of each episode; the lower axis then says how many were taken in all.

    Raises:
        ValueError: there are no episodes, or ``episode_steps`` has another length than ``returns``.
    """
    if not len(returns):
        raise ValueError("a learning curve needs at least one episode, got none")
    if episode_steps is not None and len(episode_steps) != len(returns):
        raise ValueError(f"episode_steps must have {len(returns)} numbers, one per return, got {len(episode_steps)}")
    episodes = np.arange(1, len(returns) + 1)
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(episodes, returns, color=MODEL_COLOUR, linewidth=1.5, zorder=1)
    axes.scatter(
        episodes[num_random:], returns[num_random:], color=MODEL_COLOUR, zorder=2, label="planned with the model"
    )
    if num_random:
        axes.scatter(episodes[:num_random], returns[:num_random], color=RANDOM_COLOUR, zorder=2, label="random actions")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("episode" if episode_steps is None else f"episode ({sum(episode_steps)} environment steps in all)")
    axes.set_ylabel(RETURN)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    write_figure(figure, path, dpi=150)


def plot_prediction_fan(
    forecasts: Sequence[Forecast],
    path: Paths,
    *,
    labels: Sequence[str],
    title: str,
    step_seconds: float | None = None,
) -> None:
    """Write `prediction_fan` to ``path``: the file or files; their suffix decides the format."""
    write_figure(prediction_fan(forecasts, labels=labels, title=title, step_seconds=step_seconds), path, dpi=130)


def prediction_fan(
    forecasts: Sequence[Forecast], *, labels: Sequence[str], title: str, step_seconds: float | None = None
) -> Figure:
    """Draw the particles' 50 % and 90 % bands, their median and a few of their paths, with what happened.

    One column per forecast, one row per observation dimension that changed or was predicted to change; each panel
    says how many of the observed values fell inside the wider band, which for a calibrated model is nine in ten on
    average (the values of one forecast are correlated, so single panels scatter widely).

    Args:
        forecasts: at least one, all of the same observation size S, and all with actions or none.
        labels: S texts with units.
        title: the figure's heading.
        step_seconds: duration of an environment step, if it is known.

    Raises:
        ValueError: there are no forecasts, or another number of labels than S.
    """
    if not forecasts:
        raise ValueError("a prediction fan needs at least one forecast, got none")
    size = forecasts[0].observed.shape[1]
    if len(labels) != size:
        raise ValueError(f"labels must have {size} texts, one per number of the observation, got {len(labels)}")
    shown = [i for i in range(size) if any(_moves(forecast, i) for forecast in forecasts)][:MAX_DIMENSIONS]
    shown = shown or [0]
    rows = len(shown) + (forecasts[0].actions is not None)
    figure = Figure(figsize=(5.2 * len(forecasts) + 0.8, 1.9 * rows + 1.2), layout="constrained")
    grid = figure.subplots(rows, len(forecasts), squeeze=False, sharex="col", sharey="row")
    for column, forecast in enumerate(forecasts):
        for row, dimension in enumerate(shown):
            _draw_fan(grid[row, column], forecast, dimension)
            _limit_to_what_matters(grid[row, 0], forecasts, dimension)
        if forecast.actions is not None:
            _draw_actions(grid[-1, column], forecast.start_step, forecast.actions)
        horizon = len(forecast.observed) - 1
        grid[0, column].set_title(f"{horizon} steps ahead from step {forecast.start_step}", fontsize="medium")
        duration = f", 1 step = {step_seconds:g} s" if step_seconds else ""
        grid[-1, column].set_xlabel(f"step of the episode{duration}")
        grid[-1, column].xaxis.set_major_locator(MaxNLocator(integer=True))
    if rows > len(shown):
        grid[-1, 0].set_ylabel("actions", fontsize="small")
    for row, dimension in enumerate(shown):
        grid[row, 0].set_ylabel(textwrap.fill(labels[dimension], 26), fontsize="small")
    hidden = f"; {size - len(shown)} of {size} dimensions not shown" if len(shown) < size else ""
    figure.suptitle(title + hidden)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize="small")
    return figure


def write_figure(figure: Figure, path: Paths, *, dpi: int) -> None:
    """Write a picture, whole or not at all; the same numbers give the same file.

    Args:
        figure: what is drawn.
        path: the file or files; their suffix decides the format.
        dpi: dots per inch.

    Raises:
        OSError: it cannot be written; an old file is untouched.
    """
    figure.dpi = dpi
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # it would begin where the file before left it
    for each in [Path(path)] if isinstance(path, str | Path) else path:
        kind = each.suffix.removeprefix(".") or FORMATS[0]

        def save(file: IO[bytes], kind: str = kind) -> None:
            with matplotlib.rc_context({"svg.hashsalt": ""}):  # else the names within an SVG are random
                figure.savefig(file, format=kind, dpi=dpi, metadata=NO_DATES.get(kind))

        replace_file(each, save)


def files_of(folder: Path, name: str, formats: Sequence[str]) -> list[Path]:
    """The files of one figure in several formats."""
    return [folder / f"{name}.{each}" for each in formats]


def observation_labels(env_class: type, size: int) -> list[str]:
    """Names and units of an environment's observation, from the table in its class's description.

    Gymnasium's environments, and this package's, describe their observation in a table of rows
    ``| 0 | what it is | ... | unit |``. Without one that fits, the labels only count.
    """
    section = re.search(r"## Observation space(.*?)(?=\n\s*## |\Z)", env_class.__doc__ or "", re.DOTALL | re.IGNORECASE)
    rows = re.findall(r"^\s*\|(.+)\|\s*$", section.group(1), re.MULTILINE) if section else []
    cells = [[cell.strip() for cell in row.split("|")] for row in rows]
    numbered = [row for row in cells if row[0].isdigit()]
    if [row[0] for row in numbered] != [str(i) for i in range(size)] or any(len(row) < 3 for row in numbered):
        return [f"observation {i}" for i in range(size)]
    names = [row[1].split(";")[0] for row in numbered]
    if "unit" not in cells[0][-1].lower():
        return names
    return [f"{name} ({_unit(row[-1])})" for name, row in zip(names, numbered, strict=True)]


def _unit(cell: str) -> str:
    """The unit in a table's last cell: Gymnasium's tables write "angular velocity (rad/s)", others just "rad/s"."""
    in_brackets = re.search(r"\(([^()]*)\)\s*$", cell)
    return in_brackets.group(1) if in_brackets else cell


def _moves(forecast: Forecast, dimension: int) -> bool:
    return bool(np.ptp(forecast.observed[:, dimension]) > 0 or np.ptp(forecast.predicted[:, :, dimension]) > 0)


def _draw_fan(axes: Axes, forecast: Forecast, dimension: int) -> None:
    predicted, observed = forecast.predicted[:, :, dimension], forecast.observed[:, dimension]
    steps = forecast.start_step + np.arange(len(observed))
    for probability, alpha in BANDS.items():
        low, high = _interval(predicted, probability)
        label = f"{probability:.0%} of {predicted.shape[1]} particles"
        axes.fill_between(steps, low, high, color=MODEL_COLOUR, alpha=alpha, linewidth=0, label=label)
    axes.plot(steps, np.median(predicted, axis=1), color=MODEL_COLOUR, linewidth=1.5, label="median")
    paths = axes.plot(steps, predicted[:, :NUM_SAMPLE_PATHS], color="tab:orange", linewidth=0.7, alpha=0.9)
    paths[0].set_label("single particles")
    axes.plot(steps, observed, color=TRUTH_COLOUR, linewidth=1.5, linestyle="--", label="what happened")
    low, high = _interval(predicted[1:], WIDEST)
    inside = int(np.sum((low <= observed[1:]) & (observed[1:] <= high)))
    text = f"{inside} of {len(observed) - 1} inside the {WIDEST:.0%} band"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.5}
    axes.text(0.99, 0.96, text, transform=axes.transAxes, ha="right", va="top", fontsize="x-small", bbox=box)
    axes.grid(alpha=0.3)


def _draw_actions(axes: Axes, start: int, actions: Float[ndarray, "H A"]) -> None:
    """Each action over the step that it was performed in."""
    edges = start + np.arange(len(actions) + 1)
    for index, values in enumerate(actions[:, :MAX_DIMENSIONS].T):
        axes.stairs(values, edges, baseline=None, label=f"{index}", linewidth=1.2)
    if actions.shape[1] > 1:
        axes.legend(loc="upper right", fontsize="xx-small", ncols=6)
    axes.grid(alpha=0.3)


def _interval(
    predicted: Float[ndarray, "T P"], probability: float
) -> tuple[Float[ndarray, " T"], Float[ndarray, " T"]]:
    """The central interval over the particles at each step; a particle that is not finite widens it without limit."""
    lowest = np.where(np.isfinite(predicted), predicted, -np.inf)
    highest = np.where(np.isfinite(predicted), predicted, np.inf)
    tail = (1 - probability) / 2
    # An order statistic rather than an interpolated quantile: between two infinities interpolation gives NaN.
    return (
        np.quantile(lowest, tail, axis=1, method="lower"),
        np.quantile(highest, 1 - tail, axis=1, method="higher"),
    )


def _limit_to_what_matters(axes: Axes, forecasts: Sequence[Forecast], dimension: int) -> None:
    """Let what happened and the bands decide the vertical range, up to five times that of what happened.

    A diverging model would otherwise squeeze the truth into a flat line.
    """
    observed = np.concatenate([forecast.observed[:, dimension] for forecast in forecasts])
    bands = np.concatenate([np.ravel(_interval(f.predicted[:, :, dimension], WIDEST)) for f in forecasts])
    bands = bands[np.isfinite(bands)]
    centre, reach = (observed.max() + observed.min()) / 2, 2.5 * max(float(np.ptp(observed)), 1e-6)
    low = max(min(observed.min(), bands.min(initial=math.inf)), centre - reach)
    high = min(max(observed.max(), bands.max(initial=-math.inf)), centre + reach)
    margin = 0.05 * max(high - low, 1e-6)
    axes.set_ylim(low - margin, high + 4 * margin)  # above: room for the text
