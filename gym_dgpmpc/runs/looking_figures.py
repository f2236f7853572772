"""What `LookInside` shows beside the prediction fan: how good forecasts were, how training went, what the planner did.

Drawn as in `figures.py`: through Matplotlib's object interface alone.
"""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, MaxNLocator
from numpy import ndarray

from gym_dgpmpc.runs.figures import BANDS, MAX_DIMENSIONS, MODEL_COLOUR, RANDOM_COLOUR, TRUTH_COLOUR
from gym_dgpmpc.types import Scales

LONGEST_LABEL = 34
MOST_INPUTS = 2 * MAX_DIMENSIONS
"""Inputs whose lengthscales are shown; more would not be readable."""


def score_figure(
    scores: Mapping[str, Float[ndarray, " H"]], spread: Float[ndarray, "H S"], names: Sequence[str]
) -> Figure:
    """Coverage, NLL, CRPS and the particles' spread, each over the step of a forecast.

    Args:
        scores: "coverage_50", "coverage_90", "nll" and "crps".
        spread: standard deviation of the particles, in spreads of each number.
        names: of the S numbers.
    """
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    ((coverage, likelihood), (crps, particles)) = figure.subplots(2, 2, sharex=True)
    steps = np.arange(1, len(spread) + 1)
    for level, style in ((90, "-"), (50, "--")):
        coverage.plot(steps, scores[f"coverage_{level}"], style, color=MODEL_COLOUR, label=f"inside the {level} % band")
        coverage.axhline(level / 100, color=TRUTH_COLOUR, linewidth=0.8, linestyle=":")
    coverage.set_ylim(-0.03, 1.03)
    coverage.legend(loc="lower left", fontsize="small")
    likelihood.plot(steps, scores["nll"], color=MODEL_COLOUR)
    crps.plot(steps, scores["crps"], color=MODEL_COLOUR)
    particles.plot(steps, spread[:, :MAX_DIMENSIONS], label=[_short(name) for name in names[:MAX_DIMENSIONS]])
    particles.legend(loc="upper left", fontsize="x-small")
    for axes, title in (
        (coverage, "coverage (dotted: as it should be)"),
        (likelihood, "negative log likelihood, lower is better"),
        (crps, "CRPS, lower is better"),
        (particles, "standard deviation of the particles"),
    ):
        _dress(axes, title)
    for axes in (crps, particles):
        axes.set_xlabel("steps ahead")
    figure.suptitle("forecasts of the last episode, in spreads of each number")
    return figure


def training_figure(
    losses: Sequence[tuple[int, float]], scales: Scales | None, inputs: Sequence[str], targets: Sequence[str]
) -> Figure:
    """The loss over a training's iterations; noise of each predicted number, lengthscale of each input, if known.

    Args:
        losses: (iteration, loss) of the last training; empty where the model has none.
        scales: see `ReportsScales`.
        inputs: names of the D inputs.
        targets: names of the T predicted numbers.
    """
    num_layers = len(scales.lengthscales) if scales is not None else 0
    rows = max(len(targets), min(len(inputs), MOST_INPUTS)) if num_layers else 0
    figure = Figure(figsize=(12.5 if num_layers else 6.4, max(4.0, 0.32 * rows + 1.4)), layout="constrained")
    panels = figure.subplots(1, 3 if num_layers else 1, squeeze=False)[0]
    if losses:
        panels[0].plot(*zip(*losses, strict=True), color=MODEL_COLOUR)
    else:
        panels[0].text(0.5, 0.5, "the model reports no loss", transform=panels[0].transAxes, ha="center")
    panels[0].set_xlabel("iteration")
    _dress(panels[0], "loss of the last training")
    if scales is not None:
        noise = scales.noise_std.detach().cpu().numpy()
        _bars(panels[1], [noise], targets, "noise std, of 1 without a model", [""])
        panels[1].axvline(1.0, color=TRUTH_COLOUR, linewidth=0.8, linestyle=":")
        lengthscales = [each.detach().cpu().numpy()[:, :MOST_INPUTS] for each in scales.lengthscales]
        layers = [f"layer {index + 1}" for index in range(num_layers)]
        _bars(panels[2], lengthscales, inputs[:MOST_INPUTS], "lengthscales: short ones matter", layers)
        for panel in panels[1:]:
            panel.set_xscale("log")
            for each in (panel.xaxis.set_major_formatter, panel.xaxis.set_minor_formatter):
                each(LogFormatter(labelOnlyBase=False, minor_thresholds=(1.5, 0.5)))
    return figure


