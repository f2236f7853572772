"""The tables of a report, each as lines of Markdown; docs/report.md explains the columns."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks import paper
from benchmarks.report import scores
from benchmarks.report.markdown import NOTHING, estimate, number, table
from benchmarks.report.scores import CEILING, Runs, Threshold
from benchmarks.report.statistics import (
    difference_p_value,
    iqm,
    mean,
    probability_of_improvement,
    time_to_reach,
)
from benchmarks.result_files import RunResult

LAST = 5
"""Episodes at the end of a run that say how it ended."""


def paper_table(study: Mapping[str, Runs]) -> list[str]:
    """Average return of each kernel and depth beside the paper's, for the tasks of the paper that have runs."""
    rows = []
    for task in [task for task in paper.AVERAGE_RETURN if task in study]:
        found = {scores.setting_of(method): results for method, results in study[task].items()}
        for kernel, name in paper.KERNELS.items():
            cells = []
            for layers in paper.LAYERS:
                published = paper.AVERAGE_RETURN[task][kernel, layers]
                results = found.get((kernel, layers))
                cells.append(_own_average(results, paper.EPISODES[task]) if results else NOTHING)
                cells.append(f"{published.mean:g} ± {published.deviation:g}".replace("-", "−"))
            if any(cells[index] != NOTHING for index in range(0, len(cells), 2)):
                rows.append([task, name, *cells])
    header = [text for layers in paper.LAYERS for text in (f"L = {layers}", f"the paper, L = {layers}")]
    return table(["task", "kernel", *header], rows) if rows else []


def comparison_table(runs: Runs) -> list[str]:
    """All methods of a task at the same number of environment steps, the best mean first; the ceiling last."""
    steps = scores.common_steps(runs)
    kept, returns = at_equal_steps(runs)
    rows = []
    for method in [method for method in scores.ranked(runs) if method in kept]:
        average, best = returns[method], scores.best_returns(kept[method], steps)
        rows.append([method, *_returns(kept[method], steps, average, best)])
    if CEILING in runs:
        average, best = scores.mean_returns(runs[CEILING]), scores.best_returns(runs[CEILING])
        rows.append([f"*{CEILING}* (all its episodes)", *_returns(runs[CEILING], np.inf, average, best)])
    header = ["method", "seeds", "episodes", "mean", "IQM", "sd over seeds", "lowest … highest seed", "maximum seen"]
    return table(header, rows)


def end_table(runs: Runs) -> list[str]:
    """What each method's runs came to at their own ends, however long they are."""
    rows = []
    for method in scores.ranked(runs):
        results = runs[method]
        last = [np.mean([e.episode_return for e in result.counted[-LAST:]]) for result in results]
        lengths = [result.episodes[-1].total_steps for result in results]
        best = mean([scores.best_returns(results)])
        rows.append([method, _span(lengths), estimate(mean([np.array(last)])), estimate(best)])
    return table(["method", "environment steps", f"mean of the last {LAST} episodes", "maximum seen"], rows)


def improvement_table(runs: Runs, reference: str | None) -> list[str]:
    """How probably a run of the reference beats one of each other method on one task at equal steps."""
    _, returns = at_equal_steps(runs)
    if reference not in returns:
        return []
    own, rows = returns[reference], []
    for other in compared_at_equal_steps(runs, reference)[1:]:
        value = estimate(probability_of_improvement([own], [returns[other]]))
        p = number(difference_p_value(own, returns[other]))
        rows.append([other, value, f"{len(own)} × {len(returns[other])}", p])
    return table(["Y", f"P({reference} > Y)", "pairs of runs", "p of no difference"], rows) if rows else []


def compared_at_equal_steps(runs: Runs, reference: str | None) -> list[str]:
    """The reference and the methods that it can be compared with at equal steps; none without the reference."""
    _, returns = at_equal_steps(runs)
    return scores.compared(returns, reference) if reference in returns else []


