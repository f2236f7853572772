"""Tables of what `python -m benchmarks.calibration` measured: all scores, and the deep GP beside its rivals."""

from collections import defaultdict
from collections.abc import Iterable
from statistics import fmean, stdev
from typing import Any

from benchmarks.report import markdown

SCORES = ("coverage_50", "coverage_90", "coverage_95", "nll", "crps", "rmse", "z2")
POINT = ("task", "episodes", "test", "horizon")
"""What is tested: after how many episodes of a task, on the policy or off it, how many steps ahead."""

OURS = "DGP L=2"
RIVALS = ("PETS, held-out optimum", "sparse GP with noise")
GOOD_COVERAGE, GOOD_Z2 = (0.85, 0.95), (0.8, 1.3)
"""Of 90 % intervals, and of the mean squared error over the variance."""

Row = dict[str, Any]


def all_scores(rows: Iterable[Row]) -> list[str]:
    """Means over seeds, with the standard error of the likelihood's."""
    cells = []
    for key, group in _grouped(rows, (*POINT, "model")).items():
        shown = [f"{_mean(group, score):.{3 if score in ('crps', 'rmse') else 2}f}" for score in SCORES]
        shown[SCORES.index("nll")] = with_error([row["nll"] for row in group])
        cells.append([*map(str, key), str(len(group)), *shown])
    return markdown.table(["task", "episodes", "test", "steps", "model", "seeds", *SCORES], cells)


def beside_rivals(rows: Iterable[Row]) -> list[str]:
    """The deep GP's intervals, and by how much its negative log likelihood is below (if negative) that of each rival.

    Differences are of the same seeds, with the standard error of their mean; a bold one lies two of them below zero.
    """
    points = _grouped([row for row in rows if row["model"] in (OURS, *RIVALS)], POINT)
    cells, counts = [], dict.fromkeys(("points", "coverage", "z2", *RIVALS), 0)
    for key, group in points.items():
        by_model = {name: {row["seed"]: row for row in group if row["model"] == name} for name in (OURS, *RIVALS)}
        ours = list(by_model[OURS].values())
        if not ours:
            continue
        coverage, z2 = _mean(ours, "coverage_90"), _mean(ours, "z2")
        counts["points"] += 1
        counts["coverage"] += GOOD_COVERAGE[0] <= coverage <= GOOD_COVERAGE[1]
        counts["z2"] += GOOD_Z2[0] <= z2 <= GOOD_Z2[1]
        shown = [str(len(ours)), f"{100 * coverage:.0f}", f"{z2:.2f}", with_error([row["nll"] for row in ours])]
        for rival in RIVALS:
            common = by_model[OURS].keys() & by_model[rival].keys()
            differences = [by_model[OURS][seed]["nll"] - by_model[rival][seed]["nll"] for seed in sorted(common)]
            shown.append(_difference(differences))
            counts[rival] += bool(differences) and fmean(differences) < 0.0
        cells.append([*map(str, key), *shown])
    header = ["task", "episodes", "test", "steps", "seeds", "% inside 90", "z²", "NLL", *(f"less {r}" for r in RIVALS)]
    low, high = (f"{100 * bound:.0f}" for bound in GOOD_COVERAGE)
    below = ", of ".join(f"{rival} at {counts[rival]}" for rival in RIVALS)
    summary = (
        f"{OURS}: of {counts['points']} points 90 % intervals hold {low} to {high} % at {counts['coverage']}, "
        f"mean z² is {GOOD_Z2[0]} to {GOOD_Z2[1]} at {counts['z2']}; its mean NLL is below that of {below}."
    )
    return [summary, "", *markdown.table(header, cells)]


def _grouped(rows: Iterable[Row], keys: tuple[str, ...]) -> dict[tuple[Any, ...], list[Row]]:
    groups: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in rows:
        groups[tuple(row[key] for key in keys)].append(row)
    return groups


def _mean(rows: Iterable[Row], score: str) -> float:
    return fmean(row[score] for row in rows)


def with_error(values: list[float]) -> str:
    """Their mean, and its standard error."""
    error = f" ± {stdev(values) / len(values) ** 0.5:.2f}" if len(values) > 1 else ""
    return f"{fmean(values):.2f}{error}"


def _difference(values: list[float]) -> str:
    if not values:
        return markdown.NOTHING
    is_clear = len(values) > 1 and fmean(values) < -2.0 * stdev(values) / len(values) ** 0.5
    return f"**{with_error(values)}**" if is_clear else with_error(values)
