"""What a file says of its agent: its class, arguments, spaces and episodes, checked before anything is made of them."""

import inspect
import math
from importlib import import_module
from typing import Any

import numpy as np
from gymnasium import spaces

from gym_dgpmpc.checkpoints.format import SCHEMA, Checkpoint
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.tasks.task import LEARNED
from gym_dgpmpc.types import ObservationSpec

AGENT_CLASSES = {
    "MPCAgent": "gym_dgpmpc.agents.mpc",
    "DGPMPCAgent": "gym_dgpmpc.agents.dgp_mpc",
    "GPMPCAgent": "gym_dgpmpc.agents.gp_mpc",
    "PETSAgent": "gym_dgpmpc.agents.pets",
}
"""The classes that a file may name, and where they are; nothing else is ever imported for a file."""

MAX_NUMBER = 10**7
"""No numeric argument in a file may exceed this, so that none makes a constructor take up the memory."""
MAX_SIZES = {"num_layers": 100, "num_candidates": 10**5, "num_particles": 10**4, "num_features": 10**5}
MAX_STATES = 10**8
"""Nor the arguments that say how large a plan is, of which H K P states are held at once."""
MAX_ENVS, MAX_COUNT = 10_000, 1 << 53


def class_of(checkpoint: Checkpoint, asked: type) -> Any:
    """The class that a file names: one of the package's, or the very class that was asked to load it."""
    name = checkpoint.config.get("class")
    if name == asked.__name__:
        return asked
    if not isinstance(name, str) or name not in AGENT_CLASSES:
        raise CheckpointError(f"the file holds an agent of the class {name!r}, not of {', '.join(AGENT_CLASSES)}")
    found = getattr(import_module(AGENT_CLASSES[name]), name)
    if not issubclass(found, asked):
        raise CheckpointError(f"the file holds a {name}: load it with {name}.load, not {asked.__name__}.load")
    return found


def saved_arguments(checkpoint: Checkpoint, agent_class: Any) -> dict[str, Any]:
    """The constructor arguments in a file, decoded; those that an older schema did not have are the constructor's.

    Raises:
        CheckpointError: they are not this class's, or larger than any agent's.
    """
    arguments, expected = checkpoint.config.get("arguments"), set(agent_class.saved_arguments)
    received = set(arguments) if isinstance(arguments, dict) else set()
    complete = received == expected or (checkpoint.schema < SCHEMA and received < expected)
    if not isinstance(arguments, dict) or not complete:
        raise CheckpointError(
            f"the file's arguments are not those of {agent_class.__name__}: expected {sorted(expected)}, got "
            f"{sorted(received) if isinstance(arguments, dict) else arguments}. If another version of the package "
            "wrote it, load it with that one"
        )
    for name, value in arguments.items():
        if name != "seed" and isinstance(value, int | float) and not abs(value) <= MAX_SIZES.get(name, MAX_NUMBER):
            raise CheckpointError(f"the file's argument {name} = {value} is larger than any agent's")
    if not isinstance(arguments.get("tensorboard_log"), str | None):
        raise CheckpointError(
            f"the file's argument tensorboard_log = {arguments['tensorboard_log']} is no folder's name"
        )
    decoded = {name: _decode(value) for name, value in arguments.items()}
    _check_plan_size(checkpoint, decoded)
    defaults = inspect.signature(agent_class).parameters
    return {name: defaults[name].default for name in expected - received} | decoded


def _check_plan_size(checkpoint: Checkpoint, arguments: dict[str, Any]) -> None:
    """The horizon must be that of the plan in the file, whose bytes are there; and a plan's states be countable."""
    mean = checkpoint.tensors.get("agent", {}).get("plan.mean")
    horizon = mean.shape[1] if mean is not None and mean.ndim == 3 else 1
    if arguments.get("horizon", horizon) != horizon:
        raise CheckpointError(
            f"the file's argument horizon = {arguments['horizon']} is not that of its plan, {horizon}"
        )
    sizes = [horizon, *(arguments.get(name, 1) for name in ("num_candidates", "num_particles"))]
    if all(isinstance(size, int) for size in sizes) and math.prod(sizes) > MAX_STATES:
        raise CheckpointError(
            f"the file's plans would be of {math.prod(sizes)} states, which is larger than any agent's"
        )


def saved_spaces(checkpoint: Checkpoint) -> tuple[spaces.Box, spaces.Box]:
    """Observation and action space of the saved agent."""
    try:
        return tuple(  # type: ignore[return-value]
            spaces.Box(
                checkpoint.tensors["agent"][f"{name}.low"].numpy(),
                checkpoint.tensors["agent"][f"{name}.high"].numpy(),
                dtype=np.dtype(checkpoint.config["space_dtypes"][name]).type,
            )
            for name in ("observation_space", "action_space")
        )
    except Exception as error:
        raise CheckpointError(f"the file does not describe the spaces of its agent: {error!r}") from error


def asked_to_learn(checkpoint: Checkpoint) -> dict[str, str]:
    """The constructor arguments that `to_learn` tells of.

    Raises:
        CheckpointError: the file does not say it in the way it is written.
    """
    asked = checkpoint.config.get("to_learn", {})
    if not isinstance(asked, dict) or not set(asked) <= {"reward_fn", "terminated_fn"}:
        raise CheckpointError(f"the file does not say what was to be learned: {asked!r}")
    return {name: LEARNED for name, is_asked in asked.items() if is_asked is True}


def saved_running(checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """Number and exploration of the episode that ran in each environment.

    Raises:
        CheckpointError: the file does not say.
    """
    try:
        if checkpoint.schema < 3:  # of one environment
            counters = checkpoint.config["counters"]
            return [{"index": int(counters["_episode_index"]), "has_explored": bool(counters["_explored_episode"])}]
        running = [
            {"index": int(episode["index"]), "has_explored": bool(episode["has_explored"])}
            for episode in checkpoint.config["running"]
        ]
        if not all(-1 <= episode["index"] <= MAX_COUNT for episode in running):
            raise ValueError(f"their numbers are {[episode['index'] for episode in running]}")
    except Exception as error:
        raise CheckpointError(f"the file does not describe the episodes that were running: {error!r}") from error
    if not 1 <= len(running) <= MAX_ENVS:
        raise CheckpointError(f"the file is of {len(running)} environments, of which no agent has that many")
    return running


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value


def _decode(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    try:
        return ObservationSpec(**{name: _as_tuple(indices) for name, indices in value["observation_spec"].items()})
    except Exception as error:
        raise CheckpointError(f"the file holds an argument that cannot be read: {value}") from error
