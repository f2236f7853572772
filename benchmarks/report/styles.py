"""One look per method in all figures: colours that colour-blind readers can tell apart, and markers for the rest."""

from collections.abc import Iterable
from typing import NamedTuple

from benchmarks.report.scores import OURS

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#7F7F7F", "#8B4513")
"""Okabe and Ito's palette without its black, which is the ceiling's, and its yellow, which is faint on white."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")

KNOWN = (OURS, "PETS TSinf", "PETS TS1", "GP-MM", "GP-DS", "SAC", "TD3", "PPO")
"""Methods whose look does not depend on which others there are: as many as there are colours."""


class Style(NamedTuple):
    colour: str
    marker: str
    width: float


def styles(methods: Iterable[str], reference: Iterable[str] = ()) -> dict[str, Style]:
    """A look for each method: the known ones' own, the references' that of the package's method, the rest in turn."""
    names = list(dict.fromkeys(methods))
    as_known = {name: OURS if name in set(reference) else name for name in names}
    unused = [i for i, name in enumerate(KNOWN) if name not in as_known.values()]
    free = unused or [*range(len(KNOWN))]
    looks, turn = {}, 0 if unused else len(free)
    for name in names:
        if as_known[name] in KNOWN:
            index = KNOWN.index(as_known[name])
            looks[name] = Style(COLOURS[index], MARKERS[index], 2.4 if index == 0 else 1.5)
            continue
        index = free[turn % len(free)]
        # After a full turn the colours come again with other markers.
        marker = MARKERS[(index + turn // len(free)) % len(MARKERS)]
        looks[name] = Style(COLOURS[index], marker, 1.5)
        turn += 1
    return looks
