"""What an agent's file holds, and how an agent is made from it again.

Saved: the constructor's plain arguments, the spaces, everything learned (all kept posterior samples, normaliser,
data), counters, the state of every generator, the running plan, and of the running episode its beginning and its
record. Not saved: a reward or termination function (the environment offers it, or `load` is given it again), the
environment itself, and of a plain `MPCAgent` the objects it was composed of.

`load` makes an agent from a file; `resuming.py` puts a run's agent and environment back to where they were.
"""

import importlib.metadata
import inspect
import math
import re
from collections import deque
from dataclasses import asdict
from importlib import import_module
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv
from torch import Tensor

from gym_dgpmpc.agents.checkpoint import SCHEMA, Checkpoint, CheckpointPath, read_checkpoint
from gym_dgpmpc.agents.env_state import describe_start
from gym_dgpmpc.agents.plan_state import pack, unpack
from gym_dgpmpc.agents.randomness import derive_seed
from gym_dgpmpc.agents.task import offered_by, wrapped_env
from gym_dgpmpc.errors import CheckpointError, DGPMPCError
from gym_dgpmpc.types import ObservationSpec, StateDict

AGENT_CLASSES = {"MPCAgent": "gym_dgpmpc.agents.mpc", "DGPMPCAgent": "gym_dgpmpc.agents.dgp_mpc"}
"""The classes that a file may name, and where they are; nothing else is ever imported for a file."""

PACKAGES = ("gym_dgpmpc", "gymnasium", "numpy", "stable_baselines3", "torch")
MAX_NUMBER = 10**7
"""No numeric argument in a file may exceed this, so that none makes a constructor take up the memory."""
MAX_SIZES = {"num_layers": 100, "num_candidates": 10**5, "num_particles": 10**4, "num_features": 10**5}
MAX_STATES = 10**8
"""Nor the arguments that say how large a plan is, of which H K P states are held at once."""
MAX_EPISODE_INFOS, MAX_COUNT = 10_000, 1 << 53

COUNTERS = ("num_timesteps", "num_fitted", "_episode_num", "_episode_index", "_explored_episode")


def collect(agent: Any, *, gives_up: bool = False) -> Checkpoint:
    """Everything of an `MPCAgent` that goes into its file.

    Args:
        agent: the agent.
        gives_up: the running episode will not go on, because it failed.
    """
    boxes = {"observation_space": agent.observation_space, "action_space": agent.action_space}
    bounds = {f"{name}.low": torch.tensor(box.low) for name, box in boxes.items()}
    bounds |= {f"{name}.high": torch.tensor(box.high) for name, box in boxes.items()}
    plan = dict(zip(("plan.mean", "plan.std", "plan.age"), map(torch.from_numpy, pack([agent._carried])), strict=True))
    tensors = {
        "dynamics": agent.dynamics.state_dict(),
        "transitions": agent.store.state_dict(),
        "generators": agent.generators.state_dict(),
        "agent": bounds | plan | {f"record.{name}": value for name, value in agent._record.state_dict().items()},
    }
    goes_on = agent._last_obs is not None and not gives_up
    if goes_on:
        tensors["agent"] |= {
            "last_observation": torch.tensor(agent._last_obs),
            "last_episode_starts": torch.tensor(agent._last_episode_starts),
        }
    spec = offered_by(agent.env, "spec")
    start = describe_start(agent.env)
    config = {
        "class": type(agent).__name__,
        "arguments": {name: encode(getattr(agent, name)) for name in agent.saved_arguments},
        "seeds_environment": agent.seeds_environment,
        "environment": None if spec is None else spec.id,
        "space_dtypes": {name: str(box.dtype) for name, box in boxes.items()},
        "counters": {name: getattr(agent, name) for name in COUNTERS},
        "episode": None if start is None else {**start, "goes_on": goes_on},
        "pending_logs": [(n, _json_number(v), count, e) for n, v, count, e in pending_logs(agent)],
        "log_run": agent._log_run,
        "episode_infos": [_plain(info) for info in agent.ep_info_buffer or ()][-MAX_EPISODE_INFOS:],
        "episode_successes": [float(success) for success in agent.ep_success_buffer or ()],
        "values": {part: _without_tensors(state) for part, state in tensors.items()},
        "versions": {name: _version(name) for name in PACKAGES},
    }
    return Checkpoint(config, {part: _only_tensors(state) for part, state in tensors.items()})