def compared_on_several_tasks(study: Mapping[str, Runs], references: Mapping[str, str]) -> dict[str, list[str]]:
    """The same by task, of the methods that more than one task has; tasks without one are left out."""
    compared = {task: compared_at_equal_steps(runs, references.get(task)) for task, runs in study.items()}
    tasks_of = Counter(other for methods in compared.values() for other in methods[1:])
    kept = {
        task: [*methods[:1], *(other for other in methods[1:] if tasks_of[other] > 1)]
        for task, methods in compared.items()
    }
    return {task: methods for task, methods in kept.items() if len(methods) > 1}


def overall_improvement_table(study: Mapping[str, Runs], references: Mapping[str, str]) -> list[str]:
    """The same as `improvement_table`, averaged over the tasks that both methods have, where these are several."""
    pairs: dict[str, list[tuple[ndarray, ndarray]]] = {}
    for task, (reference, *others) in compared_on_several_tasks(study, references).items():
        _, returns = at_equal_steps(study[task])
        for other in others:
            pairs.setdefault(other, []).append((returns[reference], returns[other]))
    rows = []
    for other in scores.compared(pairs, None):
        own_samples, other_samples = zip(*pairs[other], strict=True)
        value = estimate(probability_of_improvement(own_samples, other_samples))
        rows.append([other, value, str(len(pairs[other]))])
    return table(["Y", f"P({scores.OURS} > Y)", "tasks"], rows) if rows else []


def aggregate_tables(study: Mapping[str, Runs], reference: Mapping[str, str]) -> dict[tuple[str, ...], list[str]]:
    """Returns on the scale of `scores.scale_of` over every set of tasks that some method has.

    Each table is over one set of tasks and holds the methods that have all of them; a reference that differs between
    tasks counts as one method.
    """
    by_method: dict[str, dict[str, Float[ndarray, " n"]]] = {}
    for task, runs in study.items():
        scale = scores.scale_of(task, runs)
        if scale is None:
            continue
        _, returns = at_equal_steps(runs)
        for method, values in returns.items():
            name = scores.OURS if method == reference.get(task) else method
            if name == scores.OURS or not method.startswith(scores.OURS):
                by_method.setdefault(name, {})[task] = (values - scale[0]) / (scale[1] - scale[0])
    sets = {tuple(scaled) for scaled in by_method.values() if len(scaled) > 1}
    tables = {}
    for tasks in sorted(sets, key=lambda tasks: (-len(tasks), tasks)):
        rows = []
        for method, scaled in by_method.items():
            if set(tasks) <= set(scaled):
                strata = [scaled[task] for task in tasks]
                seeds = ", ".join(str(len(sample)) for sample in strata)
                rows.append((mean(strata), [method, seeds, estimate(mean(strata)), estimate(iqm(strata))]))
        rows.sort(key=lambda row: -row[0].value)
        tables[tasks] = table(["method", "seeds by task", "mean", "IQM"], [row for _, row in rows])
    return tables


def threshold_table(runs: Runs, threshold: Threshold) -> list[str]:
    """Environment steps until an episode first reached a return; runs that never did are censored where they end."""
    rows = []
    for method in scores.ranked(runs):
        results = runs[method]
        if method == CEILING:
            continue
        times, reached = zip(*(scores.steps_until(result, threshold.value) for result in results), strict=True)
        passage = time_to_reach(times, reached)
        arrived = [time for time, done in zip(times, reached, strict=True) if done]
        median = f"more than {passage.longest:,.0f}" if passage.median is None else f"{passage.median:,.0f}"
        rows.append([method, f"{passage.reached} of {passage.runs}", median, _span(arrived) if arrived else NOTHING])
    return table(["method", "reached", "median (Kaplan–Meier)", "those that reached it"], rows)


