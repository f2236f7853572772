"""A planning agent in its environments: what to do next, doing it, and keeping what happened.

`mpc.py` puts these steps together to the algorithm that learns.
"""

from contextlib import suppress
from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import GymEnv

from gym_dgpmpc.agents.base import PlanningAgent
from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.agents.running import RunningEpisode, next_episode
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import EnvironmentDataError, EnvironmentFailedError
from gym_dgpmpc.tasks.dict_observations import flatten
from gym_dgpmpc.tasks.logged import Logged, read_logged
from gym_dgpmpc.tasks.replay import episode_start


class ActingAgent(PlanningAgent):
    """A planning agent with an episode running in each of its environments; see `MPCAgent` for the arguments."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self._running = self._no_episodes()

    def _no_episodes(self, *, has_explored: bool = False) -> list[RunningEpisode]:
        """Of each environment an episode that has not begun."""
        cold, horizon = self.planning.cold, self.planning.horizon
        return [RunningEpisode(cold, EpisodeRecord(1, horizon), -1, has_explored) for _ in range(self.n_envs)]

    @property
    def episode_records(self) -> list[EpisodeRecord]:
        """Of each environment, what happened so far in its running episode, or in the one that has just ended."""
        return [running.record for running in self._running]

    @property
    def is_exploring(self) -> bool:
        """Whether the next actions are random because there are too few transitions to learn from."""
        if self.is_fitted:
            return False
        if self.learning_starts is None:
            # An episode that never ends must not put off the first training beyond the others.
            enough = self.train_freq is not None and len(self.store) >= self.train_freq
            return not enough and not all(running.has_explored for running in self._running)
        return len(self.store) < self.learning_starts

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        if len(self._running) != self.n_envs:
            has_explored = all(running.has_explored for running in self._running)
            self._running, self._last_obs = self._no_episodes(has_explored=has_explored), None

    set_env.__doc__ = PlanningAgent.set_env.__doc__

    def add_transitions(self, data: Logged, *, scaled_actions: bool | None = None) -> None:
        """Learn from logged transitions too; with some, no random episode is played.

        They count as transitions for ``learning_starts``, but not as timesteps. Training on them is done when `learn`
        begins its next episode.

        Args:
            data: an SB3 `ReplayBuffer` or `DictReplayBuffer`, a Minari dataset, or a mapping of arrays, steps first:
                "observation" [n, S], "action" [n, A], "next_observation" [n, S], "reward" [n] and "terminated" [n]
                (if it is left out, none was). Dict observations are dicts of such. Of a buffer with
                ``optimize_memory_usage`` the last steps of episodes are left out: it does not keep what they led to.
            scaled_actions: whether actions are given in [-1, 1] whatever the action space, as SB3's algorithms keep
                them in their buffers. None: so it is in a `ReplayBuffer`, and in nothing else.

        Raises:
            EnvironmentDataError: a shape, a number that is not finite, or an action out of bounds. Nothing is stored.
            TypeError: the data are none of these.
        """
        rows = read_logged(data, scaled_actions, self.observation_space, self.action_space)
        episode = rows.episode + next_episode(self.store, self._running)
        # First into a store of their own, whose errors count steps from the first one that is added.
        for store in (TransitionStore(self.store.observation_size, self.store.action_size), self.store):
            store.extend(*rows[:3], reward=rows.reward, terminated=rows.terminated, episode=episode)
        for running in self._running:
            running.has_explored = True

    def _plan(self, observations: np.ndarray) -> np.ndarray:
        """The next actions [n, A] of the running episodes' plans, which are made anew when they are used up.

        Each environment is planned for by itself, in worlds that all plans of one moment share.
        """
        task, worlds, actions = self.modelled.task(self.task), self.planning.worlds(self.generators.planning), []
        for running, observation in zip(self._running, observations, strict=True):
            acted = self.planning.act(
                task, self.modelled.start(observation), running.carried, self.generators.planning, worlds
            )
            running.carried = acted.carried
            if acted.info is not None:
                running.record.add_plan(acted.info, acted.seconds, late=acted.late)
            actions.append(acted.action)
        return np.stack(actions)

    def _perform_and_append(
        self, observations: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step the environments and store what they did; a step counts only once it is stored."""
        # Until then there is no observation to go on from: after an error, learn begins a new episode.
        self._last_obs = None
        assert self.env is not None
        start = episode_start(self.env)
        if start is not None:
            start.last_step = None
        try:
            new_obs, rewards, dones, infos = self.env.step(actions.reshape(-1, *self.action_space.shape))
        except Exception as error:
            step = self.num_timesteps
            self._keep_last_step(observations, actions)
            named = isinstance(error, EnvironmentFailedError)
            what = str(error) if named else f"the environment raised {type(error).__name__}: {error}"
            raise EnvironmentFailedError(f"step {step}: {what}") from (error.__cause__ if named else error)
        assert isinstance(new_obs, np.ndarray)
        # At an episode's end the environment has been reset already, and the true next observation is set aside.
        after, terminated = new_obs.copy(), dones.copy()
        for index in np.flatnonzero(dones):
            after[index] = infos[index]["terminal_observation"]
            terminated[index] = not infos[index].get("TimeLimit.truncated", False)
        if self._vec_normalize_env is not None:
            rewards = self._vec_normalize_env.get_original_reward()
        self._append(observations, actions, after, rewards, terminated)
        self._last_obs, self._last_episode_starts = new_obs, dones
        if terminated.any() and self.task.terminated_fn is None and not self.learns_termination:
            self._warn_once(
                "the environment ended an episode by termination, which the planner knows nothing of: pass "
                "terminated_fn=..., or give the environment an attribute of that name"
            )
        return rewards, dones, list(infos)

    def _append(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        after: np.ndarray,
        rewards: np.ndarray,
        terminated: np.ndarray,
    ) -> None:
        episodes = np.array([running.index for running in self._running])
        self.store.extend(observations, actions, after, reward=rewards, terminated=terminated, episode=episodes)
        self.num_timesteps += len(self._running)
        for running, reward, ended in zip(self._running, rewards, terminated, strict=True):
            running.record.add_reward(float(reward), terminated=bool(ended))

    def _keep_last_step(self, observations: np.ndarray, actions: np.ndarray) -> None:
        """Store the step that ended an episode, where it is the reset after it that failed."""
        start = episode_start(self.env)
        if start is None or start.last_step is None or not any(start.last_step[2:4]):
            return
        after, reward, terminated, _, _ = start.last_step
        with suppress(EnvironmentDataError):
            rewards = np.array([reward], dtype=np.float32)
            self._append(observations, actions, np.asarray(flatten(after))[None], rewards, np.array([bool(terminated)]))
            self._running[0].has_explored = True
            self._episode_num += 1

    @property
    def _observations(self) -> np.ndarray:
        """The present observations, [n, S]."""
        assert self._last_obs is not None
        return self._last_obs

    @property
    def _starts(self) -> np.ndarray:
        """Of which environments the present observation is the first of an episode, [n]."""
        assert self._last_episode_starts is not None
        return self._last_episode_starts
