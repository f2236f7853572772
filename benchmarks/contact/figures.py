"""The pictures of the contact study: fans of trajectories as in the paper's supplement, and scores at each step.

Drawn through Matplotlib's object interface alone, as `gym_dgpmpc/runs/figures.py` does.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy import ndarray

from benchmarks import paper
from benchmarks.contact.data import find_case
from benchmarks.contact.result_files import QUANTITIES, UNITS, ContactResult
from benchmarks.contact.scores import LEVELS, coverage_name
from gym_dgpmpc.runs.figures import Paths, write_figure

Setting = tuple[str, int]
"""Kernel and number of layers."""

Curve = tuple[Float[ndarray, " H"], Float[ndarray, " H"], Float[ndarray, " H"]]
"""Mean over seeds at each step, and the ends of its interval."""

SAMPLE_COLOUR, TRUTH_COLOUR = "tab:blue", "tab:red"

KERNEL_NAMES = {**paper.KERNELS, "rbf": "RBF"}
"""Names of the kernels in tables and figures, from smooth to rough."""

KERNEL_COLOURS = dict(zip(KERNEL_NAMES, ("#0072B2", "#009E73", "#E69F00", "#D55E00"), strict=True))
"""Four of Okabe and Ito's palette, which colour-blind readers can tell apart."""


def plot_fans(results: Mapping[Setting, ContactResult], path: Paths) -> None:
    """The sampled change of the angular velocity from the mean start in blue, the true one in red.

    One row per kernel, one column per number of layers; all panels share their axes, which the truth and nine tenths
    of all samples decide.

    Args:
        results: of one case and one seed.
        path: the file; its suffix decides the format.
    """
    kernels, layers = _rows_and_columns(results)
    figure = Figure(figsize=(3.3 * len(layers) + 0.5, 2.1 * len(kernels) + 0.9), layout="constrained")
    grid = figure.subplots(len(kernels), len(layers), squeeze=False, sharex=True, sharey=True)
    for (kernel, num_layers), result in results.items():
        axes = grid[kernels.index(kernel), layers.index(num_layers)]
        steps = np.arange(1, len(result.truth) + 1)
        samples = axes.plot(steps, np.transpose(result.paths), color=SAMPLE_COLOUR, linewidth=0.6, alpha=0.45)
        samples[0].set_label(f"{len(result.paths)} sampled trajectories")
        axes.plot(steps, result.truth, color=TRUTH_COLOUR, linewidth=1.8, label="truth")
    _label_grid(grid, kernels, layers, "change of the\nangular velocity (rad/s)")
    one = next(iter(results.values()))
    truth = np.concatenate([result.truth for result in results.values()])
    low, high = np.quantile(np.concatenate([np.ravel(result.paths) for result in results.values()]), [0.05, 0.95])
    low, high = min(low, truth.min()), max(high, truth.max())
    grid[0, 0].set_ylim(low - 0.15 * (high - low), high + 0.15 * (high - low))
    case = find_case(one.key.case)
    figure.suptitle(
        f"Case {one.key.case}: {case.title}; action {case.test_action:g} from the mean start, seed {one.key.seed}",
        fontsize="medium",
    )
    _legend_below(figure, grid[0, 0])
    write_figure(figure, path, dpi=130)


def plot_scores_by_step(curves: Mapping[str, Mapping[Setting, Curve]], quantity: str, title: str, path: Paths) -> None:
    """Each score at each step of the test: mean over seeds and its interval.

    One row per score, one column per number of layers, one colour per kernel; of a coverage the wanted value is dotted.

    Args:
        curves: score -> setting -> curve.
        quantity: what is predicted, one of `QUANTITIES`.
        title: the figure's heading.
        path: the file; its suffix decides the format.
    """
    unit = UNITS[QUANTITIES.index(quantity)]
    names = {"nlpd": "negative log\npredictive density", "crps": f"CRPS ({unit})"}
    wanted = {coverage_name(level): level for level in LEVELS}
    names |= {name: f"inside the\n{level:.0%} interval" for name, level in wanted.items()}
    _, layers = _rows_and_columns({setting: None for by_setting in curves.values() for setting in by_setting})
    figure = Figure(figsize=(3.6 * len(layers) + 0.5, 1.9 * len(curves) + 0.9), layout="constrained")
    grid = figure.subplots(len(curves), len(layers), squeeze=False, sharex=True, sharey="row")
    for row, (score, by_setting) in enumerate(curves.items()):
        for (kernel, num_layers), (mean, low, high) in by_setting.items():
            axes, steps = grid[row, layers.index(num_layers)], np.arange(1, len(mean) + 1)
            axes.plot(steps, mean, color=KERNEL_COLOURS[kernel], linewidth=1.5, label=KERNEL_NAMES[kernel])
            axes.fill_between(steps, low, high, color=KERNEL_COLOURS[kernel], alpha=0.2, linewidth=0)
        for axes in grid[row] if score in wanted else ():
            axes.axhline(wanted[score], color="black", linestyle=":", linewidth=1.0)
        grid[row, 0].set_ylabel(names[score], fontsize="small")
    _label_grid(grid, [], layers, "")
    figure.suptitle(title, fontsize="medium")
    _legend_below(figure, grid[0, 0])
    write_figure(figure, path, dpi=130)


def _rows_and_columns(settings: Mapping[Setting, object]) -> tuple[list[str], list[int]]:
    """Kernels from smooth to rough, and numbers of layers."""
    kernels, layers = {kernel for kernel, _ in settings}, {num_layers for _, num_layers in settings}
    return [kernel for kernel in KERNEL_NAMES if kernel in kernels], sorted(layers)


def _label_grid(grid: ndarray, kernels: Sequence[str], layers: Sequence[int], ylabel: str) -> None:
    for column, num_layers in enumerate(layers):
        grid[0, column].set_title(f"L = {num_layers}", fontsize="medium")
        grid[-1, column].set_xlabel("step (0.02 s)", fontsize="small")
        grid[-1, column].xaxis.set_major_locator(MaxNLocator(integer=True))
    for row, kernel in enumerate(kernels):
        grid[row, 0].set_ylabel(f"{KERNEL_NAMES[kernel]}\n{ylabel}", fontsize="small")
    for axes in grid.flat:
        axes.grid(alpha=0.3)
        if not axes.lines:
            axes.text(0.5, 0.5, "no run", transform=axes.transAxes, ha="center", va="center", color="gray")


def _legend_below(figure: Figure, axes: Axes) -> None:
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize="small")
