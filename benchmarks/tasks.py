"""The tasks of the benchmarks: an environment, and the arguments that it and its agents get."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium

from gym_dgpmpc.envs.registration import ENVIRONMENTS


@dataclass(frozen=True)
class Task:
    """A task, as plain data, so that it can be sent to another machine.

    Attributes:
        name: the environment's id; what was changed about it, if anything, after a colon.
        episode_steps: steps after which an episode is truncated.
        env_id: id for `gymnasium.make`; "" stands for the name up to the colon.
        presets_of: the environment whose presets it has; "" stands for the name up to the colon.
        arguments: arguments of the environment.
        for_planning: arguments of agents that plan with a model.
        for_model_free: further arguments of the environment for agents without a model.
        idle_return: what doing nothing earns, the mean over the episodes of a benchmark, where random actions earn so
            much less that returns scaled from them would all look alike.
    """

    name: str
    episode_steps: int
    env_id: str = ""
    presets_of: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    for_planning: Mapping[str, Any] = field(default_factory=dict)
    for_model_free: Mapping[str, Any] = field(default_factory=dict)
    idle_return: float | None = None

    @property
    def preset(self) -> str:
        """The key of its presets."""
        return self.presets_of or self.name.partition(":")[0]

    def make(self, *, model_free: bool = False) -> gymnasium.Env:
        """The environment, for an agent of one kind or the other."""
        env_id = self.env_id or self.name.partition(":")[0]
        return gymnasium.make(env_id, **self.arguments, **(self.for_model_free if model_free else {}))


LEARNED_REWARD = {"reward_fn": "learned"}

FOR_MODEL_FREE: Mapping[str, Mapping[str, Any]] = {"RiskSensitiveHalfCheetah-v0": {"penalise_step": True}}
"""Agents without a model see the risk in the returned reward alone; results hold the task's own reward all the same."""


IDLE_RETURNS = {"BiasedReacher-v0": -76.193}
"""Of tasks whose random actions cost most of what they earn. The targets of an episode depend on its number alone, so
this is the same for every seed."""


def _shipped(env_id: str, change: str = "") -> Task:
    """One of the package's environments; ``change`` says what is different about it."""
    of_model_free, idle = FOR_MODEL_FREE.get(env_id, {}), IDLE_RETURNS.get(env_id)
    return Task(env_id + change, ENVIRONMENTS[env_id][1], for_model_free=of_model_free, idle_return=idle)


NO_PRESETS = "none"
"""Of a task that is played as one that nobody has seen before, a user's own."""


def _unknown(env_id: str, episode_steps: int) -> Task:
    """A task without its presets."""
    return Task(f"{env_id}:no presets", episode_steps, presets_of=NO_PRESETS)


ALL_TASKS = (
    *map(_shipped, ENVIRONMENTS),
    _shipped("RiskSensitiveHalfCheetah-v0", ":50 episodes"),
    Task("Pendulum-v1", 200),
    Task("Pendulum-v1:learned reward", 200, for_planning=LEARNED_REWARD),
    Task("InvertedPendulum-v5", 1000),
    Task("InvertedDoublePendulum-v5", 1000),
    Task("Reacher-v5", 50),
    Task("Swimmer-v5", 1000),
    Task("FetchReachDense-v4", 50, env_id="gym_dgpmpc.envs.robotics:FetchReachDense-v4"),
    Task("OutsideCartPole-v0", 60, env_id="benchmarks.outside:OutsideCartPole-v0"),
    _unknown("ModCartPole-v0", 200),
    _unknown("Pendulum-v1", 200),
    _unknown("Reacher-v5", 50),
)

TASKS: Mapping[str, Task] = {task.name: task for task in ALL_TASKS}
"""All tasks by name."""
