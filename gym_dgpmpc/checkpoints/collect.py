"""What an agent's file holds.

Saved: the constructor's plain arguments, the spaces, everything learned (all kept posterior samples, normaliser,
data), counters, the state of every generator, the running plan, and of the running episode its beginning and its
record. Not saved: a reward or termination function (the environment offers it, or `load` is given it again), the
environment itself, and objects that the agent was composed of: a ready-made model or planner.

Each noun of the agent writes and reads its own fields (`Checkpointed.nouns`); a new field is an edit of its noun alone.
`restore.py` makes an agent from a file; `resume.py` puts a run's agent and environment back to where they were.
"""

import importlib.metadata
from functools import cache

import torch
from gymnasium import spaces
from torch import Tensor

from gym_dgpmpc.checkpoints.arguments import encode, saved_arguments
from gym_dgpmpc.checkpoints.format import Checkpoint, split
from gym_dgpmpc.checkpoints.interface import Checkpointed
from gym_dgpmpc.errors import CheckpointError, CheckpointWriteError
from gym_dgpmpc.tasks.replay import describe_start

PACKAGES = ("gym_dgpmpc", "gymnasium", "numpy", "stable_baselines3", "torch")
SPACES, BOUNDS = ("observation_space", "action_space"), ("low", "high")


def collect(agent: Checkpointed, *, gives_up: bool = False) -> Checkpoint:
    """Everything of an agent that goes into its file.

    Args:
        agent: the agent.
        gives_up: the running episode will not go on, because it failed.

    Raises:
        CheckpointWriteError: an argument is larger than `load` would believe.
    """
    states = {name: split(noun.state_dict()) for name, noun in agent.nouns().items()}
    goes_on = agent.has_running_episode and not gives_up
    if not goes_on:
        for name in ("last_observation", "last_episode_starts"):
            states["progress"][1].pop(name, None)
    start = describe_start(agent.env)
    config = {
        "class": type(agent).__name__,
        "arguments": {name: encode(value) for name, value in agent.arguments().items()},
        "space_dtypes": {name: str(_space(agent, name).dtype) for name in SPACES},
        "num_envs": agent.n_envs,
        "episode": None if start is None else {**start, "goes_on": goes_on},
        "values": {name: values for name, (values, _) in states.items()},
        "versions": {name: _version(name) for name in PACKAGES},
    }
    tensors = {name: tensors for name, (_, tensors) in states.items()}
    checkpoint = Checkpoint(config, {**tensors, "spaces": _bounds(agent)})
    try:
        saved_arguments(checkpoint, agent, agent.planner_given)
    except CheckpointError as error:
        raise CheckpointWriteError(f"the agent is not saved, for it could not be loaded again: {error}") from error
    return checkpoint


def _space(agent: Checkpointed, name: str) -> spaces.Box:
    return getattr(agent, name)


def _bounds(agent: Checkpointed) -> dict[str, Tensor]:
    """The bounds of observations and actions."""
    sides = ((name, side) for name in SPACES for side in BOUNDS)
    return {f"{name}.{side}": torch.from_numpy(getattr(_space(agent, name), side).copy()) for name, side in sides}


@cache
def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package.replace("_", "-"))
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
