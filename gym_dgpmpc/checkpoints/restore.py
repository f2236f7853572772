"""How an agent is made again from what `saving.py` put into its file.

`load_agent` makes one; `restore` fills one that is made, which is also how a run goes on (`resuming.py`).
"""

import re
import warnings
from collections import deque
from typing import Any

import torch
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from gym_dgpmpc.agents.recent_episodes import restore_recent_episodes
from gym_dgpmpc.checkpoints.collect import ABOUT_ENVIRONMENT, COUNTERS
from gym_dgpmpc.checkpoints.format import Checkpoint, CheckpointPath, read_checkpoint
from gym_dgpmpc.checkpoints.saved import (
    MAX_COUNT,
    asked_to_learn,
    class_of,
    saved_arguments,
    saved_running,
    saved_spaces,
)
from gym_dgpmpc.errors import CheckpointError, DGPMPCError, ReliabilityWarning, UnknownRewardError
from gym_dgpmpc.planning.plan_state import PlanState, plans_from_tensors
from gym_dgpmpc.randomness import derive_seed, split_seed
from gym_dgpmpc.tasks.dict_observations import layout
from gym_dgpmpc.tasks.replay import set_options
from gym_dgpmpc.tasks.task import wrapped_env


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
    if env is not None:
        env = wrapped_env(env)
        _refuse_another_environment(env, checkpoint)
    try:
        agent = agent_class(env, device=device, _init_setup_model=False, **arguments)
        agent.observation_space, agent.action_space = saved_spaces(checkpoint)
        agent.n_envs = len(saved_running(checkpoint)) if env is None else env.num_envs
        agent._setup_model()
    except DGPMPCError:
        raise
    except Exception as error:
        raise CheckpointError(f"no {agent_class.__name__} can be made with {arguments}: {error}") from error
    restore(agent, checkpoint, keep_seed="seed" not in replaced, force_reset=force_reset)
    if agent.env is not None:
        _ = agent.task  # an error if the reward that was given is missing
    if agent.env is not None and agent.seeds_environment and force_reset:
        # Not the seed itself: an environment that is seeded with it again repeats the episodes of the first run.
        agent.env.seed(derive_seed(agent.seed, "environment", agent.num_timesteps))
    if agent.env is not None and force_reset:
        set_options(agent.env, checkpoint.config.get("reset_options"))
    return agent


def _refuse_another_environment(env: VecEnv, checkpoint: Checkpoint) -> None:
    """Raise a `CheckpointError` if observations or actions are others than those the agent was saved for."""
    both_spaces = saved_spaces(checkpoint)
    if (env.observation_space, env.action_space) != both_spaces:
        raise CheckpointError(
            f"the agent was saved for observations {both_spaces[0]} and actions {both_spaces[1]}, "
            f"the environment has {env.observation_space} and {env.action_space}"
        )
    parts, present = checkpoint.config.get("observation_parts") or {}, layout(env)
    if parts and present and parts != {key: [part.start, part.stop] for key, part in present.items()}:
        raise CheckpointError(f"the agent was saved for Dict observations of {parts}, the environment has {present}")


def restore(agent: Any, checkpoint: Checkpoint, *, keep_seed: bool = True, force_reset: bool = True) -> None:
    """Put a file's contents into an agent of the same arguments; see `load_agent`.

    Args:
        agent: the agent.
        checkpoint: the file's contents.
        keep_seed: go on with the random streams of the file, instead of the agent's own.
        force_reset: as in `load_agent`.

    Raises:
        CheckpointError: they do not fit. The agent may hold a part of them then, and must not be used.
    """
    try:
        states = _states(checkpoint)
        own = states["agent"]
        _restore_learned(agent, checkpoint, states)
        if keep_seed:
            _restore_generators(agent, checkpoint, states["generators"])
            agent.seeds_environment = bool(checkpoint.config["seeds_environment"])
        _restore_logs(agent, checkpoint, own)
        _restore_running(agent, checkpoint, own)
        agent._about_environment = {
            name: checkpoint.config[name] for name in ABOUT_ENVIRONMENT if name in checkpoint.config
        }
        agent._had_terminated_fn = bool(checkpoint.config.get("has_terminated_fn", False))
        if not force_reset and "last_observation" in own and len(own["last_observation"]) == agent.n_envs:
            agent._last_obs = own["last_observation"].numpy()
            agent._last_episode_starts = own["last_episode_starts"].numpy()
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(f"the file does not fit a {type(agent).__name__} of its arguments: {error!r}") from error


