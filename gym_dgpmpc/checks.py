"""Checks of settings that every part has."""

import difflib
import numbers
from collections.abc import Iterable

LARGEST_COUNT = 1 << 53
"""What a file may claim of something that is counted."""


def check_counts(**counts: object) -> None:
    """Refuse settings that count something and are not a whole number, or are less than one.

    Raises:
        TypeError, ValueError: naming the setting and its value.
    """
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, numbers.Integral):
            raise TypeError(f"{name} must be a whole number, got {value!r}")
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def check_reals(interval: str, **values: object) -> None:
    """Refuse settings that are no real number, or not one of an interval.

    Args:
        interval: such as "[0, 1)"; a bracket includes its end, a parenthesis does not. NaN is in none.

    Raises:
        TypeError, ValueError: naming the setting, the interval and the value.
    """
    low, high = map(float, interval[1:-1].split(","))
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise TypeError(f"{name} must be a number, got {value!r}")
        number = float(value)
        above = low <= number if interval[0] == "[" else low < number
        below = number <= high if interval[-1] == "]" else number < high
        if not (above and below):
            raise ValueError(f"{name} must lie in {interval}, got {value}")


def saved_count(name: str, value: object, lowest: int = 0) -> int:
    """A whole number of a file, if it is one.

    Raises:
        ValueError: it is none, or does not lie in ``lowest`` to `LARGEST_COUNT`.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not lowest <= value <= LARGEST_COUNT:
        raise ValueError(f"{name} must be a whole number from {lowest} to {LARGEST_COUNT}, got {value!r}")
    return value


def closest(name: str, known: Iterable[str]) -> str:
    """For an error's text: " (did you mean ...?)" with the known names that look like ``name``, or nothing."""
    near = difflib.get_close_matches(name, list(known))
    return f" (did you mean {' or '.join(map(repr, near))}?)" if near else ""
