"""What a planning agent is made of: its task, its model and its planner, and the checks when it is made.

`base.py` makes it a Stable-Baselines3 algorithm.
"""

import os
import warnings
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import UnknownRewardError
from gym_dgpmpc.planning.controller import Controller
from gym_dgpmpc.randomness import fresh_seed, split_seed
from gym_dgpmpc.tasks.dict_observations import FlatDict
from gym_dgpmpc.tasks.first_batch import REWARD_SIGNATURE
from gym_dgpmpc.tasks.modelled import ModelledVector
from gym_dgpmpc.tasks.task import (
    LEARNED,
    Learned,
    Task,
    describe,
    find_observation_spec,
    find_task,
    flat_size,
    wrapped_env,
)
from gym_dgpmpc.types import (
    DynamicsFactory,
    DynamicsModel,
    ObservationSpec,
    Planner,
    RewardFn,
    TerminatedFn,
)


class ComposedAgent(BaseAlgorithm):
    """The parts of an agent, and the environment that they are for; see `MPCAgent` for the arguments."""

    observation_space: spaces.Box
    action_space: spaces.Box
    dynamics: DynamicsModel
    planner: Planner
    modelled: ModelledVector
    """The vector that `dynamics` predicts: the observation, and reward and termination if they are learned."""
    seed: int
    _last_obs: np.ndarray | None

    saved_arguments: ClassVar[tuple[str, ...]] = (
        "num_particles",
        "actions_per_plan",
        "learning_starts",
        "train_freq",
        "observation_spec",
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
        dynamics: DynamicsModel | DynamicsFactory | None = None,
        planner: Planner | None = None,
        *,
        reward_fn: RewardFn | Learned | None = None,
        terminated_fn: TerminatedFn | Learned | None = None,
        observation_spec: ObservationSpec | None = None,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        learning_starts: int | None = None,
        train_freq: int | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | os.PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        _init_setup_model: bool = True,
    ):
        optional = {"learning_starts": learning_starts, "train_freq": train_freq}
        check_counts(**{name: count for name, count in optional.items() if count is not None})
        if env is not None:
            env = wrapped_env(env)
        super().__init__(
            policy=BasePolicy,
            env=env,
            learning_rate=0.0,  # the base class wants one; the dynamics model has its own
            stats_window_size=stats_window_size,
            tensorboard_log=None if tensorboard_log is None else os.fspath(tensorboard_log),
            device=device,
            seed=seed,
            support_multi_env=True,
            supported_action_spaces=(spaces.Box,),
        )
        self.verbose, self.stats_window_size = verbose, stats_window_size
        self._dynamics_factory: DynamicsFactory | None = None
        if isinstance(dynamics, DynamicsModel) and not isinstance(dynamics, type):  # a class makes models
            self.dynamics = dynamics
        else:
            self._dynamics_factory = dynamics
        if planner is not None:
            self.planner = planner
        self.num_particles, self.actions_per_plan = num_particles, actions_per_plan
        self.learning_starts, self.train_freq, self.time_budget = learning_starts, train_freq, time_budget
        self.observation_spec = observation_spec
        self.given_reward_fn, self.given_terminated_fn = reward_fn, terminated_fn
        # Of the file that the agent was loaded from: what it says of its environment, for the next file.
        self._about_environment: dict[str, Any] = {}
        self._had_terminated_fn = False
        self.seeds_environment = seed is not None
        self.seed = fresh_seed() if seed is None else seed
        if _init_setup_model:
            if self.seeds_environment:
                super().set_random_seed(self.seed)
            self._setup_model()

    def _setup_model(self) -> None:
        """Create what an untrained agent has, once the spaces are known."""
        self.store = TransitionStore(flat_size(self.observation_space), flat_size(self.action_space))
        self.generators = split_seed(self.seed, self.device)
        self.observation_spec = find_observation_spec(self.env, self.observation_spec)
        self._task: Task | None = None
        if self.env is not None or self.given_reward_fn is not None:
            self._task = self._find_task()
        self.new_model(reward=self._task is not None and self._task.reward_fn is None)
        if not hasattr(self, "dynamics") or not hasattr(self, "planner"):
            raise ValueError("an MPCAgent is made of a dynamics model and a planner: pass dynamics=... and planner=...")
        self.planning = Controller(
            self.dynamics,
            self.planner,
            self.action_space,
            num_particles=self.num_particles,
            actions_per_plan=self.actions_per_plan,
            time_budget=self.time_budget,
            device=self.device,
        )
        self._warned: set[str] = set()

    def _make_dynamics(
        self, observation_size: int, action_size: int, observation_spec: ObservationSpec
    ) -> DynamicsModel | None:
        """An untrained model of such transitions, or None if the agent was given a ready-made one."""
        factory = self._dynamics_factory
        return None if factory is None else factory(observation_size, action_size, observation_spec)

    def new_model(self, *, reward: bool, terminated: bool = False) -> None:
        """Begin with an untrained model, of the observation and what else it is to predict.

        Raises:
            UnknownRewardError: the dynamics model is a ready-made one, which cannot be given more to predict.
        """
        assert self.observation_spec is not None
        modelled = ModelledVector(flat_size(self.observation_space), self.observation_spec, reward, terminated)
        made = self._make_dynamics(modelled.size, flat_size(self.action_space), modelled.spec)
        self._can_model_more = made is not None
        if made is not None:
            self.dynamics = made
        elif reward or terminated:
            raise self._unknown_reward()
        self.modelled, self.num_fitted = modelled, 0  # transitions that the last training saw
        if hasattr(self, "planning"):
            self.planning.dynamics = self.dynamics

    @property
    def learns_termination(self) -> bool:
        """Whether the model is to predict termination from when the first one is seen."""
        return self._can_model_more and self.task.terminated_source == LEARNED

    @property
    def lacks_terminated_fn(self) -> bool:
        """Whether the agent was loaded from the file of one that planned with a termination function, and has none.

        An environment that says that its episodes never end is no lack, nor is a wish to learn when they do.
        """
        if self._task is None or not self._had_terminated_fn:
            return self._had_terminated_fn
        is_unknown = self._task.terminated_fn is None and self._task.terminated_source == LEARNED
        return is_unknown and self.given_terminated_fn != LEARNED

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
        """Reward and termination as far as they are functions of the observation, and where they come from.

        Raises:
            UnknownRewardError: there is no reward function, and the model does not predict the reward.
        """
        if self._task is None:
            self._task = self._find_task()
        if self._task.reward_fn is None and not self.modelled.reward:
            raise self._unknown_reward()
        if self.lacks_terminated_fn:
            self._warn_once(
                "the saved agent planned with a termination function, and this one has none: it plans as if episodes "
                "did not end. Pass terminated_fn=... to load, or an environment that offers it"
            )
        return self._task

    def _unknown_reward(self, env: VecEnv | None = None) -> UnknownRewardError:
        """The error that says what to pass, of an environment in place of the agent's own."""
        env = self.env if env is None else env
        lacks = "the agent has no environment" if env is None else f"{describe(env)} has no attribute 'reward_fn'"
        return UnknownRewardError(
            f"{lacks} and no reward_fn was passed; nor was this agent's model made to predict the reward (a ready-made "
            "one cannot be: pass dynamics=... as a function of observation size, action size and observation spec that "
            "makes one). Planning scores predicted trajectories, so it needs the reward as a function of batched torch "
            "tensors: pass reward_fn=... to the agent or give the environment that attribute, with the signature "
            f"{REWARD_SIGNATURE} where S = "
            f"{flat_size(self.observation_space)}, A = {flat_size(self.action_space)} and *b stands for any leading "
            "dimensions"
        )

    def get_env(self) -> VecEnv | None:
        """The environment as a VecEnv, with the Dict observations that it may have."""
        return self.env.venv if isinstance(self.env, FlatDict) else self.env

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Go on in another environment of the same spaces; its reward is planned with, unless one was given.

        One that is refused leaves the agent as it is.

        Raises:
            ValueError: its spaces are others, or it cannot be planned for.
            UnknownRewardError: there is no reward function, and the model was not trained to predict the reward.
        """
        env = wrapped_env(env)
        both_spaces = self.observation_space, self.action_space
        check_for_correct_spaces(env, *both_spaces)  # first of all, so that a refused one changes nothing
        task = find_task(env, self.given_reward_fn, self.given_terminated_fn, both_spaces, self.device)
        if task.reward_fn is None and not self.modelled.reward:
            if self.is_fitted or not self._can_model_more:
                raise self._unknown_reward(env)
            self.new_model(reward=True, terminated=self.modelled.terminated)
        self.n_envs = env.num_envs  # which may be another number than before
        super().set_env(env, force_reset)
        self._task = task

    def set_random_seed(self, seed: int | None = None) -> None:
        """Start all random streams afresh, the environment's included; None changes nothing."""
        super().set_random_seed(seed)
        if seed is not None:
            self.seed, self.seeds_environment = seed, True
            self.generators = split_seed(seed, self.device)

    def _find_task(self) -> Task:
        both_spaces = self.observation_space, self.action_space
        return find_task(self.env, self.given_reward_fn, self.given_terminated_fn, both_spaces, self.device)

    def _warn_once(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, stacklevel=3)
