"""What an agent's file and a run's folder hold, as plain values, without the environment.

Everything is read from the file itself, so that an agent can be looked into which could not be made here: one of a
class, a planner or a kernel of the user's. Only what the model says of its fit needs the agent.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.checkpoints.arguments import class_of, encode
from gym_dgpmpc.checkpoints.folder import NEWEST
from gym_dgpmpc.checkpoints.format import Checkpoint, read_checkpoint
from gym_dgpmpc.checkpoints.restore import about_environment, saved_num_envs, saved_spaces
from gym_dgpmpc.checks import saved_count
from gym_dgpmpc.errors import CheckpointError, DGPMPCError
from gym_dgpmpc.planning.registry import PLANNERS
from gym_dgpmpc.runs.folder import EPISODES_FILE, SETTINGS_FILE, read_rows, read_settings
from gym_dgpmpc.tasks.functions import LEARNED, NEVER
from gym_dgpmpc.types import ReportsDiagnostics

SPEC = "observation_spec"
"""The one setting that an agent finds for itself: how its model reads the observation."""
NOT_SAID = "a function; files of older versions do not say whose"


def inspect_agent(file: Path) -> dict[str, Any]:
    """What a file holds of its agent.

    Returns:
        Plain values, all finite: what is not, such as the bounds of an unbounded observation, is a text that `float`
        reads. "settings" has for each a "value", the "default" and whether it "differs", None where nobody here knows
        the default; "diagnostics" what the model says of its fit, or "diagnostics_missing" why it could not be asked.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: it is not one of an agent, or is damaged.
    """
    checkpoint = read_checkpoint(file)
    data = _data(checkpoint)
    content: dict[str, Any] = {
        "file": str(file),
        "bytes": file.stat().st_size,
        "schema": checkpoint.schema,
        "class": checkpoint.config.get("class"),
        "environment": about_environment(checkpoint).get("environment"),
        "num_envs": saved_num_envs(checkpoint),
        "spaces": _spaces(checkpoint),
        **_task(checkpoint),
        "data": data,
        "training": _training(checkpoint, data["num_transitions"]),
        "settings": {name: each for name, each in _settings(checkpoint).items() if name != SPEC},
        "versions": checkpoint.config.get("versions", {}),
    }
    return content | _diagnostics(file)


def inspect_run(folder: Path) -> dict[str, Any]:
    """What a run's folder says of the run, beside its agent.

    Returns:
        Plain values; none if the folder has no `settings.json`.

    Raises:
        ValueError: a file cannot be read.
    """
    if not (folder / SETTINGS_FILE).exists():
        return {}
    content = read_settings(folder)
    run: dict[str, Any] = {
        name: content[name] for name in ("started", "revision", "machine", "command") if name in content
    }
    run |= {f"{name}_asked": content.get(name) for name in ("episodes", "timesteps")}
    rows = read_rows(folder / EPISODES_FILE)
    planned = [row.episode_return for row in rows if row.actions == "planned"]
    run |= {"num_random_episodes": len(rows) - len(planned), "num_planned_episodes": len(planned)}
    if planned:
        run["returns"] = {"mean": float(np.mean(planned)), "best": max(planned), "last": planned[-1]}
    return {
        "folder": str(folder),
        **run,
        "seconds": sum(row.seconds for row in rows),
        "versions": content.get("versions", {}),
    }


def inspect(path: Path) -> dict[str, Any]:
    """`inspect_agent` of a file; of a run's folder, that of its agent with `inspect_run` under "run".

    Raises:
        FileNotFoundError: there is no agent's file.
        ValueError, CheckpointError: see the two.
    """
    if not path.is_dir():
        return inspect_agent(path)
    return inspect_agent(path / NEWEST) | {"run": inspect_run(path)}


def _plain(value: Any) -> Any:
    """As JSON has it, which knows no infinity."""
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value


def _spaces(checkpoint: Checkpoint) -> dict[str, Any]:
    observation, action = saved_spaces(checkpoint)
    parts = about_environment(checkpoint).get("observation_parts") or {}
    arguments = checkpoint.config.get("arguments")
    spec = arguments.get(SPEC) if isinstance(arguments, dict) else None
    read_as = spec.get(SPEC, {}) if isinstance(spec, dict) else {}  # as `encode` has it
    return {"observation": _box(observation) | {"parts": parts, "read_as": read_as}, "action": _box(action)}


def _box(space: spaces.Box) -> dict[str, Any]:
    bounds = {"low": _plain(space.low.tolist()), "high": _plain(space.high.tolist())}
    return {"shape": list(space.shape), "dtype": str(space.dtype), **bounds}


def _task(checkpoint: Checkpoint) -> dict[str, Any]:
    """Where reward and termination come from, in the words of `tasks.functions.Source`."""
    state = checkpoint.state("task")
    sources = state.get("sources") or {}
    reward = sources.get("reward_fn") or (LEARNED if state.get("reward") else NOT_SAID)
    terminated = sources.get("terminated_fn")
    if state.get("never_terminates"):
        terminated = NEVER
    elif terminated is None and state.get("has_terminated_fn"):
        terminated = NOT_SAID
    elif terminated is None:
        terminated = LEARNED if state.get("terminated") else f"{NEVER}, or {LEARNED} once an episode has terminated"
    elif terminated == LEARNED and not state.get("terminated"):
        terminated = f"{LEARNED}, once an episode has terminated"
    return {"reward": reward, "termination": terminated}


def _data(checkpoint: Checkpoint) -> dict[str, Any]:
    state = checkpoint.state("transitions")
    episodes, rewards, terminated = (_numbers(state, name) for name in ("episode", "reward", "terminated"))
    lengths = torch.unique(episodes, return_counts=True)[1].tolist()
    return {
        "num_transitions": len(episodes),
        "num_episodes": len(lengths),
        "shortest_episode": min(lengths, default=0),
        "longest_episode": max(lengths, default=0),
        "num_terminated": int(terminated.sum()),
        "mean_reward": float(rewards.double().mean()) if len(rewards) else None,
    }


def _numbers(state: Mapping[str, Any], name: str) -> Tensor:
    value = state.get(name)
    if not isinstance(value, Tensor):
        raise CheckpointError(f"the file's transitions have no {name}")
    return value


def _training(checkpoint: Checkpoint, num_transitions: int) -> dict[str, Any]:
    state, episode = checkpoint.state("progress"), checkpoint.config.get("episode")
    num_learned = saved_count("num_fitted", state.get("num_fitted"))
    goes_on = isinstance(episode, dict) and episode.get("goes_on") is True
    return {
        "num_timesteps": saved_count("num_timesteps", state.get("num_timesteps")),
        "num_learned": num_learned,
        "num_not_learned": max(num_transitions - num_learned, 0),
        "steps_of_running_episode": episode["num_steps"] if isinstance(episode, dict) and goes_on else None,
    }


def _settings(checkpoint: Checkpoint) -> dict[str, dict[str, Any]]:
    received = checkpoint.config.get("arguments")
    if not isinstance(received, dict):
        raise CheckpointError(f"the file's arguments must be an object, got {received!r}")
    defaults = _defaults(checkpoint, received.get("planner"))
    return {
        name: {
            "value": value,
            "default": defaults.get(name),
            "differs": value != defaults[name] if name in defaults else None,
        }
        for name, value in received.items()
    }


def _defaults(checkpoint: Checkpoint, planner: Any) -> dict[str, Any]:
    """Those of the agent that the file names, as JSON has them; none if it is of a class that only its user has."""
    try:
        agent: Any = class_of(checkpoint, MPCAgent)
    except CheckpointError:
        return {}
    is_known = isinstance(planner, str) and planner in PLANNERS
    settings = agent.saved_settings(planner if is_known else "cem")
    defaults = {name: encode(setting.default) for name, setting in settings.items()}
    return {"planner": "cem", **defaults}


def _diagnostics(file: Path) -> dict[str, Any]:
    """What the model says of its fit, if the agent can be made here."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what the agent lacks to go on, which is not asked of it
            dynamics = MPCAgent.load(file).dynamics
            found = dynamics.diagnostics() if isinstance(dynamics, ReportsDiagnostics) else {}
    except DGPMPCError as error:
        return {"diagnostics": {}, "diagnostics_missing": str(error)}
    return {"diagnostics": _plain(dict(found))}