def planning_figure(
    scores: Sequence[Float[ndarray, " K"]],
    actions: Float[ndarray, "T A"],
    bounds: tuple[Float[ndarray, " A"], Float[ndarray, " A"]],
    rewards: Sequence[tuple[int, float, float]],
) -> Figure:
    """Scores by iteration of one plan, a histogram of each action, and reward per step as predicted and obtained.

    Args:
        scores: of the candidates of each iteration; empty where nothing was planned.
        actions: of the episode.
        bounds: the lowest and the highest actions.
        rewards: (episode, predicted, obtained), one for each episode.
    """
    figure = Figure(figsize=(13.0, 3.8), layout="constrained")
    search, histogram, reward = figure.subplots(1, 3)
    finite = [each[np.isfinite(each)] for each in scores]
    iterations = 1 + np.arange(len(finite))
    if all(map(len, finite)) and finite:
        for probability, alpha in BANDS.items():
            tails = np.array([np.quantile(each, [(1 - probability) / 2, (1 + probability) / 2]) for each in finite])
            label = f"{probability:.0%} of the candidates"
            search.fill_between(iterations, *tails.T, color=MODEL_COLOUR, alpha=alpha, linewidth=0, label=label)
        search.plot(iterations, [each.max() for each in finite], ".-", color=MODEL_COLOUR, label="best")
        search.legend(loc="lower right", fontsize="x-small")
    _dress(search, "score of candidates, one plan", "iteration")
    search.xaxis.set_major_locator(MaxNLocator(integer=True))
    share = (actions - bounds[0]) / np.maximum(bounds[1] - bounds[0], 1e-12)
    shown = share.T[:MAX_DIMENSIONS]
    kind: Literal["bar", "step"] = "bar" if len(shown) == 1 else "step"
    names = [f"action {index}" for index in range(len(shown))]
    histogram.hist(list(shown), bins=np.linspace(0, 1, 21).tolist(), histtype=kind, label=names)
    histogram.legend(loc="upper center", fontsize="x-small")
    _dress(histogram, "actions of the episode", "lowest (0) to highest (1)")
    histogram.set_ylabel("steps")
    if rewards:
        episodes, predicted, obtained = zip(*rewards, strict=True)
        reward.plot(episodes, predicted, "o--", color=MODEL_COLOUR, label="predicted by the plans")
        reward.plot(episodes, obtained, "o-", color=TRUTH_COLOUR, label="obtained")
        reward.legend(loc="best", fontsize="x-small")
    _dress(reward, "reward per step", "episode")
    reward.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _bars(
    axes: Axes, groups: Sequence[Float[ndarray, "C n"]], names: Sequence[str], title: str, labels: Sequence[str]
) -> None:
    """For each name a bar of each group, the geometric mean over chains, and a dot for every chain."""
    height = 0.8 / len(groups)
    for index, (values, label) in enumerate(zip(groups, labels, strict=True)):
        places = np.arange(len(names)) + (index - (len(groups) - 1) / 2) * height
        axes.barh(places, np.exp(np.log(values).mean(0)), 0.9 * height, color=f"C{index}", alpha=0.6, label=label)
        axes.plot(values.T, places, ".", color=RANDOM_COLOUR, markersize=3)
    axes.set_yticks(np.arange(len(names)), [textwrap.fill(name, 26) for name in names], fontsize="small")
    axes.invert_yaxis()
    if len(groups) > 1:
        axes.legend(loc="best", fontsize="x-small")
    _dress(axes, title)


def _dress(axes: Axes, title: str, xlabel: str = "") -> None:
    axes.set_title(title, fontsize="medium")
    axes.grid(alpha=0.3)
    if xlabel:
        axes.set_xlabel(xlabel)


def _short(name: str) -> str:
    return textwrap.shorten(name, LONGEST_LABEL, placeholder="…")
