"""`dgpmpc bench SUITE`."""

import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from gym_dgpmpc.cli.common import EXIT_INTERRUPTED, EXIT_TERMINATED, one_line_errors

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gym_dgpmpc.bench.executors import Executor
    from gym_dgpmpc.bench.jobs import Folders, Job

EXIT_FAILURES = 1
NARROW = "Which of its runs"
WHERE = "Where"


def bench(
    suite: Annotated[
        str,
        typer.Argument(
            metavar="SUITE", help="table, comparison, variance, unmodified, long-cheetah, stock or contact."
        ),
    ],
    show: Annotated[
        bool, typer.Option("--list", help="Only say what is finished, what is left and how long it may take.")
    ] = False,
    seeds: Annotated[
        str | None,
        typer.Option(help="Such as 0,1,5-9.", show_default="those of the suite", rich_help_panel=NARROW),
    ] = None,
    tasks: Annotated[
        str | None,
        typer.Option(help="Names or patterns, with commas between them.", show_default="all", rich_help_panel=NARROW),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(help='Names or patterns, such as "DGP-MPC L=2*,SAC".', show_default="all", rich_help_panel=NARROW),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Of each run, after the random ones.", show_default="the suite's", rich_help_panel=NARROW
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=1, help="Runs at the same time, of one thread each.", rich_help_panel=WHERE)
    ] = 1,
    cluster: Annotated[
        str | None,
        typer.Option(
            help="ray or dask: a cluster of --jobs workers on this machine (or the Ray cluster of RAY_ADDRESS); "
            "ray://HOST:PORT, tcp://HOST:PORT: one that is there.",
            show_default="processes of this machine",
            rich_help_panel=WHERE,
        ),
    ] = None,
    results: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the result files, one per run.",
            show_default="benchmarks/results/runs, or contact in place of runs",
            rich_help_panel=WHERE,
        ),
    ] = None,
    work: Annotated[Path, typer.Option(help="Folder that unfinished runs go on from.", rich_help_panel=WHERE)] = Path(
        "runs/bench"
    ),
) -> None:
    """Run a benchmark suite, or what is left of it: one result file per method, task and seed.

    Runs whose results are there are skipped, and the same command after an interruption goes on.
    """
    from gym_dgpmpc.bench.executors import executor
    from gym_dgpmpc.bench.jobs import Folders, unfinished
    from gym_dgpmpc.bench.listing import summary, survey
    from gym_dgpmpc.bench.suites import Narrowed, find_suite

    with one_line_errors(ValueError, OSError):
        narrowed = Narrowed(_numbers(seeds), _names(tasks), _names(methods), episodes)
        chosen = find_suite(suite)
        wanted = chosen.jobs(narrowed)
        folders = Folders((results or chosen.results).resolve(), work.resolve())
        lines = survey(wanted, folders)
        if show:
            for line in lines:
                typer.echo(f"{line.job.name}: {line.state}")
        typer.echo(summary(lines))
        if show:
            return
        carry_out_all = executor(jobs, cluster)
        left = unfinished(wanted, folders.results)
    _report_failures(_perform(left, folders, carry_out_all), folders)


def _perform(jobs: "Sequence[Job]", folders: "Folders", carry_out_all: "Executor") -> "list[Job]":
    """Carry out the jobs, tell of each as it ends, and return those that failed."""
    from gym_dgpmpc.bench.jobs import keep

    failures, before = [], signal.signal(signal.SIGTERM, _terminate)
    try:
        with one_line_errors(OSError):
            for number, (job, outcome) in enumerate(carry_out_all(jobs, folders), start=1):
                keep(job, outcome, folders.results)
                if outcome.content is None:
                    failures.append(job)
                typer.echo(f"{number} of {len(jobs)} | {job.name}: {outcome.told}")
    except (KeyboardInterrupt, SystemExit) as stop:
        typer.echo("\ninterrupted; the same command goes on")
        raise typer.Exit(EXIT_TERMINATED if isinstance(stop, SystemExit) else EXIT_INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGTERM, before)
    return failures


def _report_failures(failures: "Sequence[Job]", folders: "Folders") -> None:
    from gym_dgpmpc.bench.jobs import log_of

    if not failures:
        return
    typer.echo(f"\n{len(failures)} failed:", err=True)
    for job in failures:
        typer.echo(f"  {job.name}: see {log_of(job, folders.results)}", err=True)
    raise typer.Exit(EXIT_FAILURES)


def _terminate(number: int, frame: FrameType | None) -> None:
    sys.exit(EXIT_TERMINATED)


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",")]


def _numbers(text: str | None) -> list[int] | None:
    """Numbers and ranges with commas between them, each number once.

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
            raise ValueError(f"seeds are numbers and ranges such as 0,1,5-9, got {text!r}")
        numbers.extend(range(int(first), int(last) + 1))
    return list(dict.fromkeys(numbers))
