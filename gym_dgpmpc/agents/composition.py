"""What an agent is made of: dynamics model, planner and controller, each with the settings that its class documents.

`MPCAgent` keeps a `Composition` of what it was asked for; `signature.py` shows the same to `help` and to callers.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar, overload

import torch
from gymnasium import spaces

from gym_dgpmpc.agents.signature import PLAIN
from gym_dgpmpc.planning.controller import Controller
from gym_dgpmpc.planning.registry import PlannerName, is_ready_made, make_planner, planner_factory
from gym_dgpmpc.planning.risk import RiskMeasure
from gym_dgpmpc.settings import Setting, Settings, joined, refuse_unknown, settings_of
from gym_dgpmpc.types import DynamicsFactory, DynamicsModel, ObservationSpec, Planner, PlannerFactory

AnyPlanner = PlannerName | str | PlannerFactory | Planner
"""A planner by name, by what makes it, or ready-made."""


class PlanningArguments(NamedTuple):
    """What the controller is made with; from then on it owns them."""

    num_particles: int
    actions_per_plan: int
    time_budget: float | None
    measure: RiskMeasure


class MadeOf(NamedTuple):
    """What a class of agents says of its parts.

    Attributes:
        name: of the class.
        dynamics_class: the model that it makes, or None if it is given one.
        part_defaults: settings of its parts that differ from the parts' own defaults.
        controller_class: what acts through model and planner.
    """

    name: str
    dynamics_class: Callable[..., DynamicsModel] | None
    part_defaults: Mapping[str, Any]
    controller_class: type[Controller] = Controller


def own_settings(base: Callable[..., Any], agent: type) -> dict[str, Setting]:
    """The settings that every agent has, whatever it is made of, with the defaults of one class of agents.

    Args:
        base: `MPCAgent`, which documents them.
        agent: the class.
    """
    own = settings_of(base)
    changed = inspect.signature(agent.__init__).parameters  # type: ignore[misc]
    return {
        name: replace(own[name], default=changed[name].default if name in changed else own[name].default)
        for name in PLAIN
    }


def part_settings(agent: MadeOf, planner: AnyPlanner) -> dict[str, Setting]:
    """The settings of an agent's model and controller, and of its planner unless that is a ready-made one.

    Their defaults are the agent's own.
    """
    of_planner = {} if is_ready_made(planner) else settings_of(planner_factory(planner))
    return joined(model_settings(agent), controller_settings(agent), _with_own_defaults(agent, of_planner))


def model_settings(agent: MadeOf) -> dict[str, Setting]:
    """The settings of the model that a named agent makes; none of a plain `MPCAgent`."""
    return {} if agent.dynamics_class is None else _with_own_defaults(agent, settings_of(agent.dynamics_class))


def controller_settings(agent: MadeOf) -> dict[str, Setting]:
    """The settings of an agent's controller."""
    return _with_own_defaults(agent, settings_of(agent.controller_class))


def _with_own_defaults(agent: MadeOf, settings: Settings) -> dict[str, Setting]:
    changed = agent.part_defaults
    return {name: replace(setting, default=changed.get(name, setting.default)) for name, setting in settings.items()}


def _constant(schedule: Callable[[float], float]) -> float:
    """The value of a schedule as Stable-Baselines3 has them, which its RL Zoo makes of every learning rate.

    Raises:
        ValueError: it is not the same at the beginning, the middle and the end.
    """
    first, middle, last = (float(schedule(remaining)) for remaining in (1.0, 0.5, 0.0))
    if not first == middle == last:
        raise ValueError(
            f"learning_rate must be a number or a constant schedule, got one from {first} over {middle} to {last}: "
            "each training of the model goes through all of its steps, however far the run is"
        )
    return first


def setting_property(name: str) -> property:
    """A setting as an attribute of the agent; it is decided when the agent is made, so it cannot be set."""
    return property(lambda agent: agent.composition.setting(name))


Value = TypeVar("Value")


