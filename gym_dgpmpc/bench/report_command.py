"""`dgpmpc report DIR`: tables and figures from result files."""

import math
import shlex
from pathlib import Path
from typing import Annotated

import typer

from gym_dgpmpc.errors import DGPMPCError

EXIT_ERROR = 2


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of result files, as `dgpmpc bench` writes.")],
    out: Annotated[Path, typer.Option(metavar="OUT", help="Write OUT.md, and its figures into the folder OUT.")] = Path(
        "report"
    ),
    task: Annotated[
        list[str] | None,
        typer.Option(metavar="TASK", help="Report this task; again for more.", show_default="all there are"),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            help="Which setting of DGP-MPC the other methods are compared with.",
            show_default="the one with the most tasks and runs",
        ),
    ] = None,
    threshold: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TASK=RETURN",
            help="The return that counts as having learned a task; again for more.",
            show_default="the paper's best, or Gymnasium's",
        ),
    ] = None,
) -> None:
    """Make tables and figures from the result files of a folder: of runs, or of the contact study."""
    from gym_dgpmpc.bench.contact_report import report_contact_study
    from gym_dgpmpc.bench.contact_results import holds_contact_study
    from gym_dgpmpc.bench.report import write_report

    thresholds = dict(map(_threshold, threshold or ()))
    options = {"--out": [str(out)], "--task": task, "--reference": [reference], "--threshold": threshold}
    given = [part for name, values in options.items() for value in values or () if value for part in (name, value)]
    command = shlex.join(["dgpmpc", "report", str(folder), *given])
    try:
        if holds_contact_study(folder):
            if task or reference or threshold:
                raise ValueError("the report of the contact study is of all of it: of the options it has --out alone")
            files = report_contact_study(folder, out)
        else:
            files = write_report(
                folder, out, tasks=task or (), reference=reference, thresholds=thresholds, command=command
            )
    except (DGPMPCError, ValueError, OSError) as error:
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(EXIT_ERROR) from error
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
