"""What an agent's file holds, and how an agent is made from it again.

Saved: the constructor's plain arguments, the spaces, everything learned (all kept posterior samples, normaliser,
data), counters, the state of every generator, the running plan, and of the running episode its beginning and its
record. Not saved: a reward or termination function (the environment offers it, or `load` is given it again), the
environment itself, and of a plain `MPCAgent` the objects it was composed of.

`load` makes an agent from a file; `resuming.py` puts a run's agent and environment back to where they were.
"""

import importlib.metadata
import math
import re
from collections import deque
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.type_aliases import GymEnv
from torch import Tensor

from gym_dgpmpc.agents.checkpoint import Checkpoint, CheckpointPath, read_checkpoint
from gym_dgpmpc.agents.dict_observations import layout
from gym_dgpmpc.agents.env_state import describe_start, options_to_reset, set_options
from gym_dgpmpc.agents.plan_state import pack, unpack
from gym_dgpmpc.agents.randomness import derive_seed
from gym_dgpmpc.agents.saved import MAX_COUNT, asked_to_learn, class_of, saved_arguments, saved_running, saved_spaces
from gym_dgpmpc.agents.task import LEARNED, environment_id, wrapped_env
from gym_dgpmpc.errors import CheckpointError, DGPMPCError, UnknownRewardError
from gym_dgpmpc.types import ObservationSpec, StateDict

PACKAGES = ("gym_dgpmpc", "gymnasium", "numpy", "stable_baselines3", "torch")
MAX_EPISODE_INFOS = 10_000

COUNTERS = ("num_timesteps", "num_fitted", "_episode_num")


