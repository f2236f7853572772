"""What an agent's file holds.

Saved: the constructor's plain arguments, the spaces, everything learned (all kept posterior samples, normaliser,
data), counters, the state of every generator, the running plan, and of the running episode its beginning and its
record. Not saved: a reward or termination function (the environment offers it, or `load` is given it again), the
environment itself, and of a plain `MPCAgent` the objects it was composed of.

`loading.py` makes an agent from a file; `resuming.py` puts a run's agent and environment back to where they were.
"""

import importlib.metadata
import math
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gym_dgpmpc.agents.recent_episodes import recent_episodes
from gym_dgpmpc.checkpoints.format import Checkpoint
from gym_dgpmpc.checkpoints.saved import saved_arguments
from gym_dgpmpc.errors import CheckpointError, CheckpointWriteError
from gym_dgpmpc.planning.plan_state import plans_to_tensors
from gym_dgpmpc.tasks.dict_observations import layout
from gym_dgpmpc.tasks.replay import describe_start, options_to_reset
from gym_dgpmpc.tasks.task import LEARNED, environment_id
from gym_dgpmpc.types import ObservationSpec, StateDict

PACKAGES = ("gym_dgpmpc", "gymnasium", "numpy", "stable_baselines3", "torch")
COUNTERS = ("num_timesteps", "num_fitted", "_episode_num")
ABOUT_ENVIRONMENT = ("environment", "observation_parts", "reset_options")
SPACES, BOUNDS = ("observation_space", "action_space"), ("low", "high")


def collect(agent: Any, *, gives_up: bool = False) -> Checkpoint:
    """Everything of an `MPCAgent` that goes into its file.

    Args:
        agent: the agent.
        gives_up: the running episode will not go on, because it failed.

    Raises:
        CheckpointWriteError: an argument is larger than `load` would believe.
    """
    goes_on = agent._last_obs is not None and not gives_up
    own = _bounds(agent) | _running_state(agent) | recent_episodes(agent)
    states = {
        "dynamics": agent.dynamics.state_dict(),
        "transitions": agent.store.state_dict(),
        "generators": agent.generators.state_dict(),
        "agent": own | _last_step(agent) if goes_on else own,
    }
    config = {
        **_settings(agent),
        **_progress(agent, goes_on),
        **_about_environment(agent),
        "values": {part: _without_tensors(state) for part, state in states.items()},
        "versions": {name: _version(name) for name in PACKAGES},
    }
    checkpoint = Checkpoint(config, {part: _only_tensors(state) for part, state in states.items()})
    try:
        saved_arguments(checkpoint, type(agent))
    except CheckpointError as error:
        raise CheckpointWriteError(f"the agent is not saved, for it could not be loaded again: {error}") from error
    return checkpoint


def _settings(agent: Any) -> dict[str, Any]:
    """What the agent was made with, and what its model predicts, as plain values."""
    return {
        "class": type(agent).__name__,
        "arguments": {name: encode(getattr(agent, name)) for name in agent.saved_arguments},
        "to_learn": to_learn(agent),
        "modelled": {"reward": agent.modelled.reward, "terminated": agent.modelled.terminated},
        "seeds_environment": agent.seeds_environment,
        "space_dtypes": {name: str(getattr(agent, name).dtype) for name in SPACES},
        "device": agent.device.type,
    }


def _progress(agent: Any, goes_on: bool) -> dict[str, Any]:
    """How far the agent has come, and how its running episodes began, as plain values."""
    start = describe_start(agent.env)
    running = [{"index": episode.index, "has_explored": episode.has_explored} for episode in agent._running]
    logs = [(name, _json_number(value), count, excluded) for name, value, count, excluded in pending_logs(agent)]
    return {
        "counters": {name: getattr(agent, name) for name in COUNTERS},
        "running": running,
        "episode": None if start is None else {**start, "goes_on": goes_on},
        "pending_logs": logs,
        "log_run": agent._log_run,
    }


def _about_environment(agent: Any) -> dict[str, Any]:
    """What a file says of the agent's environment; of an agent without one, what its own file said."""
    if agent.env is None:
        about = agent._about_environment
    else:
        about = {
            "environment": environment_id(agent.env),
            "observation_parts": {key: [part.start, part.stop] for key, part in layout(agent.env).items()},
            "reset_options": options_to_reset(agent.env, again=True),
        }
    has_terminated_fn = agent._task is not None and agent._task.terminated_fn is not None
    return {**about, "has_terminated_fn": has_terminated_fn or agent.lacks_terminated_fn}


def _bounds(agent: Any) -> dict[str, Tensor]:
    """The bounds of observations and actions."""
    spaces = {name: getattr(agent, name) for name in SPACES}
    return {f"{name}.{side}": torch.tensor(getattr(box, side)) for name, box in spaces.items() for side in BOUNDS}


def _running_state(agent: Any) -> dict[str, Tensor]:
    """Plans and records of the running episodes."""
    plans = plans_to_tensors([episode.carried for episode in agent._running])
    return plans | {
        f"record.{index}.{name}": value
        for index, episode in enumerate(agent._running)
        for name, value in episode.record.state_dict().items()
    }


def _last_step(agent: Any) -> dict[str, Tensor]:
    """Where the environment is."""
    return {
        "last_observation": torch.tensor(agent._last_obs),
        "last_episode_starts": torch.tensor(agent._last_episode_starts),
    }


def to_learn(agent: Any) -> dict[str, bool]:
    """Which of reward and termination the user asked to be learned whatever the environment offers."""
    return {name: getattr(agent, f"given_{name}") == LEARNED for name in ("reward_fn", "terminated_fn")}


def encode(value: Any) -> Any:
    """An argument as JSON has it, where a tuple is a list and a number of numpy's is Python's."""
    if isinstance(value, ObservationSpec):
        return {"observation_spec": asdict(value)}
    if isinstance(value, tuple | list):
        return [encode(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def _only_tensors(state: StateDict) -> dict[str, Tensor]:
    return {name: value for name, value in state.items() if isinstance(value, Tensor)}


def _without_tensors(state: StateDict) -> dict[str, Any]:
    return {name: _json_number(value) for name, value in state.items() if not isinstance(value, Tensor)}


def pending_logs(agent: Any) -> list[tuple[str, float, int, Any]]:
    """Numbers that the logger was given since it last wrote: name, value, count of a mean, formats left out."""
    logger = getattr(agent, "_logger", None)
    if logger is None:
        return agent._pending_logs
    return [
        (name, float(value), logger.name_to_count.get(name, 0), logger.name_to_excluded.get(name))
        for name, value in list(logger.name_to_value.items())
        if isinstance(value, int | float | np.number)
    ]


def _json_number(value: Any) -> Any:
    """JSON has no NaN and no infinity; `loading.py` has the inverse."""
    return {"float": str(value)} if isinstance(value, float) and not math.isfinite(value) else value


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package.replace("_", "-"))
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
