"""A planning agent as a Stable-Baselines3 algorithm: everything but how it learns.

Construction and its checks, `predict`, seeds, environments, logs, `save` and `load`. How it learns is in `mpc.py`.
"""

import time
import warnings
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info, safe_mean

from gym_dgpmpc.agents.checkpoint import CheckpointPath, write_checkpoint
from gym_dgpmpc.agents.plan_state import PlanState, PolicyState, pack, unpack
from gym_dgpmpc.agents.policy import PlanningPolicy
from gym_dgpmpc.agents.randomness import fresh_seed, observation_generator, split_seed
from gym_dgpmpc.agents.saving import collect, load_agent
from gym_dgpmpc.agents.task import Task, find_task, flat_size, wrapped_env
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import EnvironmentDataError
from gym_dgpmpc.types import DynamicsModel, Planner, RewardFn, TerminatedFn

SelfAgent = TypeVar("SelfAgent", bound="PlanningAgent")


class PlanningAgent(BaseAlgorithm):
    """What every agent that plans through a learned model offers to SB3's helpers; see `MPCAgent` for the arguments."""

    observation_space: spaces.Box
    action_space: spaces.Box
    dynamics: DynamicsModel
    planner: Planner
    seed: int
    _last_obs: np.ndarray | None

    saved_arguments: ClassVar[tuple[str, ...]] = (
        "num_particles",
        "actions_per_plan",
        "learning_starts",
        "time_budget",
        "stats_window_size",
        "tensorboard_log",
        "verbose",
        "seed",
    )
    """Constructor arguments that a saved file holds; each is also an attribute of that name."""

    def __init__(
        self,
        env: GymEnv | str | None,
        dynamics: DynamicsModel | None = None,
        planner: Planner | None = None,
        *,
        reward_fn: RewardFn | None = None,
        terminated_fn: TerminatedFn | None = None,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        learning_starts: int | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        _init_setup_model: bool = True,
    ):
        if learning_starts is not None and learning_starts < 1:
            raise ValueError(f"learning_starts must be at least 1, got {learning_starts}")
        if env is not None:
            env = wrapped_env(env)
        super().__init__(
            policy=BasePolicy,
            env=env,
            learning_rate=0.0,  # the base class wants one; the dynamics model has its own
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            device=device,
            seed=seed,
            supported_action_spaces=(spaces.Box,),
        )
        self.verbose, self.stats_window_size = verbose, stats_window_size
        if dynamics is not None:
            self.dynamics = dynamics
        if planner is not None:
            self.planner = planner
        self.num_particles, self.actions_per_plan = num_particles, actions_per_plan
        self.learning_starts, self.time_budget = learning_starts, time_budget
        self.given_reward_fn, self.given_terminated_fn = reward_fn, terminated_fn
        self.seeds_environment = seed is not None
        self.seed = fresh_seed() if seed is None else seed
        if _init_setup_model:
            if self.seeds_environment:
                super().set_random_seed(self.seed)
            self._setup_model()

    def _setup_model(self) -> None:
        """Create what an untrained agent has, once the spaces are known."""
        if not hasattr(self, "dynamics") or not hasattr(self, "planner"):
            raise ValueError("an MPCAgent is made of a dynamics model and a planner: pass dynamics=... and planner=...")
        self.store = TransitionStore(flat_size(self.observation_space), flat_size(self.action_space))
        self.generators = split_seed(self.seed, self.device)
        self._task: Task | None = None
        if self.env is not None or self.given_reward_fn is not None:
            self._task = self._find_task()
        self.planning = PlanningPolicy(
            self.dynamics,
            self.planner,
            self.action_space,
            self.num_particles,
            self.actions_per_plan,
            self.device,
            self.time_budget,
        )
        self.num_fitted = 0  # transitions that the last training saw
        self._warned: set[str] = set()

    @property
    def is_fitted(self) -> bool:
        """Whether the dynamics model has been trained."""
        return self.num_fitted > 0

    @property
    def num_late_plans(self) -> int:
        """Plans that took longer than ``time_budget``, of `learn` and `predict` together, since the agent was made."""
        return self.planning.num_late

    @property
    def task(self) -> Task:
        """The reward and termination that are planned with.

        Raises:
            UnknownRewardError: the agent has neither a reward function nor an environment that offers one.
        """
        if self._task is None:
            self._task = self._find_task()
        return self._task

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: PolicyState | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, PolicyState]:
        """Plan, and return the action and the plan to pass to the next call.

        Leaves learning untouched: nothing that training draws from or trains is moved. With a ``time_budget`` the plan
        is the best that was found in that time; a plan that took longer all the same is counted in `num_late_plans`,
        and the first one warns.

        Args:
            observation: [S], or [n, S] of n environments.
            state: what the last call returned; None plans from scratch.
            episode_start: [n], true where a new episode begins and the state is to be forgotten.
            deterministic: draw worlds and candidates from a generator that depends on the agent's seed and on the
                observation alone, so that the same observation and state give the same action. Otherwise from a
                generator that moves on with every call.

        Returns:
            The action (or n of them), in the action space's shape and dtype, and the state: mean [n, H, A], standard
            deviation [n, H, A] and age [n] of the plans. An agent that has not learned yet warns once and returns the
            middle of the action range, or uniformly random actions unless ``deterministic``.

        Raises:
            ValueError: observation or state has the wrong shape.
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
        late = self.planning.num_late
        action, after, _ = self.planning.plan(self.task, observation, before, generator)
        if self.planning.num_late > late:
            self._warn_once(f"a plan took longer than the time_budget of {self.time_budget} s: see num_late_plans")
        return action, after

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Go on in another environment of the same spaces; its reward is planned with, unless one was given.

        Raises:
            ValueError: its spaces are others, or it cannot be planned for.
            UnknownRewardError: there is no reward function.
        """
        env = wrapped_env(env)
        task = find_task(env, self.given_reward_fn, self.given_terminated_fn)
        self.n_envs = env.num_envs  # an agent loaded without an environment has none
        super().set_env(env, force_reset)
        self._task = task

    def set_random_seed(self, seed: int | None = None) -> None:
        """Start all random streams afresh, the environment's included; None changes nothing."""
        super().set_random_seed(seed)
        if seed is not None:
            self.seed, self.seeds_environment = seed, True
            self.generators = split_seed(seed, self.device)

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
            CheckpointWriteError: the file cannot be written; the old one is whole. It is an OSError too.
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
            env: the environment to go on in, or its id; None serves prediction, and then the reward must be given.
            device: where planning computes.
            custom_objects: of SB3's signature; without effect, since nothing is unpickled.
            print_system_info: print versions of this system.
            force_reset: begin a new episode when learning goes on; False continues the one that was running, for an
                ``env`` that is still in it.
            kwargs: arguments of the constructor in place of the saved ones: ``reward_fn`` and ``terminated_fn`` if
                they were given to the agent that was saved, ``dynamics`` and ``planner`` of a plain `MPCAgent`,
                ``verbose``, ``tensorboard_log`` and so on. With ``seed`` the random streams begin afresh.

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

    def _find_task(self) -> Task:
        both_spaces = self.observation_space, self.action_space
        return find_task(self.env, self.given_reward_fn, self.given_terminated_fn, both_spaces)

    def _checked_observations(self, observation: Any) -> tuple[np.ndarray, bool]:
        """Observations as float32 [n, S], and whether they came with that first dimension."""
        array = np.asarray(observation, dtype=np.float32)
        size = flat_size(self.observation_space)
        if array.ndim not in (1, 2) or array.shape[-1] != size:
            raise ValueError(f"expected an observation of shape ({size},) or (n, {size}), got {np.shape(observation)}")
        if not np.all(np.isfinite(array)):
            raise EnvironmentDataError(f"cannot plan from an observation that is not finite: {observation}")
        return array.reshape(-1, size), array.ndim == 2

    def _warn_once(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, stacklevel=3)
