"""The commands `dgpmpc bench SUITE` and `dgpmpc report DIR`, which `gym_dgpmpc.cli` adds where the benchmarks are.

What is slow to import is imported when a command runs, so that `dgpmpc --help` answers at once; so is what comes from
`gym_dgpmpc.cli`, which imports this module.
"""

import math
import shlex
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from gym_dgpmpc.formats import FORMATS, FigureFormat

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.executors import Executor
    from benchmarks.jobs import Folders, Job

EXIT_FAILURES = 1
SELECTION = "Which of its runs"
PLACE = "Where"


def bench(
    suite: Annotated[
        str,
        typer.Argument(
            metavar="SUITE", help="table, comparison, fair, variance, unmodified, long-cheetah, stock or contact."
        ),
    ],
    show: Annotated[
        bool, typer.Option("--list", help="Only show what is finished, what is left and how long it may take.")
    ] = False,
    seeds: Annotated[
        str | None,
        typer.Option(
            help="Seeds and ranges of seeds, such as 0,1,5-9.",
            show_default="those of the suite",
            rich_help_panel=SELECTION,
        ),
    ] = None,
    tasks: Annotated[
        str | None,
        typer.Option(help="Names or patterns, separated by commas.", show_default="all", rich_help_panel=SELECTION),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help='Names or patterns, such as "DGP-MPC L=2*,SAC".', show_default="all", rich_help_panel=SELECTION
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Planned episodes per run, not counting random ones.",
            show_default="the suite's",
            rich_help_panel=SELECTION,
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=1, help="Runs at the same time, each on one thread.", rich_help_panel=PLACE)
    ] = 1,
    cluster: Annotated[
        str | None,
        typer.Option(
            help="ray or dask: a new cluster of --jobs workers on this machine (or the Ray cluster at RAY_ADDRESS); "
            "ray://HOST:PORT or tcp://HOST:PORT: an existing Ray or Dask cluster.",
            show_default="processes of this machine",
            rich_help_panel=PLACE,
        ),
    ] = None,
    results: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the result files, one per run.",
            show_default="benchmarks/results/runs of the clone; for the suite contact, benchmarks/results/contact",
            rich_help_panel=PLACE,
        ),
    ] = None,
    work: Annotated[
        Path | None,
        typer.Option(
            help="Folder in which unfinished runs keep their state.",
            show_default="runs/bench of the clone",
            rich_help_panel=PLACE,
        ),
    ] = None,
) -> None:
    """Run a benchmark suite, or what is left of it: one result file per method, task and seed.

    Runs that already have a result are skipped, so the same command continues after an interruption.
    """
    from benchmarks import WORK
    from benchmarks.executors import executor
    from benchmarks.jobs import Folders, unfinished
    from benchmarks.listing import summary, survey
    from benchmarks.suites import Selection, find_suite
    from gym_dgpmpc.cli.common import one_line_errors

    with one_line_errors(ValueError, OSError):
        selection = Selection(_numbers(seeds), _names(tasks), _names(methods), episodes)
        chosen = find_suite(suite)
        wanted = chosen.jobs(selection)
        folders = Folders((results or chosen.results).resolve(), (work or WORK).resolve())
        lines = survey(wanted, folders)
        if show:
            for line in lines:
                typer.echo(f"{line.job.name}: {line.state}")
        typer.echo(summary(lines))
        if show:
            return
        execute_all = executor(jobs, cluster)
        left = unfinished(wanted, folders.results)
    _report_failures(_perform(left, folders, execute_all), folders)


