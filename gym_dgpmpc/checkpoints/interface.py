"""What checkpoints need of an agent: its arguments, the nouns that it keeps, and where its environments are."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import StateDict, Stateful


@dataclass(frozen=True)
class StateOf:
    """A `Stateful` of two functions, for what an agent keeps itself."""

    get: Callable[[], StateDict]
    put: Callable[[StateDict], None]

    def state_dict(self) -> StateDict:
        return self.get()

    def load_state_dict(self, state: StateDict) -> None:
        self.put(state)


@runtime_checkable
class Logging(Stateful, Protocol):
    """The logs of an agent."""

    run: str | None
    """The folder that a run logs in, under ``tensorboard_log``."""

    def choose_run(self, tb_log_name: str) -> None: ...


@runtime_checkable
class Checkpointed(Protocol):
    """An agent that can be saved, and go on from what was saved."""

    observation_space: spaces.Box
    action_space: spaces.Box
    n_envs: int
    seed: int
    env: VecEnv | None
    seeds_environment: bool
    num_timesteps: int
    num_fitted: int
    tensorboard_log: str | None
    device: torch.device
    store: TransitionStore
    task: Task
    logs: Any  # a `Logging`; a Protocol's attribute cannot be a narrower type in its implementation
    _last_obs: Any
    _last_episode_starts: np.ndarray | None

    def arguments(self) -> dict[str, Any]:
        """The constructor's plain arguments, "planner" by name among them."""
        ...

    def nouns(self) -> dict[str, Stateful]:
        """What a checkpoint holds, in the order in which it is restored."""
        ...

    def begin_at(self, observation: np.ndarray | None, episode_starts: np.ndarray | None = None) -> None:
        """Let learning go on from these observations; None lets it begin new episodes."""
        ...


def running_episode(agent: Checkpointed) -> int:
    """The number in the store of the episode that runs in the first environment."""
    return int(agent.nouns()["episodes"].state_dict()["0.index"])
