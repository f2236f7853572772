"""The constructor arguments in a file, checked before anything is made of them.

A file names its agent's class and arguments; what may be in it, and how large, is read from the class's settings.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict
from importlib import import_module
from typing import Any, cast

import numpy as np

from gym_dgpmpc.checkpoints.format import Checkpoint
from gym_dgpmpc.checkpoints.interface import AgentClass, HasSettings
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.planning.registry import PLANNERS
from gym_dgpmpc.settings import LARGEST_NUMBER, Setting
from gym_dgpmpc.tasks.functions import LEARNED, NEVER
from gym_dgpmpc.types import ObservationSpec, Planner, PlannerFactory

AGENT_CLASSES = {
    "MPCAgent": "gym_dgpmpc.agents.mpc",
    "DGPMPCAgent": "gym_dgpmpc.agents.dgp_mpc",
    "GPMPCAgent": "gym_dgpmpc.agents.gp_mpc",
    "PETSAgent": "gym_dgpmpc.agents.pets",
    "DynaAgent": "gym_dgpmpc.agents.dyna",
    "MixtureMPCAgent": "gym_dgpmpc.agents.mixture",
    "MCPILCOAgent": "gym_dgpmpc.agents.mc_pilco",
    "DeepPILCOAgent": "gym_dgpmpc.agents.deep_pilco",
    "PILCOAgent": "gym_dgpmpc.agents.pilco",
}
"""The classes that a file may name, and where they are; nothing else is ever imported for a file."""

MOST_STATES = 10**8
"""Nor may a file's arguments say that a plan holds more than that many states, H K P, at once."""

NOT_PLAIN = frozenset({"policy", "env", "dynamics", "reward_fn", "terminated_fn", "first_controller", "device"})
"""Arguments of every agent that no file holds."""


def class_of(checkpoint: Checkpoint, asked: type) -> AgentClass:
    """The class that a file names: one of the package's, or the very class that was asked to load it.

    Raises:
        CheckpointError: it is another one.
    """
    name, found = checkpoint.config.get("class"), cast(Any, asked)
    if name == asked.__name__:
        return found
    if not isinstance(name, str) or name not in AGENT_CLASSES:
        raise CheckpointError(f"the file holds an agent of the class {name!r}, not of {', '.join(AGENT_CLASSES)}")
    found = getattr(import_module(AGENT_CLASSES[name]), name)
    if not issubclass(found, asked):
        raise CheckpointError(f"the file holds a {name}: load it with {name}.load, not {asked.__name__}.load")
    return found


def arguments_to_load(checkpoint: Checkpoint, agent: HasSettings, replaced: Mapping[str, Any]) -> dict[str, Any]:
    """What to make the agent of a file with.

    Args:
        checkpoint: the file's contents.
        agent: the agent's class.
        replaced: arguments in place of the saved ones. Another planner takes over the settings that it has too.

    Raises:
        CheckpointError: see `saved_arguments`; or the file does not name its planner, and none is given.
    """
    planner = replaced.get("planner")
    arguments = saved_arguments(checkpoint, agent, planner)
    if planner is None:
        planner = arguments["planner"]
    if planner is None:
        raise CheckpointError(
            "the file's agent was given its planner as an object or a class, which no file holds: pass planner=... to "
            "load"
        )
    takes = {"planner", *agent.saved_settings(planner)}
    kept = {name: value for name, value in arguments.items() if name in takes}
    return kept | _asked_of_task(checkpoint) | dict(replaced) | {"planner": planner}