def _perform(jobs: "Sequence[Job]", folders: "Folders", execute_all: "Executor") -> "list[Job]":
    """Execute the jobs, print a line as each ends, and return those that failed."""
    from benchmarks.jobs import keep
    from gym_dgpmpc.cli.common import EXIT_INTERRUPTED, EXIT_TERMINATED, one_line_errors

    def terminate(number: int, frame: FrameType | None) -> None:
        sys.exit(EXIT_TERMINATED)

    failures, before = [], signal.signal(signal.SIGTERM, terminate)
    try:
        with one_line_errors(OSError):
            for number, (job, outcome) in enumerate(execute_all(jobs, folders), start=1):
                keep(job, outcome, folders.results)
                if outcome.content is None:
                    failures.append(job)
                typer.echo(f"{number} of {len(jobs)} | {job.name}: {outcome.message}")
    except (KeyboardInterrupt, SystemExit) as stop:
        typer.echo("\ninterrupted; the same command continues")
        raise typer.Exit(EXIT_TERMINATED if isinstance(stop, SystemExit) else EXIT_INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGTERM, before)
    return failures


def _report_failures(failures: "Sequence[Job]", folders: "Folders") -> None:
    from benchmarks.jobs import log_of

    if not failures:
        return
    typer.echo(f"\n{len(failures)} failed:", err=True)
    for job in failures:
        typer.echo(f"  {job.name}: see {log_of(job, folders.results)}", err=True)
    raise typer.Exit(EXIT_FAILURES)


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",")]


def _numbers(text: str | None) -> list[int] | None:
    """Numbers and ranges separated by commas, each number once.

    Raises:
        ValueError: the text is something else.
    """
    if text is None:
        return None
    numbers: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        last = last if dash else first
        if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
            raise ValueError(f"expected numbers and ranges such as 0,1,5-9 as seeds, got {text!r}")
        numbers.extend(range(int(first), int(last) + 1))
    return list(dict.fromkeys(numbers))


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of result files, as `dgpmpc bench` writes.")],
    out: Annotated[Path, typer.Option(metavar="OUT", help="Write OUT.md, and its figures into the folder OUT.")] = Path(
        "report"
    ),
    task: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TASK", help="Report this task only; repeat the option for more.", show_default="all there are"
        ),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="The setting of DGP-MPC that the other methods are compared with.",
            show_default="the one with the most tasks and runs",
        ),
    ] = None,
    threshold: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TASK=RETURN",
            help="The return that counts as having learned a task; repeat the option for more tasks.",
            show_default="the paper's best, or Gymnasium's",
        ),
    ] = None,
    formats: Annotated[
        list[FigureFormat] | None,
        typer.Option(
            "--format",
            help="Format of the figures; may be given several times, and the page shows the first.",
            show_default="png",
        ),
    ] = None,
) -> None:
    """Make tables and figures from a folder of result files: of runs, or of the contact study."""
    from benchmarks.contact.report import report_contact_study
    from benchmarks.contact.result_files import holds_contact_study
    from benchmarks.report.pages import write_report
    from gym_dgpmpc.cli.common import one_line_errors

    thresholds = dict(map(_threshold, threshold or ()))
    drawn = [each.value for each in formats or ()]
    options = {"--out": [str(out)], "--task": task, "--reference": [reference], "--threshold": threshold}
    options["--format"] = drawn
    given = [part for name, values in options.items() for value in values or () if value for part in (name, value)]
    command = shlex.join(["dgpmpc", "report", str(folder), *given])
    with one_line_errors(ValueError, OSError):
        if holds_contact_study(folder):
            if task or reference or threshold:
                raise ValueError(
                    f"the report of the contact study has no options but --out and --format, got {shlex.join(given)}"
                )
            files = report_contact_study(folder, out, drawn or FORMATS[:1])
        else:
            files = write_report(
                folder,
                out,
                tasks=task or (),
                reference=reference,
                thresholds=thresholds,
                command=command,
                formats=drawn or FORMATS[:1],
            )
    typer.echo(f"{files[0]} and {len(files) - 1} figures in {files[0].with_suffix('')}")


def _threshold(text: str) -> tuple[str, float]:
    """Task and return of "Pendulum-v1=-250"; a task's id may itself contain an equals sign."""
    task, _, value = text.rpartition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not task or not math.isfinite(number):
        raise typer.BadParameter(f"expected TASK=RETURN, such as Pendulum-v1=-250, got {text!r}")
    return task, number