def collect(agent: Any, *, gives_up: bool = False) -> Checkpoint:
    """Everything of an `MPCAgent` that goes into its file.

    Args:
        agent: the agent.
        gives_up: the running episode will not go on, because it failed.
    """
    boxes = {"observation_space": agent.observation_space, "action_space": agent.action_space}
    bounds = {f"{name}.low": torch.tensor(box.low) for name, box in boxes.items()}
    bounds |= {f"{name}.high": torch.tensor(box.high) for name, box in boxes.items()}
    running = agent._running
    carried = pack([episode.carried for episode in running])
    plan = dict(zip(("plan.mean", "plan.std", "plan.age"), map(torch.from_numpy, carried), strict=True))
    records = {
        f"record.{index}.{name}": value
        for index, episode in enumerate(running)
        for name, value in episode.record.state_dict().items()
    }
    tensors = {
        "dynamics": agent.dynamics.state_dict(),
        "transitions": agent.store.state_dict(),
        "generators": agent.generators.state_dict(),
        "agent": bounds | plan | records,
    }
    goes_on = agent._last_obs is not None and not gives_up
    if goes_on:
        tensors["agent"] |= {
            "last_observation": torch.tensor(agent._last_obs),
            "last_episode_starts": torch.tensor(agent._last_episode_starts),
        }
    start = describe_start(agent.env)
    config = {
        "class": type(agent).__name__,
        "arguments": {name: encode(getattr(agent, name)) for name in agent.saved_arguments},
        "to_learn": to_learn(agent),
        "modelled": {"reward": agent.modelled.reward, "terminated": agent.modelled.terminated},
        "observation_parts": {key: [part.start, part.stop] for key, part in layout(agent.env).items()},
        "seeds_environment": agent.seeds_environment,
        "environment": environment_id(agent.env),
        "space_dtypes": {name: str(box.dtype) for name, box in boxes.items()},
        "counters": {name: getattr(agent, name) for name in COUNTERS},
        "running": [{"index": episode.index, "has_explored": episode.has_explored} for episode in running],
        "reset_options": options_to_reset(agent.env, again=True),
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
    agent_class = class_of(checkpoint, asked)
    arguments = saved_arguments(checkpoint, agent_class) | asked_to_learn(checkpoint) | replaced
    both_spaces = saved_spaces(checkpoint)
    if env is not None:
        env = wrapped_env(env)
        if (env.observation_space, env.action_space) != both_spaces:
            raise CheckpointError(
                f"the agent was saved for observations {both_spaces[0]} and actions {both_spaces[1]}, "
                f"the environment has {env.observation_space} and {env.action_space}"
            )
        parts, present = checkpoint.config.get("observation_parts") or {}, layout(env)
        if parts and present and parts != {key: [part.start, part.stop] for key, part in present.items()}:
            raise CheckpointError(
                f"the agent was saved for Dict observations of {parts}, the environment has {present}"
            )
    try:
        agent = agent_class(env, device=device, _init_setup_model=False, **arguments)
        agent.observation_space, agent.action_space = both_spaces
        agent.n_envs = len(saved_running(checkpoint)) if env is None else env.num_envs
        agent._setup_model()
    except DGPMPCError:
        raise
    except Exception as error:
        raise CheckpointError(f"no {agent_class.__name__} can be made with {arguments}: {error}") from error
    restore(agent, checkpoint, keep_generators="seed" not in replaced, force_reset=force_reset)
    if agent.env is not None:
        _ = agent.task  # an error if the reward that was given is missing
    if agent.env is not None and agent.seeds_environment and force_reset:
        # Not the seed itself: an environment that is seeded with it again repeats the episodes of the first run.
        agent.env.seed(derive_seed(agent.seed, "environment", agent.num_timesteps))
    if agent.env is not None and force_reset:
        set_options(agent.env, checkpoint.config.get("reset_options"))
    return agent


def to_learn(agent: Any) -> dict[str, bool]:
    """Which of reward and termination the user asked to be learned whatever the environment offers."""
    return {name: getattr(agent, f"given_{name}") == LEARNED for name in ("reward_fn", "terminated_fn")}


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
        modelled = config.get("modelled", {"reward": False, "terminated": False})
        if modelled != {"reward": agent.modelled.reward, "terminated": agent.modelled.terminated}:
            _model_as_saved(agent, modelled)
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
        _restore_running(agent, checkpoint, own)
        if checkpoint.schema > 1:
            log_run = config.get("log_run")
            if log_run is not None and not re.fullmatch(r"[^./\\][^/\\]{0,200}", log_run):
                raise CheckpointError(f"the file's log_run = {log_run!r} is no folder's name")
            agent._log_run = log_run
            agent._pending_logs = [(str(n), _number(v), int(c), e) for n, v, c, e in config["pending_logs"]]
        if not force_reset and "last_observation" in own and len(own["last_observation"]) == agent.n_envs:
            agent._last_obs = own["last_observation"].numpy()
            agent._last_episode_starts = own["last_episode_starts"].numpy()
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(f"the file does not fit a {type(agent).__name__} of its arguments: {error!r}") from error


def _model_as_saved(agent: Any, modelled: dict[str, bool]) -> None:
    """Make the agent's model anew, to predict what the saved one did."""
    try:
        agent.new_model(reward=bool(modelled["reward"]), terminated=bool(modelled["terminated"]))
    except UnknownRewardError as error:
        raise CheckpointError(
            "the file's model predicts the reward or termination too: pass dynamics=... as the function that made it"
        ) from error


def _restore_running(agent: Any, checkpoint: Checkpoint, own: dict[str, Any]) -> None:
    """The running episodes; those of another number of environments than the agent has now are given up."""
    saved = saved_running(checkpoint)
    carried = tuple(own[name].numpy() for name in ("plan.mean", "plan.std", "plan.age"))
    plans = unpack(carried, agent.planning.cold, len(saved), agent.actions_per_plan)
    if len(saved) != agent.n_envs:
        has_explored = all(episode["has_explored"] for episode in saved)
        agent._running = agent._no_episodes(has_explored=has_explored)
        return
    for index, (running, plan, episode) in enumerate(zip(agent._running, plans, saved, strict=True)):
        running.carried, running.index, running.has_explored = plan, episode["index"], episode["has_explored"]
        if checkpoint.schema > 1:
            prefix = f"record.{index}." if checkpoint.schema > 2 else "record."
            running.record.number = agent._episode_num + 1
            running.record.load_state_dict(
                {name.removeprefix(prefix): value for name, value in own.items() if name.startswith(prefix)}
            )


def encode(value: Any) -> Any:
    """An argument as JSON has it, where a tuple is a list."""
    if isinstance(value, ObservationSpec):
        return {"observation_spec": asdict(value)}
    return list(value) if isinstance(value, tuple) else value


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
