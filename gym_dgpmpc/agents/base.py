"""A planning agent as a Stable-Baselines3 algorithm: everything but how it is made and how it learns.

`predict`, logs, `save` and `load`. How it is made is in `composition.py`, how it learns in `mpc.py`.
"""

import time
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info, safe_mean

from gym_dgpmpc.agents.composition import ComposedAgent
from gym_dgpmpc.checkpoints.collect import collect
from gym_dgpmpc.checkpoints.format import CheckpointPath, write_checkpoint
from gym_dgpmpc.checkpoints.restore import load_agent
from gym_dgpmpc.errors import EnvironmentDataError
from gym_dgpmpc.planning.plan_state import PackedPlans, PlanState, pack, unpack
from gym_dgpmpc.randomness import observation_generator
from gym_dgpmpc.tasks.dict_observations import check_parts, flatten, layout
from gym_dgpmpc.tasks.task import (
    flat_size,
)

SelfAgent = TypeVar("SelfAgent", bound="PlanningAgent")


class PlanningAgent(ComposedAgent):
    """What every agent that plans through a learned model offers to SB3's helpers; see `MPCAgent` for the arguments."""

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: PackedPlans | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, PackedPlans]:
        """Plan, and return the action and the plan to pass to the next call.

        Leaves learning untouched: nothing that training draws from or trains is moved. With a ``time_budget`` the plan
        is the best that was found in that time; a plan that took longer all the same is counted in `num_late_plans`,
        and the first one warns.

        Args:
            observation: [S], or [n, S] of n environments; or a dict of such, if the environment's are.
            state: what the last call returned; None plans from scratch.
            episode_start: [n], true where a new episode begins and the state is to be forgotten.
            deterministic: draw worlds and candidates from a generator that depends on the agent's seed and on the
                observation alone, so that the same observation and state give the same action. Otherwise from a
                generator that moves on with every call.

        Returns:
            The action (or n of them), in the action space's shape and dtype, and the state: the plans' fields (of a
            `CEM` mean and standard deviation, [n, H, A]) and their ages [n]. An agent that has not learned yet warns
            once and returns the middle of the action range, or uniformly random actions unless ``deterministic``.

        Raises:
            ValueError: observation or state has the wrong shape, or a dict other parts than the environment's.
            EnvironmentDataError: the observation is not finite.
            UnknownRewardError: the agent was loaded without an environment and without a reward function.
            PlanningError: no candidate plan had a finite return.
        """
        observations, is_batch = self._checked_observations(observation)
        num_envs = len(observations)
        cold = self.planning.cold
        states = [cold] * num_envs if state is None else unpack(state, cold, num_envs, self.actions_per_plan)
        starts = np.broadcast_to(False if episode_start is None else episode_start, num_envs)

        actions = []
        for i, row in enumerate(observations):
            generator = self.generators.prediction
            if deterministic:
                generator = observation_generator(self.seed, row, self.device)
            before = cold if starts[i] else states[i]
            if self.is_fitted:
                action, states[i] = self._planned(row, before, generator)
            else:
                self._warn_once("predict was called before the agent has learned: there is no model to plan with")
                action = self.planning.midpoint() if deterministic else self.planning.uniform(generator)
                states[i] = cold
            actions.append(action.reshape(self.action_space.shape).astype(self.action_space.dtype))
        return np.stack(actions) if is_batch else actions[0], pack(states)

    def _planned(
        self, observation: np.ndarray, before: PlanState, generator: torch.Generator
    ) -> tuple[np.ndarray, PlanState]:
        task, start = self.modelled.task(self.task), self.modelled.start(observation)
        acted = self.planning.act(task, start, before, generator)
        if acted.late:
            self._warn_once(f"a plan took longer than the time_budget of {self.time_budget} s: see num_late_plans")
        return acted.action, acted.carried

    def dump_logs(self) -> None:
        """Write what was recorded since the last time, with running means and speed."""
        elapsed = max((time.time_ns() - self.start_time) / 1e9, 1e-9)
        self.logger.record("time/episodes", self._episode_num, exclude="tensorboard")
        self.logger.record("time/fps", (self.num_timesteps - self._num_timesteps_at_start) / elapsed)
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        if self.ep_info_buffer:
            self.logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in self.ep_info_buffer]))
            self.logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in self.ep_info_buffer]))
        if self.ep_success_buffer:
            self.logger.record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        self.logger.dump(step=self.num_timesteps)

    def save(
        self,
        path: CheckpointPath,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save everything needed to predict and to learn on: see `saving` for what that is.

        Args:
            path: file (".zip" is added if it has no suffix), replaced only by a complete one; or a binary file object.
            exclude, include: of SB3's signature; without effect.

        Raises:
            CheckpointWriteError: the file cannot be written, or is more than `load` would read; the old one is whole.
                It is an OSError too.
        """
        write_checkpoint(collect(self), path)

    @classmethod
    def load(
        cls: type[SelfAgent],
        path: CheckpointPath,
        env: GymEnv | str | None = None,
        device: torch.device | str = "cpu",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfAgent:
        """Make an agent from a saved file; no code in the file is run.

        Args:
            path: what `save` was given.
            env: the environment to go on in, or its id; None serves prediction, and then a reward that was not learned
                must be given, and the termination function if the environment offered one.
            device: where planning computes. On another kind than the agent was saved on, new random streams begin.
            custom_objects: of SB3's signature; without effect, since nothing is unpickled.
            print_system_info: print versions of this system.
            force_reset: begin a new episode when learning goes on; False continues the one that was running, for an
                ``env`` that is still in it.
            kwargs: arguments of the constructor in place of the saved ones: ``reward_fn`` and ``terminated_fn`` if
                they were given to the agent that was saved, ``dynamics`` and ``planner`` of a plain `MPCAgent`,
                ``verbose``, ``tensorboard_log`` and so on. With ``seed`` the random streams begin afresh, the
                environment's included; with another horizon or fewer actions per plan, the plan does.

        Warns:
            UserWarning: the saved agent planned with a termination function, and there is none now (without an
                environment, `predict` says so).
            ReliabilityWarning: it was saved on another kind of device.

        Raises:
            FileNotFoundError: there is no such file.
            CheckpointError: it is not an agent's file, is damaged or from a newer version, or does not fit ``env``.
            UnknownRewardError: ``env`` offers no reward function and none was given.
        """
        if print_system_info:
            get_system_info()
        return load_agent(cls, path, env, device, force_reset, kwargs)

    def get_parameters(self) -> dict[str, dict]:
        """The learned state of the dynamics model, by SB3's name for such things."""
        return {"dynamics": self.dynamics.state_dict()}

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        """Not offered, because SB3's own would unpickle the file: use `load`.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"to take over what another agent has learned use {type(self).__name__}.load(path)")

    def _checked_observations(self, observation: Any) -> tuple[np.ndarray, bool]:
        """Observations as float32 [n, S], and whether they came with that first dimension."""
        check_parts(observation, layout(self.env))
        array = np.asarray(flatten(observation), dtype=np.float32)
        size = flat_size(self.observation_space)
        if array.ndim not in (1, 2) or array.shape[-1] != size:
            raise ValueError(f"expected an observation of shape ({size},) or (n, {size}), got {array.shape}")
        if not np.all(np.isfinite(array)):
            raise EnvironmentDataError(f"cannot plan from an observation that is not finite: {observation}")
        return array.reshape(-1, size), array.ndim == 2
