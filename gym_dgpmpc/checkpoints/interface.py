"""What checkpoints need of an agent: its arguments, the nouns that it keeps, and where its environments are."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.settings import Setting
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import Planner, PlannerFactory, StateDict, Stateful


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
class Episode(Protocol):
    """An episode that is running in an environment."""

    index: int
    """Its number in the store."""


@runtime_checkable
class Episodes(Stateful, Protocol):
    """The episodes that are running in an agent's environments."""

    @property
    def running(self) -> Sequence[Episode]:
        """One of each environment."""
        ...


@runtime_checkable
class HasSettings(Protocol):
    """An agent, or the class of one."""

    def saved_settings(self, planner: str | PlannerFactory | Planner) -> dict[str, Setting]:
        """The constructor arguments that a file holds, of an agent with this planner."""
        ...


@runtime_checkable
class Checkpointed(HasSettings, Protocol):
    """An agent that can be saved, and go on from what was saved."""

    # Of Stable-Baselines3's algorithms.
    observation_space: spaces.Box
    action_space: spaces.Box
    env: VecEnv | None
    n_envs: int
    num_timesteps: int
    seed: int
    tensorboard_log: str | None
    device: torch.device
    _last_episode_starts: np.ndarray | None

    store: TransitionStore
    task: Task
    num_fitted: int
    seeds_environment: bool

    def _setup_model(self) -> None: ...

    # What a protocol names as an attribute must have the very type; of a property it may be a narrower one.

    @property
    def logs(self) -> Logging: ...

    @property
    def collector(self) -> Episodes: ...

    @property
    def has_running_episode(self) -> bool:
        """Whether learning can go on where the environments are."""
        ...

    @property
    def planner_given(self) -> str | PlannerFactory | Planner:
        """The planner as the constructor was given it."""
        ...

    def arguments(self) -> dict[str, Any]:
        """The constructor's plain arguments; "planner" by name, None if it was given otherwise."""
        ...

    def nouns(self) -> dict[str, Stateful]:
        """What a checkpoint holds, in the order in which it is restored."""
        ...

    def begin_at(self, observation: np.ndarray | None, episode_starts: np.ndarray | None = None) -> None:
        """Let learning go on from these observations; None lets it begin new episodes."""
        ...


@runtime_checkable
class AgentClass(HasSettings, Protocol):
    """The class of such an agent."""

    def __call__(self, *args: Any, **kwargs: Any) -> Checkpointed: ...