class OfController(Generic[Value]):
    """An attribute of the agent's controller as one of the agent, to be read and set; the controller checks it."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, agent: None, owner: type) -> "OfController[Value]": ...
    @overload
    def __get__(self, agent: Any, owner: type) -> Value: ...
    def __get__(self, agent: Any, owner: type) -> Any:
        return self if agent is None else getattr(agent.controller, self._name)

    def __set__(self, agent: Any, value: Value) -> None:
        setattr(agent.controller, self._name, value)


class Composition:
    """How one agent is made.

    Args:
        agent: what its class says.
        dynamics, planner: as they were given to it.
        settings: those of model, planner and controller that were given.
        other_names: arguments that are no settings of these, for the error.

    Attributes:
        settings: every setting of model, planner and controller, the defaults where none was given; fixed from then on.

    Raises:
        TypeError: there is no such setting; or a model was given to an agent that makes its own.
        ValueError: ``learning_rate`` is a schedule of Stable-Baselines3's that is not constant.
    """

    def __init__(
        self,
        agent: MadeOf,
        dynamics: DynamicsModel | DynamicsFactory | None,
        planner: AnyPlanner,
        settings: Mapping[str, Any],
        other_names: Mapping[str, Setting],
    ):
        self._agent, self.dynamics, self.planner = agent, dynamics, planner
        if agent.dynamics_class is not None and dynamics is not None:
            raise TypeError(
                f"a {agent.name} makes its own dynamics model: MPCAgent takes any, got dynamics={dynamics!r}"
            )
        known = part_settings(agent, planner)
        refuse_unknown(agent.name, settings, {**known, **other_names})
        filled = {name: setting.default for name, setting in known.items()} | dict(settings)
        if callable(filled.get("learning_rate")):
            filled["learning_rate"] = _constant(filled["learning_rate"])
        self.settings: Mapping[str, Any] = MappingProxyType(filled)

    @property
    def planner_name(self) -> str | None:
        """The registered name that the planner was given by; None if it was given as a class or an object."""
        return self.planner if isinstance(self.planner, str) else None

    def setting(self, name: str) -> Any:
        """One of ``settings``.

        Raises:
            AttributeError: this agent has no such setting, because its planner is another one.
        """
        if name not in self.settings:
            raise AttributeError(f"this agent's planner has no setting {name!r}; there are {sorted(self.settings)}")
        return self.settings[name]

    def make_planner(self, action_space: spaces.Box, device: torch.device) -> Planner:
        """The planner, for these actions.

        Raises:
            ValueError, TypeError: see `registry.make_planner`.
        """
        of_others = {**model_settings(self._agent), **controller_settings(self._agent)}
        own = {name: value for name, value in self.settings.items() if name not in of_others}
        return make_planner(self.planner, action_space, device, **own)

    def make_controller(
        self,
        dynamics: DynamicsModel,
        action_space: spaces.Box,
        planning: PlanningArguments,
        device: torch.device,
    ) -> Controller:
        """The controller of an untrained model, with a planner of its own.

        Raises:
            ValueError, TypeError: see `registry.make_planner` and the class of the controller.
        """
        own = {name: self.settings[name] for name in controller_settings(self._agent)}
        planner = self.make_planner(action_space, device)
        return self._agent.controller_class(dynamics, planner, action_space, *planning, **own, device=device)

    def make_dynamics(
        self, observation_size: int, action_size: int, observation_spec: ObservationSpec, device: torch.device
    ) -> DynamicsModel | None:
        """An untrained model of such transitions, or None if the agent was given a ready-made one.

        Raises:
            ValueError: nothing was given to make one of, or a setting is out of its range.
        """
        if self._agent.dynamics_class is not None:
            own = {name: self.settings[name] for name in model_settings(self._agent)}
            return self._agent.dynamics_class(observation_size, action_size, observation_spec, **own, device=device)
        if self.dynamics is None:
            raise ValueError("an MPCAgent is made of a dynamics model and a planner: pass dynamics=... and planner=...")
        if isinstance(self.dynamics, DynamicsModel) and not isinstance(self.dynamics, type):  # a class makes models
            return None
        return self.dynamics(observation_size, action_size, observation_spec)
