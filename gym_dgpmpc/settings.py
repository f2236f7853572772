"""The settings of a part, read from the one place where they are named, documented, defaulted and checked.

A part is a class, such as a dynamics model or a planner. Its settings are the keyword-only arguments of its constructor
that have a default, with the texts of its docstring's ``Args:`` (of a dataclass: its fields, and ``Attributes:``).
The agents' constructors, saved files, the command line and the benchmarks are made from what is read here, so that a
new setting is an edit of its part alone.
"""

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from gym_dgpmpc.checks import closest

GIVEN_BY_THE_AGENT = frozenset({"device", "dtype", "generator"})
"""Keyword arguments of parts that are not settings: the agent provides them."""

LARGEST_NUMBER = 10**7
"""No number in a file may exceed this unless its part says otherwise, so that a damaged file cannot fill the memory."""


@dataclass(frozen=True)
class Setting:
    """One keyword argument.

    Attributes:
        name: as it is written everywhere.
        annotation: its type.
        default: its value if it is not given.
        text: what it means, from the docstring.
        largest: the largest number that a file may hold; a part's ``largest`` says so.
        is_saved: whether it goes into an agent's file; what depends on the machine does not, as ``unsaved`` says.
    """

    name: str
    annotation: Any
    default: Any
    text: str
    largest: int = LARGEST_NUMBER
    is_saved: bool = True

    def parameter(self, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
        """The parameter of a signature, with ``default`` in place of its own if one is given."""
        default = self.default if default is inspect.Parameter.empty else default
        return inspect.Parameter(self.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=self.annotation)


Settings = Mapping[str, Setting]


def settings_of(part: Callable[..., Any]) -> dict[str, Setting]:
    """The settings of a class, those of the classes in its ``composed_of`` included.

    A class may name in ``largest`` (a mapping) what a file may hold at most, and in ``unsaved`` which of its settings
    no file holds. Of the parts in its ``members_by_name`` (a mapping), which have settings of the same names, each is
    under the part's name and its own: "deep_gp_num_layers". A `partial` of a class is the class with other defaults.
    """
    made = part.func if isinstance(part, partial) else part
    texts = argument_texts(inspect.getdoc(made) or "")
    largest, unsaved = getattr(made, "largest", {}), getattr(made, "unsaved", ())
    found = {
        parameter.name: Setting(
            parameter.name,
            parameter.annotation,
            parameter.default,
            texts.get(parameter.name, ""),
            largest.get(parameter.name, LARGEST_NUMBER),
            parameter.name not in unsaved,
        )
        for parameter in inspect.signature(part).parameters.values()
        if parameter.default is not parameter.empty
        and parameter.name not in GIVEN_BY_THE_AGENT
        and (parameter.kind is parameter.KEYWORD_ONLY or _is_dataclass_field(made, parameter.name))
    }
    for other in getattr(made, "composed_of", ()):
        found = joined(found, settings_of(other))
    for name, member in getattr(made, "members_by_name", {}).items():
        own = [replace(setting, name=of_member(name, setting.name)) for setting in settings_of(member).values()]
        found = joined(found, {setting.name: setting for setting in own})
    return found


def of_member(name: str, setting: str) -> str:
    """What a setting, or another value, of one of several parts is called: deep_gp_kernel of "deep-gp" and "kernel"."""
    return f"{name.replace('-', '_')}_{setting}"


def joined(*of_parts: Settings) -> dict[str, Setting]:
    """The settings of several parts together.

    Raises:
        ValueError: two parts have a setting of the same name, so that a keyword would not say which is meant.
    """
    together: dict[str, Setting] = {}
    for settings in of_parts:
        twice = sorted(set(together) & set(settings))
        if twice:
            raise ValueError(f"two parts of one agent have settings of the same name, {twice}: rename them in one part")
        together |= settings
    return together


def refuse_unknown(owner: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Raise a TypeError that names settings which do not exist, and those that may have been meant.

    Raises:
        TypeError: one of ``given`` is not ``known``.
    """
    known = sorted(known)
    for name in given:
        if name not in known:
            raise TypeError(f"{owner} has no setting {name!r}{closest(name, known)}; it has {', '.join(known)}")


def argument_texts(docstring: str) -> dict[str, str]:
    """Name and text of each entry under ``Args:`` or ``Attributes:``, texts on one line.

    Args:
        docstring: cleaned of its indentation, as `inspect.getdoc` gives it.
    """
    texts: dict[str, str] = {}
    names: list[str] = []
    in_section = False
    for line in docstring.splitlines():
        if line and not line[0].isspace():
            in_section = line.strip() in ("Args:", "Attributes:")
            continue
        entry = re.match(r" {4}(\*{0,2}\w+(?:, \w+)*): (.*)", line)
        if in_section and entry:
            names = entry[1].split(", ")
            texts |= dict.fromkeys(names, entry[2].strip())
        elif in_section and line.strip():
            texts |= {name: f"{texts[name]} {line.strip()}" for name in names}
    return texts


def _is_dataclass_field(part: Any, name: str) -> bool:
    return name in getattr(part, "__dataclass_fields__", {})
