"""Planners by name: what agents, files and the command line call them.

A new planner is one line, ``register_planner("my-planner", MyPlanner)``; an agent then takes ``planner="my-planner"``.
"""

import re
from functools import cache
from typing import Any, Literal, TypeGuard

import torch
from gymnasium import spaces

from gym_dgpmpc.planning.cem import CEM
from gym_dgpmpc.planning.gradient import GradientAscent
from gym_dgpmpc.planning.icem import ICEM
from gym_dgpmpc.planning.mppi import MPPI
from gym_dgpmpc.settings import settings_of
from gym_dgpmpc.types import Planner, PlannerFactory

PLANNERS: dict[str, PlannerFactory] = {"cem": CEM, "icem": ICEM, "mppi": MPPI, "gradient": GradientAscent}
"""The registered planners; add to them with `register_planner`."""

PlannerName = Literal["cem", "icem", "mppi", "gradient"]
"""Those that come with the package, for editors and type checkers; any registered name will do."""


def register_planner(name: str, factory: PlannerFactory) -> None:
    """Let a planner be made by name.

    Args:
        name: lower-case words, digits included, with hyphens or underscores between them.
        factory: the planner's class, or a function that makes one; see `Planner`.

    Raises:
        ValueError: the name has another form, or is that of another planner.
        TypeError: the factory cannot be called.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*", name):
        raise ValueError(f"a planner's name must be lower-case words such as 'my-planner', got {name!r}")
    if not callable(factory):
        raise TypeError(f"a planner's factory must be a class or a function, got {factory!r}")
    if PLANNERS.setdefault(name, factory) is not factory:
        raise ValueError(f"the name {name!r} is taken by {PLANNERS[name]!r}: choose another one")


def is_ready_made(planner: str | PlannerFactory | Planner) -> TypeGuard[Planner]:
    """Whether it is a planner itself, rather than its name or something that makes one."""
    return isinstance(planner, Planner) and not isinstance(planner, type)


def planner_factory(planner: str | PlannerFactory | Planner) -> PlannerFactory:
    """The class or function that makes the planner of this name; one given in place of a name is returned as it is.

    Raises:
        ValueError: no planner is registered under this name.
        TypeError: it is neither a name nor callable.
    """
    if isinstance(planner, str):
        if planner not in PLANNERS:
            raise ValueError(f"unknown planner {planner!r}: expected one of {sorted(PLANNERS)} (see register_planner)")
        return PLANNERS[planner]
    if not callable(planner):
        raise TypeError(f"planner must be a name, a class or function that makes one, or an object, got {planner!r}")
    return planner


def settings_of_others(planner: str | PlannerFactory) -> set[str]:
    """Names that are settings of other registered planners, and not of this one."""
    own = _names(planner_factory(planner))
    return {name for factory in PLANNERS.values() for name in _names(factory)} - own


@cache
def _names(factory: PlannerFactory) -> frozenset[str]:
    """Names of a planner's settings; reading them off its signature takes a millisecond."""
    return frozenset(settings_of(factory))


def make_planner(
    planner: str | PlannerFactory | Planner,
    action_space: spaces.Box,
    device: torch.device | str = "cpu",
    **settings: Any,
) -> Planner:
    """A planner of actions in this space.

    Args:
        planner: a registered name, a class or function that makes one, or a ready-made planner, which is returned.
        action_space: its bounds are the planner's, in float32 and flattened to [A].
        device: where it computes.
        settings: its keyword arguments; none for a ready-made one.

    Raises:
        ValueError: no planner is registered under this name, or a setting is out of its range.
        TypeError: the planner does not have a setting, or it is ready-made and settings were given.
    """
    if is_ready_made(planner):
        if settings:
            raise TypeError(f"a ready-made planner has its settings: expected no others, got {sorted(settings)}")
        return planner
    low, high = action_bounds(action_space, device)
    return planner_factory(planner)(low, high, **settings)


def action_bounds(action_space: spaces.Box, device: torch.device | str) -> tuple[torch.Tensor, torch.Tensor]:
    """Lower and upper bounds of the actions, float32 [A]."""
    low, high = (
        torch.as_tensor(bound, dtype=torch.float32, device=device).flatten()
        for bound in (action_space.low, action_space.high)
    )
    return low, high