def success_table(runs: Runs) -> list[str]:
    """Share of successful episodes at equal steps, and of the last ones; empty where episodes do not say."""
    steps = scores.common_steps(runs)
    rows = []
    for method in [method for method in scores.ranked(runs) if method in at_equal_steps(runs)[0]]:
        results = runs[method]
        rates = scores.success_rates(results, steps)
        if rates is None:
            continue
        last = [np.mean([bool(e.success) for e in scores.until(result, steps)[-LAST:]]) for result in results]
        rows.append([method, str(len(results)), estimate(mean([rates])), estimate(mean([np.array(last)]))])
    return table(["method", "seeds", "all episodes", f"last {LAST} episodes"], rows) if rows else []


def time_table(runs: Runs) -> list[str]:
    """What whole runs cost in time and training, and what choosing an action does."""
    rows = []
    for method in scores.ranked(runs):
        results = runs[method]
        minutes = [sum(episode.seconds for episode in result.episodes) / 60 for result in results]
        steps = sum(result.episodes[-1].total_steps for result in results)
        measured = [r.milliseconds_per_action for r in results if r.milliseconds_per_action is not None]
        per_step = 60e3 * sum(minutes) / steps
        action = _mean_and_range(measured) if measured else "not measured"
        rows.append([method, str(len(results)), _mean_and_range(minutes), _total(results, "cpu_seconds", 1 / 60),
                     _total(results, "training_iterations"), number(per_step), action])  # fmt: skip
    header = ["method", "seeds", "minutes a run (range)", "CPU minutes (range)", "training iterations (range)",
              "ms a step, training included", "ms an action (range)"]  # fmt: skip
    return table(header, rows)


def _total(results: Sequence[RunResult], name: str, unit: float = 1.0) -> str:
    """A cost of whole runs, of those whose episodes all say it."""
    totals = []
    for result in results:
        costs = [getattr(episode, name) for episode in result.episodes]
        if None not in costs:
            totals.append(unit * sum(costs))
    return _mean_and_range(totals) if totals else "not measured"


def at_equal_steps(runs: Runs) -> tuple[dict[str, Sequence[RunResult]], dict[str, Float[ndarray, " _"]]]:
    """The methods whose runs all have an episode by the common number of steps, and their means; no ceiling."""
    steps = scores.common_steps(runs)
    returns = {method: scores.mean_returns(results, steps) for method, results in runs.items() if method != CEILING}
    returns = {method: values for method, values in returns.items() if not np.isnan(values).any()}
    return {method: runs[method] for method in returns}, returns


def deviation(values: Float[ndarray, " n"]) -> float | None:
    """The sample's standard deviation; None of one number."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _own_average(results: Sequence[RunResult], episodes: int) -> str:
    values = scores.first_returns(results, episodes)
    played = min(len(result.counted) for result in results)
    short = f", {played} of {episodes} episodes" if played < episodes else ""
    seeds = f"{len(values)} seed" + ("s" if len(values) > 1 else "")
    spread = deviation(values)
    return (
        f"**{number(values.mean())}**" + (f" ± {number(spread)}" if spread is not None else "") + f" ({seeds}{short})"
    )


def _returns(
    results: Sequence[RunResult], steps: float, average: Float[ndarray, " n"], best: Float[ndarray, " n"]
) -> list[str]:
    played = [len(scores.until(result, steps)) for result in results]
    return [
        str(len(results)), _span(played), estimate(mean([average])), estimate(iqm([average])),
        number(deviation(average)), f"{number(average.min())} … {number(average.max())}", estimate(mean([best])),
    ]  # fmt: skip


def _span(values: Sequence[int]) -> str:
    return f"{min(values):,}" if min(values) == max(values) else f"{min(values):,} to {max(values):,}"


def _mean_and_range(values: Sequence[float]) -> str:
    mean_value = number(float(np.mean(values)))
    return f"{mean_value} ({number(min(values))} to {number(max(values))})" if len(values) > 1 else mean_value
