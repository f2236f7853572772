"""The rows of a benchmark that may be interrupted, one per measurement: what is in its files is not measured again."""

import argparse
import json
import multiprocessing
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import torch

from benchmarks.report import markdown
from gym_dgpmpc.checkpoints.files import replace_text

Row = dict[str, Any]

ABOUT = ("command", "torch")
"""What each row says of its making: no column of the table, and no reason to measure again."""


def find(rows: Sequence[Row], **wanted: Any) -> Row | None:
    """The first row with these values."""
    return next((row for row in rows if all(row.get(key) == value for key, value in wanted.items())), None)


def command(name: str) -> str:
    """The command that is running, which is that of the benchmark of that name."""
    return shlex.join(["python", "-m", f"benchmarks.{name}", *sys.argv[1:]])


def measure_missing(
    name: str,
    results: Path,
    wanted: Sequence[Row],
    measure: Callable[[Row], Row],
    settings: argparse.ArgumentParser | None = None,
    page: Callable[[Sequence[Row]], str] | None = None,
    jobs: int = 1,
) -> str:
    """Measure what the benchmark's files do not have, and write them again after each measurement.

    Args:
        name: of the benchmark's module below `benchmarks`; its last part is that of the files, ``.json`` and ``.md``.
        results: their folder.
        wanted: for each measurement everything that makes it another one.
        measure: gives the results of one.
        settings: has the options that are part of each of ``wanted``, for old files whose rows do not name them.
        page: what ``name.md`` says of the rows; default: `document`.
        jobs: measurements at a time, each in a process of its own if there are several.

    Returns:
        The page of all rows, those of other settings included.
    """
    page = document if page is None else page
    file = results / f"{name.rpartition('.')[2]}.json"
    rows = read_rows(file, settings)
    missing = [row for row in wanted if find(rows, **row) is None]
    for row, found in _measured(missing, measure, jobs):
        rows.append(row | found | {"command": command(name), "torch": torch.__version__})
        replace_text(file, json.dumps({"rows": rows}, indent=2) + "\n")
        replace_text(file.with_suffix(".md"), page(rows))
    return page(rows)


def _measured(rows: Sequence[Row], measure: Callable[[Row], Row], jobs: int) -> Iterator[tuple[Row, Row]]:
    """Each row with its measurement, as it ends."""
    if jobs == 1:
        for row in rows:
            yield row, measure(row)
        return
    # Anew, and not as copies of this process, whose threads would be missing.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        row_of = {pool.submit(measure, row): row for row in rows}
        for future in as_completed(row_of):
            yield row_of[future], future.result()


def read_rows(file: Path, settings: argparse.ArgumentParser | None = None) -> list[Row]:
    """The rows of a file, none if there is no file.

    Rows used not to name their settings; they have those that the command of the whole file says.
    """
    if not file.exists():
        return []
    facts = json.loads(file.read_text())
    if "command" not in facts or settings is None:
        return facts["rows"]
    made_with = vars(settings.parse_known_args(facts["command"].split())[0])
    return [made_with | row | {key: facts[key] for key in ABOUT} for row in facts["rows"]]


def document(rows: Sequence[Row]) -> str:
    """All rows as a table, with the commands that made them."""
    names = [name for name in dict.fromkeys(name for row in rows for name in row) if name not in ABOUT]
    cells = [[_cell(row.get(name, markdown.NOTHING)) for name in names] for row in rows]
    return "\n".join([made_by(rows), "", *markdown.table(names, cells)]) + "\n"


def made_by(rows: Sequence[Row]) -> str:
    """The commands that made the rows."""
    commands = dict.fromkeys(f"`{row['command']}`" for row in rows)
    return f"Made by {', '.join(commands)}."


def _cell(value: Any) -> str:
    return markdown.cell(f"{value:.2f}" if isinstance(value, float) and not value.is_integer() else str(value))
