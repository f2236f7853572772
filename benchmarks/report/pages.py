"""A folder of results as a page of tables and figures."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks import paper
from benchmarks.report import charts, scores, tables
from benchmarks.report.curves import MOST_POINTS
from benchmarks.report.markdown import number, page_and_folder
from benchmarks.report.provenance import Origins
from benchmarks.report.scores import CEILING, Runs
from benchmarks.report.statistics import CONFIDENCE, RESAMPLES
from benchmarks.result_files import ResultError
from benchmarks.tasks import TASKS
from gym_dgpmpc.checkpoints.files import replace_text
from gym_dgpmpc.formats import FORMATS
from gym_dgpmpc.runs.figures import files_of

LEGEND = (
    f"Numbers in square brackets are {CONFIDENCE:.0%} percentile bootstrap intervals over seeds, stratified by task "
    f"({RESAMPLES:,} resamples); ± is the standard deviation over seeds. An interval never leaves the range of the "
    "runs, and of 2 or 3 seeds it is that range: with 3 seeds it misses the mean of a symmetric distribution at least "
    "one time in 4, with 5 one in 16, with 10 one in 512. One seed has no interval. Random episodes count as "
    "environment steps and as time, never as returns."
)


class _Page:
    """Lines of Markdown, and the figures that they show."""

    def __init__(self, folder: Path, origins: Origins, formats: Sequence[str]) -> None:
        self.lines: list[str] = []
        self.figures: list[Path] = []
        self._folder, self.origins, self._formats = folder, origins, formats
        self._shown = folder

    def add(self, *lines: str) -> None:
        self.lines += [*lines, ""]

    def table(self, table: Sequence[str], study: Mapping[str, Runs], caption: str) -> None:
        """A table with what it shows and where its runs come from; nothing if it is empty."""
        if table:
            self.add(*table)
            self.add(f"{caption} {self.origins.caption(study)}")

    def place(self, name: str) -> list[Path]:
        """Where the next figure is to be written, the file that the page shows first."""
        paths = files_of(self._folder, re.sub(r"[^A-Za-z0-9.=_-]+", "-", name), self._formats)
        self.figures += paths
        self._shown = paths[0]
        return paths

    def show(self, what: str, study: Mapping[str, Runs], caption: str) -> None:
        """Refer to the figure that was written last."""
        self.add(f"![{what}]({self._folder.name}/{self._shown.name})")
        self.add(f"{caption} {self.origins.caption(study)}")


def write_report(
    folder: Path,
    out: Path,
    *,
    tasks: Sequence[str] = (),
    reference: str | None = None,
    thresholds: Mapping[str, float] | None = None,
    command: str | None = None,
    formats: Sequence[str] = FORMATS[:1],
) -> list[Path]:
    """Write ``out``.md, and the figures that it shows into the folder ``out``.

    Args:
        folder: of result files.
        out: with or without the suffix ".md".
        tasks: which to report, in this order; all that there are if none is named.
        reference: the method that stands for this package's own; otherwise its setting with the most runs.
        thresholds: returns that count as having learned, by task, instead of those that are known.
        command: that made the report, to be stated in it.
        formats: of the figures; the page shows the first.

    Returns:
        The files, the page first.

    Raises:
        ResultError: there are no results, or a file is damaged.
        ValueError: a task or method that is named has no runs.
        OSError: a file cannot be written.
    """
    study = _selected(scores.load_runs(folder), tasks, folder)
    unknown = sorted(set(thresholds or {}) - set(study))
    if unknown:
        raise ValueError(f"a threshold is given for {', '.join(unknown)}, of which there are no runs")
    references = scores.reference_of(study, reference)
    page_file, figures = page_and_folder(out)
    page = _Page(figures, Origins(study), formats)
    runs = sum(len(results) for of_task in study.values() for results in of_task.values())
    page.add("# Results")
    page.add(f"Made from {runs} result files in `{folder}`" + (f" by `{command}`." if command else "."))
    page.add(LEGEND)
    _add_overview(page, study, references)
    for task, of_task in study.items():
        _add_task(page, task, of_task, references.get(task), thresholds or {})
    page.add(*page.origins.lines())
    replace_text(page_file, "\n".join(page.lines).rstrip() + "\n")
    return [page_file, *page.figures]


def _selected(study: dict[str, dict], tasks: Sequence[str], folder: Path) -> dict[str, dict]:
    missing = [task for task in tasks if task not in study]
    if missing:
        raise ResultError(f"{folder} has no runs of {', '.join(missing)}; there are runs of {', '.join(study)}")
    return {task: study[task] for task in tasks} if tasks else study


def _add_overview(page: _Page, study: Mapping[str, Runs], references: Mapping[str, str]) -> None:
    """What spans tasks: the comparison's figures, the aggregates, and the paper's table."""
    drawn = {task: scores.compared(runs, references.get(task)) for task, runs in study.items()}
    drawn = {task: methods for task, methods in drawn.items() if len(methods) > 1}
    if drawn:
        of = _only(study, drawn, CEILING)
        page.add("## All methods")
        charts.plot_tasks(drawn, study, references, page.place("comparison"), "return")
        page.show("Return of each method on each task", of, _curve_caption("Return of an episode"))
        charts.plot_tasks(drawn, study, references, page.place("maximum"), "best")
        page.show("Maximum seen return of each method on each task", of, _curve_caption("The maximum seen return"))
        charts.plot_variability(drawn, study, references, page.place("variability"))
        page.show(
            "Average return by seed", of,
            f"Each run's average return over its first {paper.VARIANCE_EPISODES} episodes (small dots), their mean and "
            "standard deviation over seeds; a number with an arrow stands for a mean off the axis.",
        )  # fmt: skip
        several = {task: study[task] for task in drawn}
        page.table(
            tables.overall_improvement_table(several, references),
            _only(study, tables.compared_on_several_tasks(several, references)),
            f"Probability that a run of {scores.OURS} has a higher mean return than a run of Y at equal steps (0.5: as "
            "often as not), averaged over the tasks that both have.",
        )  # fmt: skip
        for over, lines in tables.aggregate_tables(several, references).items():
            page.table(
                lines, {task: study[task] for task in over},  # every run of a task has its part in the scale
                f"Mean return at equal steps over {', '.join(over)}, scaled per task: 0 is what random actions earn in "
                f"the first episodes of all its runs{_but_for_the_idle(over)}, 1 what the planner with the true "
                "dynamics does.",
            )  # fmt: skip
    settings = {
        task: [method for method in study[task] if scores.setting_of(method) in cells]
        for task, cells in paper.AVERAGE_RETURN.items()
        if task in study
    }
    own = _only(study, {task: methods for task, methods in settings.items() if methods})
    lines = tables.paper_table(own)
    if lines:
        page.add("## The paper's table")
        page.table(
            lines, own,
            "Average return over a run's first "
            + ", ".join(f"{paper.EPISODES[task]} ({task})" for task in own)
            + f" episodes, then mean and standard deviation over seeds; the paper has {paper.TRIALS} trials.",
        )  # fmt: skip


def _add_task(page: _Page, task: str, runs: Runs, reference: str | None, thresholds: Mapping[str, float]) -> None:
    page.add(f"## {task}")
    of = {task: runs}
    methods = scores.compared(runs, reference)
    if len(methods) < 2:  # no other method: the package's own settings against each other
        methods = [method for method in runs if method != CEILING]
    if methods:
        charts.plot_clocks(methods, task, runs, reference, page.place(f"{task}_learning"))
        page.show(
            f"Learning curves on {task}", _only(of, {task: methods}, CEILING), _curve_caption("Return of an episode")
        )
    settings = [method for method in runs if scores.setting_of(method)]
    if len(settings) > 1:
        charts.plot_settings(task, runs, page.place(f"{task}_settings"))
        page.show(
            f"Depths and kernels on {task}", _only(of, {task: settings}, CEILING),
            "Return of an episode with every depth and kernel: single runs thin, their mean thick.",
        )  # fmt: skip
    steps, at_equal_steps = scores.common_steps(runs), [*tables.at_equal_steps(runs)[0]]
    page.table(
        tables.comparison_table(runs), _only(of, {task: at_equal_steps}, CEILING),
        f"Each run's average return over the episodes that ended within {steps:,} environment steps, as many as "
        "all runs have.",
    )  # fmt: skip
    without = [m for m in runs if m not in (CEILING, *at_equal_steps)]
    if without:
        page.add(f"Not in the table, for a run without an episode by then: {', '.join(without)}.")
    page.table(
        tables.improvement_table(runs, reference),
        _only(of, {task: tables.compared_at_equal_steps(runs, reference)}),
        "Probability that a run of the first has a higher mean return than a run of Y within these steps (0.5: as "
        "often as not), and the two-sided Mann-Whitney test's p, which for 3 runs against 3 cannot be less than 0.1.",
    )  # fmt: skip
    page.table(tables.end_table(runs), of, "How the runs ended, each at its own length.")
    threshold = scores.threshold_of(task, runs, thresholds)
    if threshold is not None and methods:
        page.table(
            tables.threshold_table(runs, threshold),
            of if threshold.is_scaled else _only(of, {task: [method for method in runs if method != CEILING]}),
            f"Environment steps until an episode's return first reached {tables.number(threshold.value)} "
            f"({threshold.origin}). A run that never did is censored at its end.",
        )  # fmt: skip
    with_success = [method for method in at_equal_steps if scores.success_rates(runs[method], steps) is not None]
    page.table(
        tables.success_table(runs),
        _only(of, {task: with_success}),
        f"Share of successful episodes within {steps:,} environment steps.",
    )
    page.table(
        tables.time_table(runs), of,
        "Wall-clock time with everything that a run does, and of choosing one action; runs may share a machine.",
    )  # fmt: skip


def _only(study: Mapping[str, Runs], methods: Mapping[str, Sequence[str]], *more: str) -> dict[str, Runs]:
    """The runs of the methods of each task, and of ``more`` where they were run."""
    return {
        task: {method: study[task][method] for method in [*named, *more] if method in study[task]}
        for task, named in methods.items()
    }


def _but_for_the_idle(tasks: Sequence[str]) -> str:
    """What counts as 0 where that is not what random actions earn."""
    idle = {task: TASKS[task].idle_return for task in tasks if task in TASKS}
    said = [
        f"on {task} what doing nothing does, {number(value, 1)}" for task, value in idle.items() if value is not None
    ]
    return f" ({', '.join(said)})" if said else ""


def _curve_caption(what: str) -> str:
    return (
        f"{what}: mean over seeds, with its bootstrap interval. A curve ends where the shortest of its runs does; runs "
        f"of more than {MOST_POINTS} episodes are smoothed."
    )