def saved_arguments(
    checkpoint: Checkpoint, agent: HasSettings, planner: str | PlannerFactory | Planner | None = None
) -> dict[str, Any]:
    """The constructor arguments in a file, decoded; what it does not have is to be the constructor's default.

    Args:
        checkpoint: the file's contents.
        agent: whose arguments they are, or its class.
        planner: the agent's, if there is one, for a file that names none or one that is not registered here.

    Returns:
        Arguments by name, "planner" and "seed" always among them.

    Raises:
        CheckpointError: they are not this class's, or larger than any agent's.
    """
    received = checkpoint.config.get("arguments")
    if not isinstance(received, dict):
        raise CheckpointError(f"the file's arguments must be an object, got {received!r}")
    name = received.get("planner")
    registered = name if isinstance(name, str) and name in PLANNERS else None
    if name != registered and (planner is None or not isinstance(name, str)):
        raise CheckpointError(
            f"the file's planner is {name!r}, and registered are {sorted(PLANNERS)}: register it with "
            "gym_dgpmpc.planning.register_planner before loading, or pass planner=... to load"
        )
    # Where nothing says which planner it was, its settings are those of the default.
    known = agent.saved_settings(registered or ("cem" if planner is None else planner))
    unknown = set(received) - set(known) - {"planner"}
    if registered is None and planner is not None:
        unknown &= NOT_PLAIN  # the others are settings of the planner that the agent had
    if unknown:
        raise CheckpointError(
            f"the file's arguments {sorted(unknown)} are not those of a {checkpoint.config.get('class')}: "
            f"expected {sorted(known)}. If another version of the package wrote it, load it with that one"
        )
    for each, value in received.items():
        _check_size(each, value, known.get(each))
    log, seed = received.get("tensorboard_log"), received.get("seed")
    if not isinstance(log, str | None):
        raise CheckpointError(f"the file's argument tensorboard_log = {log!r} must be a folder's name")
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise CheckpointError(f"the file's argument seed = {seed!r} must be a whole number that is not negative")
    _check_plan_size({each: setting.default for each, setting in known.items()} | received)
    return {"planner": name} | {each: decode(value) for each, value in received.items()}


def _asked_of_task(checkpoint: Checkpoint) -> dict[str, str]:
    """The constructor arguments by which the user asked for reward or termination to be learned, or said "never".

    Raises:
        CheckpointError: the file does not say it in the way it is written.
    """
    asked = checkpoint.state("task").get("to_learn", {})
    if not isinstance(asked, dict) or not set(asked) <= {"reward_fn", "terminated_fn"}:
        raise CheckpointError(f"the file does not say what was to be learned: {asked!r}")
    said_never = {"terminated_fn": NEVER} if checkpoint.state("task").get("never_terminates") is True else {}
    return said_never | {name: LEARNED for name, is_asked in asked.items() if is_asked is True}


def encode(value: Any) -> Any:
    """An argument as JSON has it, where a tuple is a list and a number of numpy's is Python's."""
    if isinstance(value, ObservationSpec):
        return {"observation_spec": asdict(value)}
    if isinstance(value, tuple | list):
        return [encode(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def decode(value: Any) -> Any:
    """The inverse of `encode`; a list becomes a tuple.

    Raises:
        CheckpointError: the value is not one that `encode` gives.
    """
    if not isinstance(value, dict):
        return _as_tuple(value)
    try:
        return ObservationSpec(**{name: _as_tuple(indices) for name, indices in value["observation_spec"].items()})
    except Exception as error:
        raise CheckpointError(f"the file holds an argument that cannot be read: {value}") from error


def _check_size(name: str, value: Any, setting: Setting | None) -> None:
    largest = LARGEST_NUMBER if setting is None else setting.largest
    if name != "seed" and isinstance(value, int | float) and not abs(value) <= largest:
        raise CheckpointError(f"the file's argument {name} = {value} is larger than any agent's")


def _check_plan_size(arguments: Mapping[str, Any]) -> None:
    """A plan's states H K P, as far as the planner has them, must be countable."""
    sizes = [arguments.get(name, 1) for name in ("horizon", "num_candidates", "num_particles")]
    if all(isinstance(size, int) for size in sizes) and math.prod(sizes) > MOST_STATES:
        raise CheckpointError(
            f"the file's plans would be of {math.prod(sizes)} states, which is larger than any agent's"
        )


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value
