"""Checks of settings that every part has."""

import numbers


def check_counts(**counts: object) -> None:
    """Refuse settings that count something and are no whole number, or less than one.

    Raises:
        TypeError, ValueError: naming the setting and its value.
    """
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, numbers.Integral):
            raise TypeError(f"{name} must be a whole number, got {value!r}")
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
