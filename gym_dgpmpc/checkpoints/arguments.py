"""The constructor arguments in a file, checked before anything is made of them.

A file names its agent's class and arguments; what may be in it, and how large, is read from the class's settings.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict
from importlib import import_module
from typing import Any

import numpy as np

from gym_dgpmpc.checkpoints.format import Checkpoint
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.planning.registry import PLANNERS
from gym_dgpmpc.settings import LARGEST_NUMBER, Setting
from gym_dgpmpc.tasks.functions import LEARNED
from gym_dgpmpc.types import ObservationSpec

AGENT_CLASSES = {
    "MPCAgent": "gym_dgpmpc.agents.mpc",
    "DGPMPCAgent": "gym_dgpmpc.agents.dgp_mpc",
    "GPMPCAgent": "gym_dgpmpc.agents.gp_mpc",
    "PETSAgent": "gym_dgpmpc.agents.pets",
}
"""The classes that a file may name, and where they are; nothing else is ever imported for a file."""

MOST_STATES = 10**8
"""Nor may a file's arguments say that a plan holds more than that many states, H K P, at once."""


def class_of(checkpoint: Checkpoint, asked: type) -> Any:
    """The class that a file names: one of the package's, or the very class that was asked to load it.

    Raises:
        CheckpointError: it is another one.
    """
    name = checkpoint.config.get("class")
    if name == asked.__name__:
        return asked
    if not isinstance(name, str) or name not in AGENT_CLASSES:
        raise CheckpointError(f"the file holds an agent of the class {name!r}, not of {', '.join(AGENT_CLASSES)}")
    found = getattr(import_module(AGENT_CLASSES[name]), name)
    if not issubclass(found, asked):
        raise CheckpointError(f"the file holds a {name}: load it with {name}.load, not {asked.__name__}.load")
    return found


def saved_arguments(checkpoint: Checkpoint, agent_class: Any, planner: Any = None) -> dict[str, Any]:
    """The constructor arguments in a file, decoded; those that it does not have are the constructor's defaults.

    Args:
        checkpoint: the file's contents.
        agent_class: whose arguments they are.
        planner: in place of the file's, if one is given; then the file's own planner has no say in its settings.

    Raises:
        CheckpointError: they are not this class's, or larger than any agent's.
    """
    received = checkpoint.config.get("arguments")
    if not isinstance(received, dict):
        raise CheckpointError(f"the file's arguments must be an object, got {received!r}")
    saved_planner = received.get("planner")
    if planner is None and saved_planner is not None and saved_planner not in PLANNERS:
        raise CheckpointError(
            f"the file's planner is {saved_planner!r}, and registered are {sorted(PLANNERS)}: register it with "
            "gym_dgpmpc.planning.register_planner before loading, or pass planner=... to load"
        )
    is_known = saved_planner is None or saved_planner in PLANNERS
    known = _known(agent_class, saved_planner if is_known else planner)
    unknown = sorted(set(received) - set(known) - {"planner"})
    if unknown and is_known:
        raise CheckpointError(
            f"the file's arguments {unknown} are not those of a {agent_class.__name__}: expected {sorted(known)}. If "
            "another version of the package wrote it, load it with that one"
        )
    for name, value in received.items():
        _check_size(name, value, known.get(name))
    if not isinstance(received.get("tensorboard_log"), str | None):
        raise CheckpointError(
            f"the file's argument tensorboard_log = {received['tensorboard_log']} must be a folder's name"
        )
    decoded = {name: decode(value) for name, value in received.items()}
    _check_plan_size(checkpoint, decoded)
    if planner is not None:
        takes = _known(agent_class, planner)
        decoded = {name: value for name, value in decoded.items() if name in takes} | {"planner": planner}
    return decoded


def asked_to_learn(checkpoint: Checkpoint) -> dict[str, str]:
    """The constructor arguments by which the user asked for reward or termination to be learned.

    Raises:
        CheckpointError: the file does not say it in the way it is written.
    """
    asked = checkpoint.config.get("values", {}).get("task", {}).get("to_learn", {})
    if not isinstance(asked, dict) or not set(asked) <= {"reward_fn", "terminated_fn"}:
        raise CheckpointError(f"the file does not say what was to be learned: {asked!r}")
    return {name: LEARNED for name, is_asked in asked.items() if is_asked is True}


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


def _known(agent_class: Any, planner: Any) -> Mapping[str, Setting]:
    """The settings that a file of this class may hold; those of CEM too where the planner is not known by name."""
    return agent_class.saved_settings("cem" if planner is None else planner)


def _check_size(name: str, value: Any, setting: Setting | None) -> None:
    largest = LARGEST_NUMBER if setting is None else setting.largest
    if name != "seed" and isinstance(value, int | float) and not abs(value) <= largest:
        raise CheckpointError(f"the file's argument {name} = {value} is larger than any agent's")


def _check_plan_size(checkpoint: Checkpoint, arguments: dict[str, Any]) -> None:
    """The horizon must be that of the plan in the file, whose bytes are there; and a plan's states be countable."""
    plans = [
        tensor for name, tensor in checkpoint.tensors.get("episodes", {}).items()
        if name.startswith("plan.") and name != "plan.age"
    ]  # fmt: skip
    horizon = arguments.get("horizon", 1)
    if plans and "horizon" in arguments and not any(horizon in plan.shape[1:] for plan in plans):
        shapes = [tuple(plan.shape) for plan in plans]
        raise CheckpointError(f"the file's argument horizon = {horizon} is not that of its plan, of shapes {shapes}")
    sizes = [horizon, *(arguments.get(name, 1) for name in ("num_candidates", "num_particles"))]
    if all(isinstance(size, int) for size in sizes) and math.prod(sizes) > MOST_STATES:
        raise CheckpointError(
            f"the file's plans would be of {math.prod(sizes)} states, which is larger than any agent's"
        )


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value
