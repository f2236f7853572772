"""Tables in Markdown, and numbers and intervals as they are written in them."""

import math
from collections.abc import Sequence
from pathlib import Path

from benchmarks.report.statistics import Estimate

NOTHING = "–"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table; an empty one has its header alone.

    Raises:
        ValueError: a row has another number of cells than the header.
    """
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"a table of {len(header)} columns got a row of {len(row)} cells: {row}")
    return [_line(header), "|" + "---|" * len(header), *map(_line, rows)]


def cell(text: str) -> str:
    """A text that cannot end the cell that it stands in."""
    return " ".join(text.replace("|", "\\|").split())


def number(value: float | None, decimals: int | None = None) -> str:
    """A number with ``decimals``, or else about four figures, and a true minus sign; a dash for None and NaN."""
    if value is None or math.isnan(value):
        return NOTHING
    if decimals is None:
        size = abs(value)
        decimals = 0 if size >= 1000 else 1 if size >= 100 else 2
    return f"{value:,.{decimals}f}".replace("-", "−")


def estimate(value: Estimate, decimals: int | None = None) -> str:
    """ "1.20 [1.10, 1.30]", or the number alone where there is no interval."""
    if value.low is None or value.high is None:
        return number(value.value, decimals)
    return f"{number(value.value, decimals)} [{number(value.low, decimals)}, {number(value.high, decimals)}]"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def page_and_folder(out: Path) -> tuple[Path, Path]:
    """The files of a report: the page ``out``.md, and the folder ``out`` of its figures; ``out`` with ".md" or not."""
    name = out.name.removesuffix(".md")
    return out.with_name(f"{name}.md"), out.with_name(name)
