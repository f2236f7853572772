"""`dgpmpc plot FOLDER...`."""

from pathlib import Path
from typing import Annotated

import typer

from gym_dgpmpc.cli.common import one_line_errors
from gym_dgpmpc.formats import FORMATS, FigureFormat

SEVERAL = "learning_curves"


def plot(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Folders written by `dgpmpc train`.")],
    formats: Annotated[
        list[FigureFormat] | None,
        typer.Option("--format", help="Format of the figures; may be given several times.", show_default="png"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder to write to.", show_default="that of the run; the present one for several runs"
        ),
    ] = None,
    title: Annotated[
        str | None, typer.Option(help="Heading of the figures.", show_default="environment, model and seed")
    ] = None,
) -> None:
    """Draw a run's figures again, or the learning curves of several runs in one chart.

    Runs that differ in their seed alone are one curve, with their mean and standard deviation.
    """
    with one_line_errors(ValueError, OSError):
        from gym_dgpmpc.runs.plotting import RecordedRun, draw_run, draw_runs, title_of

        chosen = [each.value for each in formats or ()] or FORMATS[:1]
        runs = [RecordedRun.read(folder) for folder in dict.fromkeys(folders)]
        if len(runs) == 1:
            written = draw_run(runs[0].path, title or title_of(runs[0].settings), chosen, out)
        else:
            written = draw_runs(runs, (out or Path()) / SEVERAL, chosen, title)
    for file in written:
        typer.echo(f"  {file}")
