"""Tables and figures of the contact study, and what depth and rougher kernels change, from the files of its runs.

All intervals are 95 % percentile bootstrap intervals over seeds. Settings are compared seed by seed: the runs of a seed
were trained on the same sequences and tested on the same trajectories.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.contact.data import CASES
from benchmarks.contact.figures import KERNEL_NAMES, Curve, Setting, plot_fans, plot_scores_by_step
from benchmarks.contact.result_files import QUANTITIES, QUANTITY, UNITS, ContactResult, read_contact_results
from benchmarks.contact.scores import LEVELS, SCORES, coverage_name
from benchmarks.report import markdown, statistics
from benchmarks.report.markdown import page_and_folder, table
from benchmarks.report.provenance import SECTION, pairs
from benchmarks.report.statistics import Estimate
from gym_dgpmpc.checkpoints.files import replace_text
from gym_dgpmpc.formats import FORMATS
from gym_dgpmpc.runs.figures import files_of

COMMAND = "dgpmpc bench contact"
"""What makes all runs of the study."""

SMOOTHEST, SHALLOWEST = "rbf", 1
"""What rougher kernels and deeper models are compared with."""

PROPER = {"nlpd": "NLPD", "crps": "CRPS"}

BySeed = Mapping[int, ContactResult]
Study = Mapping[Setting, BySeed]
"""The runs of one case."""


def report_contact_study(folder: Path, out: Path, formats: Sequence[str] = FORMATS[:1]) -> list[Path]:
    """Write the report ``out``.md, its figures into the folder ``out``, and return all files, the page first.

    Args:
        folder: of the study's results; not all of its runs need be there.
        out: with or without the suffix ".md".
        formats: of the figures; the page shows the first.

    Raises:
        ResultError: a file is damaged, there are no files, or they belong to several studies.
    """
    results = read_contact_results(folder)
    page, figures = page_and_folder(out)
    figures.mkdir(parents=True, exist_ok=True)
    lines, written = _head(results), []
    for case in sorted({result.key.case for result in results}):
        study = _study(results, case)
        fans, steps = (files_of(figures, f"{name}_{case}", formats) for name in ("fans", "steps"))
        seed = min(seed for by_seed in study.values() for seed in by_seed)
        plot_fans({setting: by_seed[seed] for setting, by_seed in study.items() if seed in by_seed}, fans)
        curves = {score: {setting: _curve(by_seed, score) for setting, by_seed in study.items()} for score in SCORES}
        title = f"Case {case}: {CASES[case].title}; {QUANTITY} predicted open-loop"
        plot_scores_by_step(curves, QUANTITY, title, steps)
        written += [*fans, *steps]
        lines += _section(case, study, f"{figures.name}/{fans[0].name}", f"{figures.name}/{steps[0].name}")
    replace_text(page, "\n".join([*lines, *_provenance(results)]) + "\n")
    return [page, *written]


def paired_differences(
    study: Study, pairs: Sequence[tuple[Setting, Setting]], score: str, phase: str | None = None
) -> Float[ndarray, " n"]:
    """The mean over ``pairs`` of the first's score less the second's, for each seed that has all of their runs.

    Args:
        study: the runs of one case.
        pairs: settings to compare.
        score: of `QUANTITY`, one of `SCORES`.
        phase: the steps that count, one of `PHASES`, or None for all. A seed whose test has none is left out.
    """

    def of(setting: Setting, seed: int) -> float:
        return study[setting][seed].mean(QUANTITY, score, phase)

    seeds = set.intersection(*(set(study.get(setting, ())) for pair in pairs for setting in pair))
    differences = [np.mean([of(new, seed) - of(old, seed) for new, old in pairs]) for seed in sorted(seeds)]
    return np.array([d for d in differences if np.isfinite(d)], dtype=np.float64)


def estimate(values: Float[ndarray, " n"]) -> Estimate:
    """The mean of one number per seed, with its bootstrap interval; NaN of none."""
    return statistics.mean([values]) if len(values) else Estimate(float("nan"))


def _written(value: Estimate) -> str:
    """An estimate with three decimals, since a CRPS is a few hundredths."""
    return markdown.estimate(value, decimals=3)


def _study(results: Sequence[ContactResult], case: str) -> Study:
    """Settings from smooth to rough kernels, then by depth."""
    study: dict[Setting, dict[int, ContactResult]] = {}
    rank = list(KERNEL_NAMES).index
    chosen = [result for result in results if result.key.case == case]
    for result in sorted(chosen, key=lambda r: (rank(r.key.kernel), r.key.num_layers, r.key.seed)):
        study.setdefault((result.key.kernel, result.key.num_layers), {})[result.key.seed] = result
    return study


def _curve(by_seed: BySeed, score: str) -> Curve:
    values = np.stack([result.by_step(QUANTITY, score) for result in by_seed.values()])
    mean = values.mean(axis=0)
    low, high = statistics.mean_band(values) or (mean, mean)
    return mean, low, high


def _over_seeds(by_seed: BySeed, quantity: str, score: str, phase: str | None = None) -> Estimate:
    values = np.array([result.mean(quantity, score, phase) for result in by_seed.values()])
    return estimate(values[np.isfinite(values)])


def _head(results: Sequence[ContactResult]) -> list[str]:
    settings = results[0].settings
    return [
        "# Contact study: results",
        "",
        f"Mean over seeds [95 % bootstrap interval over seeds] of the scores of {settings.num_particles} open-loop "
        f"trajectories from each of {settings.num_starts} starts: negative log predictive density (NLPD), continuous "
        "ranked probability score (CRPS), and the share of true values inside the central 50, 90 and 95 % intervals.",
        "NLPD and CRPS: lower is better. What the cases, scores and figures are is told in the documentation, "
        "`docs/contact_study.md`.",
        "",
    ]


def _section(case: str, study: Study, fans: str, steps: str) -> list[str]:
    any_run = next(iter(next(iter(study.values())).values()))
    seen = [run for by_seed in study.values() for run in by_seed.values()]
    in_training, in_test = (
        float(np.mean([getattr(run, name) for run in seen])) for name in ("training_contact", "test_contact")
    )
    has_contact = any(sum(run.counts["after"]) for run in seen)
    phases = [(None, "all steps")] + ([("after", "steps from the contact on")] if has_contact else [])
    lines = [
        f"## Case {case}: {CASES[case].title}",
        "",
        f"The cart goes beyond the end of the rail in {in_training:.0%} of the training sequences and {in_test:.0%} of "
        f"the {len(any_run.truth)}-step tests.",
        "",
        f"![Trajectories]({fans})",
        "",
        f"![Scores by step]({steps})",
        "",
    ]
    for phase, text in phases:
        lines += [f"### Scores of the {QUANTITY}, {text}", "", *_scores_table(study, phase), ""]
        lines += [f"### What depth changes, {text}", "", *_depth_table(study, phase), ""]
        lines += [f"### What the kernel changes, {text}", "", *_kernel_table(study, phase), ""]
    return [*lines, "### The other quantities, all steps", "", *_quantities_table(study), ""]


def _scores_table(study: Study, phase: str | None) -> list[str]:
    names = [*PROPER.values(), *(f"inside {level:.0%}" for level in LEVELS)]
    rows = []
    for (kernel, num_layers), by_seed in study.items():
        means = [_written(_over_seeds(by_seed, QUANTITY, score, phase)) for score in SCORES]
        rows.append([KERNEL_NAMES[kernel], str(num_layers), str(len(by_seed)), *means])
    return table(["kernel", "L", "seeds", *names], rows)


def _depth_table(study: Study, phase: str | None) -> list[str]:
    """Each deeper model less the one of one layer, for each kernel and for all of them together."""
    kernels = list(dict.fromkeys(kernel for kernel, _ in study))
    rows = []
    for num_layers in sorted({num_layers for _, num_layers in study} - {SHALLOWEST}):
        for group in _each_and_all(kernels):
            pairs = [((kernel, num_layers), (kernel, SHALLOWEST)) for kernel in group]
            name = KERNEL_NAMES[group[0]] if len(group) == 1 else "all kernels"
            rows += _difference_rows(study, pairs, phase, f"L = {num_layers} less L = {SHALLOWEST}", name)
    return table(["difference", "kernel", "seeds", *_DIFFERENCE_HEADER], rows)


def _kernel_table(study: Study, phase: str | None) -> list[str]:
    """Each rougher kernel less the RBF, for each depth and for all of them together."""
    depths = sorted({num_layers for _, num_layers in study})
    rows = []
    for kernel in dict.fromkeys(kernel for kernel, _ in study if kernel != SMOOTHEST):
        for group in _each_and_all(depths):
            pairs = [((kernel, num_layers), (SMOOTHEST, num_layers)) for num_layers in group]
            name = str(group[0]) if len(group) == 1 else "all"
            rows += _difference_rows(
                study, pairs, phase, f"{KERNEL_NAMES[kernel]} less {KERNEL_NAMES[SMOOTHEST]}", name
            )
    return table(["difference", "L", "seeds", *_DIFFERENCE_HEADER], rows)


def _each_and_all(values: list[Any]) -> list[list[Any]]:
    """Groups of one, and the group of all if that is another."""
    return [[value] for value in values] + ([values] if len(values) > 1 else [])


_DIFFERENCE_HEADER = [column for name in PROPER.values() for column in (name, "")]


def _difference_rows(
    study: Study, pairs: Sequence[tuple[Setting, Setting]], phase: str | None, *names: str
) -> list[list[str]]:
    """A row with the number of seeds and, for each score, the difference and what it says; none without a seed."""
    values = [paired_differences(study, pairs, score, phase) for score in PROPER]
    if not len(values[0]):
        return []
    found = [estimate(differences) for differences in values]
    return [[*names, str(len(values[0])), *(text for one in found for text in (_written(one), verdict(one)))]]


def verdict(difference: Estimate) -> str:
    """What a difference of a score, of which less is better, says: its interval has to leave out zero."""
    if difference.low is None or difference.high is None:
        return "too few seeds"
    return "better" if difference.high < 0 else "worse" if difference.low > 0 else "undecided"


def _quantities_table(study: Study) -> list[str]:
    others = [quantity for quantity in QUANTITIES if quantity != QUANTITY]
    header = ["kernel", "L"]
    for quantity in others:
        unit = UNITS[QUANTITIES.index(quantity)]
        header += [f"{quantity}: NLPD", f"CRPS ({unit})", "inside 90%"]
    rows = []
    for (kernel, num_layers), by_seed in study.items():
        cells = [
            _written(Estimate(_over_seeds(by_seed, quantity, score).value))
            for quantity in others
            for score in (*PROPER, coverage_name(0.9))
        ]
        rows.append([KERNEL_NAMES[kernel], str(num_layers), *cells])
    return table(header, rows)


def _provenance(results: Sequence[ContactResult]) -> list[str]:
    """Settings, commands, revisions and versions, each different one once."""

    def different(values: Sequence[str]) -> str:
        return "; ".join(f"`{value}`" for value in dict.fromkeys(values))

    facts = [result.facts for result in results]
    fits = {depth: [r.fit_seconds for r in results if r.key.num_layers == depth] for depth in _depths(results)}
    times = ", ".join(f"{np.median(seconds):.0f} s at L = {depth}" for depth, seconds in fits.items())
    seeds = ", ".join(map(str, sorted({result.key.seed for result in results})))
    return [
        f"## {SECTION}",
        "",
        f"- {len(results)} runs, seeds {seeds}; the fans show the first of them",
        f"- settings: {pairs(vars(results[0].settings).items())}",
        f"- median CPU time of a training: {times}",
        f"- command: `{COMMAND}`",
        f"- revisions: {different([str(fact['revision']) for fact in facts])}",
        f"- versions: {different([pairs(fact['versions'].items()) for fact in facts])}",
        f"- machines: {different([pairs(fact['machine'].items()) for fact in facts])}",
    ]


def _depths(results: Sequence[ContactResult]) -> list[int]:
    return sorted({result.key.num_layers for result in results})
