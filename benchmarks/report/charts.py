"""The figures of a report, drawn through Matplotlib's object interface: no display, no change to pyplot's state."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter
from numpy import ndarray

from benchmarks import paper
from benchmarks.report import scores
from benchmarks.report.curves import Clock, Curve, Earned, curve, line
from benchmarks.report.scores import CEILING, Runs
from benchmarks.report.styles import Style, styles
from gym_dgpmpc.runs.figures import Paths, write_figure

CEILING_LABEL = "planner with the true dynamics"
COLUMNS = 3
"""Panels beside each other, as many as are readable at the width of a page; four are two rows of two."""

DPI = 160
PANEL = (3.3, 2.6)
"""Width and height of a panel with its labels, in inches."""

RATIO_FOR_LOG = 3.0
"""The horizontal axis is logarithmic if the longest method's runs are this many times longer than the shortest's."""

DECADES_ALONE = 3000.0
"""A logarithmic axis whose ends have this ratio or more has numbers at powers of ten alone: others would overlap."""

AXIS = {"steps": "environment steps", "minutes": "wall-clock time (minutes)"}
EARNED = {"return": "return of an episode", "best": "maximum seen return"}
DEPTH_COLOURS = ("#E69F00", "#009E73", "#0072B2", "#CC79A7", "#D55E00", "#56B4E9", "#7F7F7F", "#8B4513")


def plot_tasks(
    tasks: Mapping[str, Sequence[str]],
    study: Mapping[str, Runs],
    references: Mapping[str, str],
    path: Paths,
    earned: Earned,
) -> None:
    """One panel per task, a curve per method against environment steps, with the ceiling.

    Args:
        tasks: the methods to draw, by task.
        study: the runs.
        references: the package's own method's setting, by task.
        path: the picture to write, or its files of several formats.
        earned: what is drawn.
    """
    columns = _columns(len(tasks))
    figure, grid = _panels(len(tasks), columns)
    looks = _looks(tasks, references)
    for axes, (task, methods) in zip(grid, tasks.items(), strict=True):
        _draw_curves(axes, study[task], methods, looks, "steps", earned)
        axes.set_title(task, fontsize="medium")
    for axes in grid[::columns]:
        axes.set_ylabel(EARNED[earned])
    _add_legend(figure, grid, _counts(tasks, study))
    write_figure(figure, path, dpi=DPI)


def plot_clocks(methods: Sequence[str], task: str, runs: Runs, reference: str | None, path: Paths) -> None:
    """One task: returns against environment steps and against wall-clock time."""
    figure, grid = _panels(2, 2)
    looks = _looks({task: methods}, {task: reference} if reference else {})
    clocks: tuple[Clock, ...] = ("steps", "minutes")
    for axes, clock in zip(grid, clocks, strict=True):
        _draw_curves(axes, runs, methods, looks, clock, "return")
    grid[0].set_ylabel(EARNED["return"])
    figure.suptitle(task, fontsize="medium")
    _add_legend(figure, grid, _counts({task: methods}, {task: runs}))
    write_figure(figure, path, dpi=DPI)


def plot_settings(task: str, runs: Runs, path: Paths) -> None:
    """One panel per kernel: every run of each depth thin, their mean thick, against environment steps."""
    settings = {scores.setting_of(method): results for method, results in runs.items()}
    kernels = [kernel for kernel in paper.KERNELS if any(setting and setting[0] == kernel for setting in settings)]
    depths = sorted({setting[1] for setting in settings if setting})
    columns = _columns(len(kernels))
    figure, grid = _panels(len(kernels), columns, share_y=True)
    for axes, kernel in zip(grid, kernels, strict=True):
        counts = []
        for place, depth in enumerate(depths):
            results = settings.get((kernel, depth), [])
            colour = DEPTH_COLOURS[place % len(DEPTH_COLOURS)]
            for result in results:
                axes.plot(*line(result, "steps", "return"), color=colour, linewidth=0.7, alpha=0.45)
            if results:
                whole = curve(results, "steps", "return")
                axes.plot(whole.at, whole.mean, color=colour, linewidth=2.2, label=f"L = {depth}")
                counts.append(len(results))
        _draw_ceiling(axes, runs)
        axes.set_title(f"{paper.KERNELS[kernel]} ({_seeds(counts)})", fontsize="medium")
        axes.set_xlabel(AXIS["steps"])
        axes.grid(alpha=0.3)
    for axes in grid[::columns]:
        axes.set_ylabel(EARNED["return"])
    figure.suptitle(task, fontsize="medium")
    _add_legend(figure, grid, {f"L = {depth}": "" for depth in depths})
    write_figure(figure, path, dpi=DPI)


def plot_variability(
    tasks: Mapping[str, Sequence[str]], study: Mapping[str, Runs], references: Mapping[str, str], path: Paths
) -> None:
    """One panel per task, a row per method: each run's average over its first episodes, their mean and deviation."""
    looks = _looks(tasks, references)
    rows = {method: row for row, method in enumerate(reversed(looks))}
    figure, grid = _panels(len(tasks), _columns(len(tasks)), height=0.8 + 0.26 * len(rows), share_y=True)
    for axes, (task, methods) in zip(grid, tasks.items(), strict=True):
        means = {method: scores.first_returns(study[task][method], paper.VARIANCE_EPISODES) for method in methods}
        ceiling = scores.ceiling_return(study[task])
        floor = _floor([float(values.mean()) for values in means.values()], ceiling)
        for method, values in means.items():
            _draw_deviation(axes, rows[method], values, looks[method], floor)
        if ceiling is not None:
            axes.axvline(ceiling, color="black", linestyle=":", linewidth=1.3, label=CEILING_LABEL)
        axes.set_yticks(range(len(rows)), list(rows), fontsize="small")
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_title(task, fontsize="medium")
        axes.set_xlabel(f"average return, first {paper.VARIANCE_EPISODES} episodes")
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(axis="x", alpha=0.3)
    _add_legend(figure, grid, {})
    write_figure(figure, path, dpi=DPI)


