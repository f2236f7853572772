"""The episodes that run in an agent's environments: taking steps, keeping what happened, and where each episode stands.

`mpc.py` says what to do in each step; here it is done and stored.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float
from numpy import ndarray
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.checks import saved_count
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import EnvironmentDataError, EnvironmentFailedError
from gym_dgpmpc.planning.controller import Controller
from gym_dgpmpc.planning.plan_state import AGE, PlanState, plans_from_tensors, plans_to_tensors
from gym_dgpmpc.tasks.actions import performed
from gym_dgpmpc.tasks.borders import received_batch, terminal_observation, warn_of_shared_memory
from gym_dgpmpc.tasks.dict_observations import flatten
from gym_dgpmpc.tasks.logged import LoggedRows
from gym_dgpmpc.tasks.replay import episode_start
from gym_dgpmpc.types import StateDict


@dataclass
class RunningEpisode:
    """The episode that is running in one environment.

    Attributes:
        carried: its plan.
        record: what happened in it so far.
        index: its number in the store; -1 before the first one.
        has_explored: whether an episode of random actions has ended in this environment.
    """

    carried: PlanState
    record: EpisodeRecord
    index: int = -1
    has_explored: bool = False


class Step(NamedTuple):
    """What the environments returned, as Stable-Baselines3 has it: an ended episode's ``new_obs`` is the next one's."""

    new_obs: Float[ndarray, "n S"]
    rewards: Float[ndarray, "n"]
    dones: Bool[ndarray, "n"]
    infos: list[dict[str, Any]]
    terminated: Bool[ndarray, "n"]


class Collector:
    """Steps the environments and stores what they do; a step counts once it is stored.

    Args:
        store: where to.
        num_envs: n.
        controller: whose plans the episodes carry.
    """

    def __init__(self, store: TransitionStore, num_envs: int, controller: Controller):
        self.store, self._controller = store, controller
        self.running = self._new_episodes(num_envs)
        self._has_warned = False

    def _new_episodes(self, num_envs: int, *, has_explored: bool = False) -> list[RunningEpisode]:
        cold, horizon = self._controller.cold, self._controller.horizon
        return [RunningEpisode(cold, EpisodeRecord(1, horizon), -1, has_explored) for _ in range(num_envs)]

    def resize(self, num_envs: int) -> bool:
        """Go on in another number of environments; False if it is the same number, and nothing has changed."""
        if num_envs == len(self.running):
            return False
        self.running = self._new_episodes(num_envs, has_explored=self.all_explored)
        return True

    @property
    def records(self) -> list[EpisodeRecord]:
        """What happened so far in each environment's running episode, or in the one that has just ended."""
        return [running.record for running in self.running]

    @property
    def all_explored(self) -> bool:
        """Whether an episode of random actions has ended in every environment."""
        return all(running.has_explored for running in self.running)

    @property
    def any_explored(self) -> bool:
        """Whether an episode of random actions has ended in any environment."""
        return any(running.has_explored for running in self.running)

    @property
    def num_given_up(self) -> int:
        """How many episodes were begun anew before one ended, in the environments where none has ended yet."""
        return min((running.index for running in self.running if not running.has_explored), default=0) // len(
            self.running
        )

    def begin_episode(self, index: int, number: int) -> None:
        """A new episode, with a cold plan, in the environment ``index``; ``number`` is what a log calls it."""
        running = self.running[index]
        others = [other for other in self.running if other is not running]
        running.carried = self._controller.cold
        running.record = EpisodeRecord(number, self._controller.horizon)
        running.index = next_episode(self.store, others)

    def add_training(self, metrics: Mapping[str, float]) -> None:
        """Count a training among what the running episodes cost; ``metrics`` are those of `DynamicsModel.fit`."""
        for record in self.records:
            record.training_iterations += int(metrics.get("iterations", 0))

    def end_episode(self, index: int, number: int) -> EpisodeRecord:
        """The record of the episode that has ended in the environment ``index``."""
        running = self.running[index]
        running.has_explored, running.record.number = True, number
        return running.record

    def add_logged(self, rows: LoggedRows) -> None:
        """Store transitions that were logged elsewhere; no random episode is needed then.

        Raises:
            EnvironmentDataError: a row is not finite; nothing is stored.
        """
        episode = rows.episode + next_episode(self.store, self.running)
        # First into a store of their own, whose errors count steps from the first one that is added.
        for store in (TransitionStore(self.store.observation_size, self.store.action_size), self.store):
            store.extend(*rows[:3], reward=rows.reward, terminated=rows.terminated, episode=episode)
        for running in self.running:
            running.has_explored = True

    def step(self, env: VecEnv, observations: ndarray, actions: Float[ndarray, "n A"], number: int) -> Step:
        """Perform the actions and store what they did.

        Args:
            env: the environments.
            observations: the present ones, [n, S].
            actions: of each.
            number: of the step, for the error.

        Raises:
            EnvironmentFailedError: an environment raised an exception, which is the cause.
            EnvironmentDataError: it returned something that is not finite or has another shape; the step is not
                stored, unless it ended an episode and it is the reset after it that did so.
        """
        assert isinstance(env.action_space, spaces.Box)
        given = performed(actions, env.action_space)
        actions = given.reshape(actions.shape).astype(np.float32)
        start = episode_start(env)
        if start is not None:
            start.last_step = None
        try:
            new_obs, rewards, dones, infos = env.step(given)
        except EnvironmentDataError as error:
            self._keep_last_step(env, observations, actions)
            raise EnvironmentDataError(f"step {number}: {error}") from error
        except Exception as error:
            self._keep_last_step(env, observations, actions)
            has_name = isinstance(error, EnvironmentFailedError)
            what = str(error) if has_name else f"the environment raised {type(error).__name__}: {error}"
            raise EnvironmentFailedError(f"step {number}: {what}") from (error.__cause__ if has_name else error)
        new_obs = received_batch(new_obs, observations.shape, "step")
        # At an episode's end the environment has been reset already, and the true next observation is set aside.
        after, terminated = new_obs.copy(), dones.copy()
        for index in np.flatnonzero(dones):
            after[index] = terminal_observation(infos[index], after[index].shape)
            terminated[index] = not infos[index].get("TimeLimit.truncated", False)
        self._has_warned = self._has_warned or warn_of_shared_memory(env, new_obs, after, dones)
        normalize = unwrap_vec_normalize(env)
        if normalize is not None:
            rewards = normalize.get_original_reward()
        self._append(observations, actions, after, rewards, terminated)
        return Step(new_obs, np.array(rewards), np.array(dones), list(infos), terminated)

    def _append(
        self, observations: ndarray, actions: ndarray, after: ndarray, rewards: ndarray, terminated: ndarray
    ) -> None:
        episodes = np.array([running.index for running in self.running])
        self.store.extend(observations, actions, after, reward=rewards, terminated=terminated, episode=episodes)
        for running, reward, ended in zip(self.running, rewards, terminated, strict=True):
            running.record.add_reward(float(reward), terminated=bool(ended))

    def _keep_last_step(self, env: VecEnv, observations: ndarray, actions: ndarray) -> None:
        """Store the step that ended an episode, where it is the reset after it that failed."""
        start = episode_start(env)
        if start is None or start.last_step is None or not any(start.last_step[2:4]):
            return
        after, reward, terminated, _, _ = start.last_step
        with suppress(EnvironmentDataError):
            rewards = np.array([reward], dtype=np.float32)
            self._append(observations, actions, np.asarray(flatten(after))[None], rewards, np.array([bool(terminated)]))
            self.running[0].has_explored = True

    def state_dict(self) -> StateDict:
        """Plans, and whose they are, records and numbers of the running episodes."""
        plans = plans_to_tensors([each.carried for each in self.running])
        state: StateDict = {"planner": self._planner_described(), **plans}
        for i, running in enumerate(self.running):
            state |= {f"{i}.index": running.index, f"{i}.has_explored": running.has_explored}
            state[f"{i}.number"] = running.record.number
            state |= {f"{i}.record.{name}": value for name, value in running.record.state_dict().items()}
        return state

    def _planner_described(self) -> dict[str, Any]:
        """By which another planner's plans are known, or those that look ahead otherwise, as plain values."""
        fields = self._controller.cold.plan._asdict()
        return {
            "class": type(self._controller.planner).__name__,
            "fields": {name: list(value.shape) for name, value in fields.items()},
        }

    def load_state_dict(self, state: StateDict) -> None:
        """Go on with the saved episodes; those of another number of environments are given up.

        Where the agent's planner is another one or looks ahead otherwise, or plans sooner again, plans become cold.

        Raises:
            KeyError, TypeError, ValueError: the state is not one of running episodes.
        """
        num_envs = len(state[AGE])
        if f"{num_envs}.index" in state:
            raise ValueError(f"there are more running episodes than plans, of which there are {num_envs}")
        has_explored = [bool(state[f"{i}.has_explored"]) for i in range(num_envs)]
        if num_envs != len(self.running):
            self.running = self._new_episodes(len(self.running), has_explored=all(has_explored))
            return
        records: dict[str, dict[str, Any]] = defaultdict(dict)
        for name, value in state.items():
            index, is_of_record, field = name.partition(".record.")
            if is_of_record:
                records[index][field] = value
        for i, (running, plan) in enumerate(zip(self.running, self._saved_plans(state), strict=True)):
            running.carried, running.has_explored = plan, has_explored[i]
            running.index = saved_count("the index of a running episode", state[f"{i}.index"], -1)
            running.record.number = saved_count("the number of a running episode", state[f"{i}.number"])
            if str(i) in records:  # files of the first schema have none
                running.record.load_state_dict(records[str(i)])

    def _saved_plans(self, state: StateDict) -> list[PlanState]:
        controller, num_envs = self._controller, len(self.running)
        if state["planner"] != self._planner_described():
            return [controller.cold] * num_envs
        plans = plans_from_tensors(state, controller.cold, num_envs, controller.horizon)
        return [plan if plan.age < controller.actions_per_plan else controller.cold for plan in plans]


def next_episode(store: TransitionStore, running: Sequence[RunningEpisode]) -> int:
    """A number that neither a stored episode has nor one of those that are running."""
    stored = int(store.episodes.max()) + 1 if len(store) else 0
    return max([stored, *(episode.index + 1 for episode in running)])