def load_agent(
    asked: Any,
    path: CheckpointPath,
    env: GymEnv | str | None,
    device: torch.device | str,
    force_reset: bool,
    replaced: dict[str, Any],
) -> Any:
    """Make the agent that a file holds; see `PlanningAgent.load`.

    Args:
        asked: the class whose `load` was called.
        path: the file.
        env: the environment to go on in, or None.
        device: where planning computes.
        force_reset: begin a new episode when learning goes on, instead of the one that was running.
        replaced: constructor arguments in place of the saved ones.

    Raises:
        CheckpointError: the file cannot be read, holds something else, or does not fit ``env``.
    """
    checkpoint = read_checkpoint(path)
    agent_class = _class_of(checkpoint, asked)
    arguments = saved_arguments(checkpoint, agent_class) | replaced
    both_spaces = saved_spaces(checkpoint)
    if env is not None:
        env = wrapped_env(env)
        if (env.observation_space, env.action_space) != both_spaces:
            raise CheckpointError(
                f"the agent was saved for observations {both_spaces[0]} and actions {both_spaces[1]}, "
                f"the environment has {env.observation_space} and {env.action_space}"
            )
    try:
        agent = agent_class(env, device=device, _init_setup_model=False, **arguments)
        agent.observation_space, agent.action_space = both_spaces
        agent.n_envs = 1
        agent._setup_model()
    except DGPMPCError:
        raise
    except Exception as error:
        raise CheckpointError(f"no {agent_class.__name__} can be made with {arguments}: {error}") from error
    restore(agent, checkpoint, keep_generators="seed" not in replaced, force_reset=force_reset)
    if agent.env is not None and agent.seeds_environment and force_reset:
        # Not the seed itself: an environment that is seeded with it again repeats the episodes of the first run.
        agent.env.seed(derive_seed(agent.seed, "environment", agent.num_timesteps))
    return agent


def _class_of(checkpoint: Checkpoint, asked: type) -> Any:
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


def restore(agent: Any, checkpoint: Checkpoint, *, keep_generators: bool = True, force_reset: bool = True) -> None:
    """Put a file's contents into an agent of the same arguments; see `load_agent`.

    Raises:
        CheckpointError: they do not fit. The agent may hold a part of them then, and must not be used.
    """
    config, parts, _ = checkpoint
    try:
        values = {
            part: {name: _number(value) for name, value in held.items()} for part, held in config["values"].items()
        }
        state: dict[str, Any] = {part: {**tensors, **values.get(part, {})} for part, tensors in parts.items()}
        agent.dynamics.load_state_dict(state["dynamics"])
        agent.store.load_state_dict(state["transitions"])
        if keep_generators:
            agent.generators.load_state_dict(state["generators"])
        agent.seeds_environment = bool(config["seeds_environment"])
        for name in COUNTERS:
            count = config["counters"][name]
            if not isinstance(count, int) or not 0 <= count <= MAX_COUNT:
                raise CheckpointError(f"the file's counter {name} = {count} is none")
            setattr(agent, name, type(getattr(agent, name))(count))
        agent.ep_info_buffer = deque(config["episode_infos"], maxlen=agent.stats_window_size)
        agent.ep_success_buffer = deque(config["episode_successes"], maxlen=agent.stats_window_size)
        own = state["agent"]
        carried = tuple(own[name].numpy() for name in ("plan.mean", "plan.std", "plan.age"))
        (agent._carried,) = unpack(carried, agent.planning.cold, 1, agent.actions_per_plan)
        if checkpoint.schema > 1:
            agent._record.number = agent._episode_num + 1
            agent._record.load_state_dict({k.removeprefix("record."): v for k, v in own.items() if "record." in k})
            log_run = config["log_run"]
            if log_run is not None and not re.fullmatch(r"[^./\\][^/\\]{0,200}", log_run):
                raise CheckpointError(f"the file's log_run = {log_run!r} is no folder's name")
            agent._log_run = log_run
            agent._pending_logs = [(str(n), _number(v), int(c), e) for n, v, c, e in config["pending_logs"]]
        if not force_reset and "last_observation" in own:
            agent._last_obs = own["last_observation"].numpy()
            agent._last_episode_starts = own["last_episode_starts"].numpy()
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(f"the file does not fit a {type(agent).__name__} of its arguments: {error!r}") from error


def encode(value: Any) -> Any:
    return {"observation_spec": asdict(value)} if isinstance(value, ObservationSpec) else value


def _decode(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    try:
        fields = value["observation_spec"].items()
        return ObservationSpec(**{name: tuple(map(int, indices)) for name, indices in fields})
    except Exception as error:
        raise CheckpointError(f"the file holds an argument that cannot be read: {value}") from error


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
    """JSON has no NaN and no infinity."""
    return {"float": str(value)} if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Any) -> Any:
    """The inverse of `_json_number`."""
    return float(value["float"]) if isinstance(value, dict) else value


def _plain(info: dict[str, Any]) -> dict[str, float]:
    """Monitor's summary of an episode; what else users put into it may not be a number and is left out."""
    numbers = {name: float(value) for name, value in info.items() if isinstance(value, int | float | np.number)}
    return {name: number for name, number in numbers.items() if math.isfinite(number)}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package.replace("_", "-"))
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