def _draw_deviation(axes: Axes, row: int, values: Float[ndarray, " n"], look: Style, floor: float) -> None:
    """A method's runs as dots below their mean and deviation; a number instead where that is off the axis."""
    mean = float(values.mean())
    if mean < floor:
        text = f"◂ {mean:,.0f}".replace("-", "−")
        place = axes.get_yaxis_transform()
        axes.text(0.02, row, text, color=look.colour, fontsize="x-small", va="center", transform=place)
        return
    axes.scatter(values, np.full(len(values), row - 0.25), s=9, color=look.colour, linewidth=0, alpha=0.7)
    spread = float(values.std(ddof=1)) if len(values) > 1 else None
    axes.errorbar(mean, row, xerr=spread, color=look.colour, marker=look.marker, markersize=5, linewidth=1.6, capsize=3)


def _draw_curves(
    axes: Axes, runs: Runs, methods: Sequence[str], looks: Mapping[str, Style], clock: Clock, earned: Earned
) -> None:
    drawn = {method: curve(runs[method], clock, earned) for method in methods}
    drawn = {method: whole for method, whole in drawn.items() if whole.at.size}
    for order, (method, whole) in enumerate(reversed(drawn.items())):  # the first method on top
        look = looks[method]
        spacing = max(1, len(whole.at) // 8)
        (drawn_line,) = axes.plot(whole.at, whole.mean, color=look.colour, linewidth=look.width, label=method)
        drawn_line.set(marker=look.marker, markersize=4, markevery=spacing, zorder=3 + order)
        if whole.band is not None:
            axes.fill_between(whole.at, *whole.band, color=look.colour, alpha=0.15, linewidth=0, zorder=2)
    _draw_ceiling(axes, runs)
    axes.grid(alpha=0.3)
    label = AXIS[clock]
    if drawn:
        ends = [whole.at[-1] for whole in drawn.values()]
        if max(ends) > RATIO_FOR_LOG * min(ends):
            axes.set_xscale("log")
            start = min(whole.at[0] for whole in drawn.values())
            is_wide = max(ends) >= DECADES_ALONE * start
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if is_wide else (1.0, 3.0)))
            axes.xaxis.set_major_formatter(EngFormatter(sep="") if clock == "steps" else StrMethodFormatter("{x:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            axes.xaxis.set_major_locator(MaxNLocator(5))
        label += _cut_off(axes, list(drawn.values()), scores.ceiling_return(runs))
    axes.set_xlabel(label)


def _draw_ceiling(axes: Axes, runs: Runs) -> None:
    ceiling = scores.ceiling_return(runs)
    if ceiling is not None:
        axes.axhline(ceiling, color="black", linestyle=":", linewidth=1.3, label=CEILING_LABEL)


def _cut_off(axes: Axes, drawn: Sequence[Curve], ceiling: float | None) -> str:
    """Cut the lowest returns off where they would squeeze all others into a strip; the result says so."""
    lowest = [float(whole.mean.min()) for whole in drawn]
    top = max([float(whole.mean.max()) for whole in drawn] + ([ceiling] if ceiling is not None else []))
    floor = _floor(lowest, top)
    below = sum(value < floor for value in lowest)
    if not below:
        return ""
    axes.set_ylim(floor, top + 0.06 * (top - floor))
    curves = "1 curve goes" if below == 1 else f"{below} curves go"
    return f"\n({curves} lower, to {min(lowest):,.0f})".replace("-", "−")


def _floor(values: Sequence[float], top: float | None) -> float:
    """Below what values are off the axis: minus infinity unless the lowest is far below the usual ones.

    A method that starts a thousand below all others is seen to come from below; how far is in the text.
    """
    usual, highest = float(np.median(values)), max([*values, *([top] if top is not None else [])])
    reach = highest - usual
    return usual - 0.5 * reach if min(values) < usual - 1.5 * reach and reach > 0 else -np.inf


def _columns(count: int) -> int:
    return 2 if count == 4 else min(COLUMNS, count)


def _panels(count: int, columns: int, *, height: float = PANEL[1], share_y: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels, and their axes."""
    rows = -(-count // columns)
    size = (PANEL[0] * columns + (1.5 if columns == 1 else 0.4), height * rows + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    grid = [*figure.subplots(rows, columns, squeeze=False, sharey=share_y).flat]
    for axes in grid[count:]:
        axes.remove()
    return figure, grid[:count]


def _looks(tasks: Mapping[str, Sequence[str]], references: Mapping[str, str]) -> dict[str, Style]:
    return styles((method for methods in tasks.values() for method in methods), references.values())


def _counts(tasks: Mapping[str, Sequence[str]], study: Mapping[str, Runs]) -> dict[str, str]:
    """ " (3 seeds)" for each method in the order of the legend, or " (2 to 3 seeds)" where tasks differ."""
    counts: dict[str, list[int]] = {}
    for task, methods in tasks.items():
        for method in [*methods, CEILING]:
            if method in study[task]:
                counts.setdefault(CEILING_LABEL if method == CEILING else method, []).append(len(study[task][method]))
    return {method: f" ({_seeds(seeds)})" for method, seeds in counts.items()}


def _seeds(counts: Sequence[int]) -> str:
    low, high = min(counts), max(counts)
    return f"{low} to {high} seeds" if low != high else f"{low} seed" + ("s" if low > 1 else "")


def _add_legend(figure: Figure, grid: Sequence[Axes], notes: Mapping[str, str]) -> None:
    """One legend below all panels, which it does not shrink: in the order of the notes, the ceiling last."""
    found: dict[str, Artist] = {}
    for axes in grid:
        handles, labels = axes.get_legend_handles_labels()
        found = {**dict(zip(labels, handles, strict=True)), **found}
    order = [label for label in notes if label in found and label != CEILING_LABEL]
    order += [CEILING_LABEL] if CEILING_LABEL in found else []
    if not order:
        return
    texts = [label + notes.get(label, "") for label in order]
    width, height = figure.get_size_inches()
    fits = [n for n in range(1, len(texts) + 1) if _legend_width(texts, n) <= width]
    columns = max(fits, default=1)
    figure.set_size_inches(width, height + 0.22 * -(-len(texts) // columns))
    artists = [found[label] for label in order]
    figure.legend(artists, texts, loc="outside lower center", ncols=columns, fontsize="small", frameon=False)


def _legend_width(texts: Sequence[str], columns: int) -> float:
    """Roughly, in inches: of texts that fill one column after the other."""
    return sum(0.6 + 0.067 * max(map(len, column)) for column in np.array_split(texts, columns))