def _states(checkpoint: Checkpoint) -> dict[str, Any]:
    """The state of each part: its tensors, and its plain values."""
    values = checkpoint.config["values"]
    return {
        part: {**tensors, **{name: _from_json(value) for name, value in values.get(part, {}).items()}}
        for part, tensors in checkpoint.tensors.items()
    }


def _restore_learned(agent: Any, checkpoint: Checkpoint, states: dict[str, Any]) -> None:
    """The model, the data it learned from, and the counters."""
    modelled = checkpoint.config.get("modelled", {"reward": False, "terminated": False})
    if modelled != {"reward": agent.modelled.reward, "terminated": agent.modelled.terminated}:
        _model_as_saved(agent, modelled)
    agent.dynamics.load_state_dict(states["dynamics"])
    agent.store.load_state_dict(states["transitions"])
    for name in COUNTERS:
        count = checkpoint.config["counters"][name]
        if not isinstance(count, int) or not 0 <= count <= MAX_COUNT:
            raise CheckpointError(f"the file's counter {name} = {count} is none")
        setattr(agent, name, type(getattr(agent, name))(count))


def _restore_generators(agent: Any, checkpoint: Checkpoint, state: dict[str, Tensor]) -> None:
    """The random streams; on another kind of device, whose generators are others, new ones that the seed decides."""
    saved_on, device = checkpoint.config.get("device", agent.device.type), agent.device.type
    if saved_on == device:
        agent.generators.load_state_dict(state)
        return
    warnings.warn(
        f"the agent was saved on the device {saved_on!r}, whose random numbers {device!r} cannot go on with: it begins "
        "new ones, and goes on otherwise than it would have there",
        ReliabilityWarning,
        stacklevel=2,
    )
    seed = checkpoint.config["arguments"]["seed"]  # which a run's agent without one takes over only later
    agent.generators = split_seed(derive_seed(seed, "other_device", agent.num_timesteps), agent.device)


def _restore_logs(agent: Any, checkpoint: Checkpoint, own: dict[str, Any]) -> None:
    """What logged means are over, and what was not logged yet."""
    config = checkpoint.config
    if checkpoint.schema < 4:
        agent.ep_info_buffer = deque(config["episode_infos"], maxlen=agent.stats_window_size)
        agent.ep_success_buffer = deque(config["episode_successes"], maxlen=agent.stats_window_size)
    else:
        restore_recent_episodes(agent, own)
    if checkpoint.schema < 2:
        return
    log_run = config.get("log_run")
    if log_run is not None and not re.fullmatch(r"[^./\\][^/\\]{0,200}", log_run):
        raise CheckpointError(f"the file's log_run = {log_run!r} is no folder's name")
    agent._log_run = log_run
    agent._pending_logs = [(str(n), _from_json(v), int(c), e) for n, v, c, e in config["pending_logs"]]


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
    plans = _saved_plans(agent, checkpoint, own)
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


def _saved_plans(agent: Any, checkpoint: Checkpoint, own: dict[str, Any]) -> list[PlanState]:
    """The plan of each saved episode; a cold one where the agent looks ahead otherwise, or replans sooner."""
    cold, count = agent.planning.cold, len(saved_running(checkpoint))
    fields = {f"plan.{name}": value.shape for name, value in cold.plan._asdict().items()}
    if any(own[name].shape[1:] != shape for name, shape in fields.items()):
        return [cold] * count
    actions_per_plan = checkpoint.config["arguments"].get("actions_per_plan", agent.actions_per_plan)
    plans = plans_from_tensors(own, cold, count, actions_per_plan)
    return [plan if plan.age < agent.actions_per_plan else cold for plan in plans]


def _from_json(value: Any) -> Any:
    """The inverse of `_json_number`."""
    return float(value["float"]) if isinstance(value, dict) else value
