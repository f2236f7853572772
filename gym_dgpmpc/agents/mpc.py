"""Model-predictive control with any dynamics model and any planner, as a Stable-Baselines3 algorithm.

Learning is Algorithm 2 of Gadd et al. (2020), "Sample-Efficient Reinforcement Learning using Deep Gaussian
Processes"; it stands in one function, `MPCAgent._control`. The agent *has* a task (what to do, what to predict), a
controller (model and planner) and a collector (the running episodes); `composition.py` knows what it
is made of.
"""

import os
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.agents.bars import Bars
from gym_dgpmpc.agents.collector import Collector
from gym_dgpmpc.agents.composition import (
    AnyPlanner,
    Composition,
    MadeOf,
    OfController,
    PlanningArguments,
    own_settings,
    part_settings,
    setting_property,
)
from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.agents.exploration import ExplorationName, Explorer, FirstController
from gym_dgpmpc.agents.forecasting import forecast
from gym_dgpmpc.agents.logs import Logs
from gym_dgpmpc.agents.policy import MPCPolicy
from gym_dgpmpc.agents.progress import Progress, RandomStreams
from gym_dgpmpc.agents.signature import UNSET, called_in_order, composed_documentation, composed_signature
from gym_dgpmpc.checkpoints.collect import collect
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.checkpoints.format import CheckpointPath, write_checkpoint
from gym_dgpmpc.checkpoints.interface import StateOf
from gym_dgpmpc.checkpoints.restore import load_agent
from gym_dgpmpc.checkpoints.safeguard import Guard, callbacks_before, safeguard
from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import EnvironmentDataError, EnvironmentFailedError
from gym_dgpmpc.imagination import AlgorithmName, StartFunction, StartName, algorithm_class, budget_of, imagine
from gym_dgpmpc.planning.controller import Controller
from gym_dgpmpc.planning.plan_state import PackedPlans
from gym_dgpmpc.planning.registry import planner_factory
from gym_dgpmpc.planning.risk import RiskMeasure, RiskName
from gym_dgpmpc.randomness import Generators, fresh_seed, split_seed
from gym_dgpmpc.settings import Setting, joined, settings_of
from gym_dgpmpc.tasks.borders import received_batch
from gym_dgpmpc.tasks.dict_observations import FlatDict, original_space
from gym_dgpmpc.tasks.environment import flat_size, wrapped_env
from gym_dgpmpc.tasks.exported import arrays, minari_dataset, replay_buffer
from gym_dgpmpc.tasks.functions import Learned, Never
from gym_dgpmpc.tasks.logged import Logged, read_logged
from gym_dgpmpc.tasks.reward_guard import disagreements
from gym_dgpmpc.tasks.task import Task, TaskArguments
from gym_dgpmpc.types import (
    DynamicsFactory,
    DynamicsModel,
    ObservationSpec,
    Planner,
    RewardFn,
    StateDict,
    Stateful,
    TerminatedFn,
)

SelfAgent = TypeVar("SelfAgent", bound="MPCAgent")


class MPCAgent(BaseAlgorithm):
    """Learns a dynamics model from its own experience and acts by planning through it.

    The first steps are random, or another controller's. From then on the model is trained at each episode's start, and
    every action comes from a plan: P worlds are drawn from the model, and the planner searches the H actions with the
    highest return, averaged over the worlds or measured with more or less caution (``risk``).

    `predict` carries the plan in SB3's recurrent state, as a warm start for the next step: pass on the state that it
    returns (`evaluate_policy` does). Without it every step is planned from scratch, which costs return.

    In a VecEnv of n environments each is planned for by itself, in worlds that they share, so a step takes n plans; all
    transitions go into one store, and the model is re-sampled once for each step of all.

    Args:
        policy: "MPCPolicy", the only one there is; it may be left out: ``MPCAgent(env, ...)``.
        env: the environment, its id, or a VecEnv; actions a bounded Box, observations a vector or a Dict of vectors.
        dynamics: the model to learn; or a function (observation size, action size, `ObservationSpec`) -> model, which
            is needed if the model has to predict reward or termination too, and may be called again when that is found.
        planner: the optimiser of action sequences: a name ("cem", "icem", "mppi", "gradient", or what
            `register_planner` added), a class or function that makes one, or a ready-made planner. Its settings are
            further arguments of the agent, except of a ready-made one.
        reward_fn: r(s, a, s'), batched over leading dimensions, in torch. None: the environment's ``reward_fn`` or
            `compute_reward`, or what is known of Gymnasium's own; if there is none, or with "learned", the model
            predicts it.
        terminated_fn: whether an episode ends in s', batched likewise. None: the environment's ``terminated_fn`` (which
            may be None: never), or what is known; if there is none, or with "learned", the model predicts it from the
            first termination on. "never": episodes are planned as if they did not end.
        observation_spec: how the model reads observations; default: the environment's ``observation_spec``, or what is
            known. For Dict observations it indexes the vector of the parts in alphabetical order.
        num_particles: worlds drawn for each plan, P, over which a return is averaged.
        actions_per_plan: actions performed of each plan before the next one is made.
        risk: what a sequence is worth whose return is not the same in all worlds: the "mean" over them; the mean less
            ``risk_aversion`` standard deviations ("mean-std"); the mean of the worst ``cvar_share`` of them ("cvar");
            the "worst"; or, with optimism, the "best". A world that is not finite makes a sequence lose in any case.
        risk_aversion: standard deviations for "mean-std"; less than zero it is optimism.
        cvar_share: share of the worlds for "cvar", in (0, 1].
        learning_starts: transitions before the first training, of random actions if they were not logged; default:
            those of one episode in each environment (as many in all, if none is let end), or ``train_freq`` if these
            come first.
        exploration: the random actions until then: "uniform", of each step by itself; "held", each for
            ``exploration_hold`` steps; "coloured", uniform at each step and correlated over the steps; or "chirp", a
            sweep from one cycle in all of these steps to one in four steps, over the whole range.
        exploration_hold: steps for which a "held" action is performed.
        exploration_beta: colour of "coloured" actions, whose power falls with the frequency f about as f^-beta: 1 is
            pink, 2 red, and 0 is "uniform".
        first_controller: in place of random actions: a function of the environment's observation, one of an environment
            at a time, that returns an action. Beyond the bounds it is clipped. No file holds it.
        train_freq: environment steps between two trainings, for tasks that never end or whose episodes are very long
            or very short; default: one at every episode's start.
        time_budget: seconds that a plan may take, drawing its worlds included; the best plan found by then is used.
            None: as long as it takes. With a budget the clock decides, so a run does not repeat itself exactly.
        stats_window_size: episodes that the logged means are over.
        tensorboard_log: folder for TensorBoard, or None.
        verbose: 0 for silence, 1 for one line per episode, 2 for SB3's tables of logged values besides.
        seed: decides everything random: environment, exploration, training and planning. None draws one, kept in
            ``agent.seed``, and leaves the environment's own seed alone.
        device: where planning computes: "cpu", "cuda", or "auto" for the second where there is one.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: there is no reward function, and the model cannot be given the reward to predict.
    """

    policy: MPCPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(
        ("MPCPolicy", "MlpPolicy", "MultiInputPolicy"), MPCPolicy
    )
    observation_space: spaces.Box
    action_space: spaces.Box
    seed: int
    _last_obs: np.ndarray | None

    dynamics_class: ClassVar[Callable[..., DynamicsModel] | None] = None
    """Of a named agent, the model that it is made of; its settings are arguments of the agent."""
    controller_class: ClassVar[type[Controller]] = Controller
    """What acts through model and planner; its settings are arguments of the agent."""
    part_defaults: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    """Of a named agent, the settings of its parts that differ from the parts' own defaults."""
    largest: ClassVar[Mapping[str, int]] = MappingProxyType({"num_particles": 10**4})
    """What a file may claim; see `settings_of`."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """A named agent's signature and documentation are made of those of its parts."""
        super().__init_subclass__(**kwargs)
        if cls.dynamics_class is not None:
            of_parts = (settings_of(cls.dynamics_class), settings_of(cls.controller_class))
            parts = (cls.own_settings(), *of_parts, settings_of(planner_factory("cem")))
            cls.__signature__ = composed_signature(cls, *parts)  # type: ignore[attr-defined]
            cls.__doc__ = composed_documentation(cls, *parts)
            for name in joined(*parts[1:]):
                if name != "learning_rate":  # SB3 has an attribute of that name
                    setattr(cls, name, setting_property(name))

    def __init__(
        self,
        *args: Any,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: GymEnv | str | None = UNSET,
        dynamics: DynamicsModel | DynamicsFactory | None = None,
        planner: AnyPlanner | None = None,
        reward_fn: RewardFn | Learned | None = None,
        terminated_fn: TerminatedFn | Learned | Never | None = None,
        observation_spec: ObservationSpec | None = None,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: RiskName = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: ExplorationName = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        first_controller: FirstController | None = None,
        train_freq: int | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | os.PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        _init_setup_model: bool = True,
        **settings: Any,
    ):
        policy, env, dynamics, planner = called_in_order(type(self).__name__, args, policy, env, dynamics, planner)
        optional = {"learning_starts": learning_starts, "train_freq": train_freq}
        check_counts(**{name: count for name, count in optional.items() if count is not None})
        self.composition = Composition(
            self.made_of(), dynamics, "cem" if planner is None else planner, settings, self.own_settings()
        )
        if env is not None:
            env = wrapped_env(env)
        super().__init__(
            policy=policy,
            env=env,
            learning_rate=self.settings.get("learning_rate", 0.0),
            stats_window_size=stats_window_size,
            tensorboard_log=None if tensorboard_log is None else os.fspath(tensorboard_log),
            device=device,
            seed=seed,
            support_multi_env=True,
            supported_action_spaces=(spaces.Box,),
        )
        self.verbose = verbose
        self.learning_starts, self.train_freq = learning_starts, train_freq
        self.exploration, self.first_controller = exploration, first_controller
        self.exploration_hold, self.exploration_beta = exploration_hold, exploration_beta
        self._task_given = TaskArguments(reward_fn, terminated_fn, observation_spec)
        measure = RiskMeasure(risk, risk_aversion, cvar_share)
        self._planning_given = PlanningArguments(num_particles, actions_per_plan, time_budget, measure)
        self.seeds_environment = seed is not None
        self.seed = fresh_seed() if seed is None else seed
        if _init_setup_model:
            if self.seeds_environment:
                super().set_random_seed(self.seed)
            with torch.inference_mode(False):  # of what is made in it, nothing could be trained later
                self._setup_model()

    # ------------------------------------------------------------------------------------------ what it is made of

    @classmethod
    def made_of(cls) -> MadeOf:
        """What this class says of its parts."""
        return MadeOf(cls.__name__, cls.dynamics_class, cls.part_defaults, cls.controller_class)

    @classmethod
    def own_settings(cls) -> dict[str, Setting]:
        """The settings that every agent has, whatever it is made of."""
        return own_settings(MPCAgent, cls)

    @classmethod
    def part_settings(cls, planner: AnyPlanner = "cem") -> dict[str, Setting]:
        """The settings of model and controller, and of the planner unless it is a ready-made one."""
        return part_settings(cls.made_of(), planner)

    @classmethod
    def saved_settings(cls, planner: AnyPlanner) -> dict[str, Setting]:
        """The constructor arguments that a file holds, of an agent with this planner."""
        together = joined(cls.own_settings(), cls.part_settings(planner))
        return {name: setting for name, setting in together.items() if setting.is_saved}

    @property
    def settings(self) -> Mapping[str, Any]:
        """Every setting of model, planner and controller; each can be read as an attribute too, none can be changed."""
        return self.composition.settings

    def _setup_model(self) -> None:
        """Create what an untrained agent has, once the spaces are known."""
        self.store = TransitionStore(
            flat_size(self.observation_space),
            flat_size(self.action_space),
            observation_dtype=torch.float64 if self.observation_space.dtype == np.float64 else torch.float32,
        )
        self.generators: Generators = split_seed(self.seed, self.device)
        self.task = Task(self.env, self.observation_space, self.action_space, self._task_given, self.device)
        self.num_fitted = 0  # transitions that the last training saw
        self.controller = self.composition.make_controller(
            self._new_dynamics(), self.action_space, self._planning_given, self.device
        )
        self.collector = Collector(self.store, self.n_envs, self.controller)
        self.explorer = Explorer(self)
        self.logs = Logs(self)
        self.policy = MPCPolicy(self.observation_space, self.action_space, self)
        self._training_context: Callable[[], AbstractContextManager[None]] = nullcontext
        self._bars = Bars(False)
        self._has_described = False  # whether it was said where reward and termination come from
        self._warned: set[str] = set()

    def _make_dynamics(
        self, observation_size: int, action_size: int, observation_spec: ObservationSpec
    ) -> DynamicsModel | None:
        """An untrained model of such transitions, or None if the agent was given a ready-made one."""
        return self.composition.make_dynamics(observation_size, action_size, observation_spec, self.device)

    def _new_dynamics(self) -> DynamicsModel:
        """An untrained model of what the task wants predicted; the ready-made one, if the agent was given one.

        Raises:
            UnknownRewardError: that cannot be given more to predict than the observation.
        """
        modelled = self.task.modelled
        made = self._make_dynamics(modelled.size, flat_size(self.action_space), modelled.spec)
        self.task.can_model_more = made is not None
        if made is not None:
            return made
        if modelled.reward or modelled.terminated:
            raise self.task.unknown_reward()
        assert isinstance(self.composition.dynamics, DynamicsModel)
        return self.composition.dynamics

    def _model_anew(self, *, reward: bool, terminated: bool) -> None:
        """Begin with an untrained model, of the observation and what else it is to predict."""
        self.task.model(reward=reward, terminated=terminated)
        self.controller.dynamics, self.num_fitted = self._new_dynamics(), 0

    # Each has one owner; these are their names on the agent. Those of the controller may be set.

    @property
    def dynamics(self) -> DynamicsModel:
        """The model that worlds are drawn from."""
        return self.controller.dynamics

    @property
    def planner(self) -> Planner:
        """The optimiser of action sequences."""
        return self.controller.planner

    num_particles = OfController[int]()
    actions_per_plan = OfController[int]()
    risk = OfController[RiskName]()
    risk_aversion = OfController[float]()
    cvar_share = OfController[float]()
    time_budget = OfController["float | None"]()

    @property
    def observation_spec(self) -> ObservationSpec:
        """How the model reads observations."""
        return self.task.modelled.observation_spec

    @property
    def stats_window_size(self) -> int:
        """Episodes that the logged means are over."""
        return self._stats_window_size

    @property
    def num_late_plans(self) -> int:
        """Plans that took longer than ``time_budget``, of `learn` and `predict` together, since the agent was made."""
        return self.controller.num_late

    @property
    def episode_records(self) -> list[EpisodeRecord]:
        """What happened so far in each environment's running episode, or in the one that has just ended."""
        return self.collector.records

    @property
    def is_fitted(self) -> bool:
        """Whether the dynamics model has been trained."""
        return self.num_fitted > 0

    @property
    def has_running_episode(self) -> bool:
        """Whether `learn` can go on where the environments are."""
        return self._last_obs is not None

    @property
    def is_exploring(self) -> bool:
        """Whether the next actions are random because there are too few transitions to learn from."""
        return not self.is_fitted and not self.explorer.has_seen_enough

    @property
    def is_training_due(self) -> bool:
        """Whether `learn` would begin by training: an episode or exploration has ended, or ``train_freq`` is due."""
        num_new = len(self.store) - self.num_fitted
        starts = self._last_episode_starts is not None and bool(self._last_episode_starts.any())
        due = starts if self.train_freq is None else num_new >= self.train_freq
        return num_new > 0 and not self.is_exploring and (due or not self.is_fitted)

    # ------------------------------------------------------------------------------------------------ environments

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
        check_for_correct_spaces(env, self.observation_space, self.action_space)  # so that a refusal changes nothing
        found = self.task.find(env)
        if found.reward_fn is None and not self.task.modelled.reward:
            if self.is_fitted or not self.task.can_model_more:
                raise self.task.unknown_reward(env)
            with torch.inference_mode(False):
                self._model_anew(reward=True, terminated=self.task.modelled.terminated)
        self.n_envs = env.num_envs  # which may be another number than before
        super().set_env(env, force_reset)
        self.task.move(env, found)
        if self.collector.resize(self.n_envs):
            self._last_obs = None

    def set_random_seed(self, seed: int | None = None) -> None:
        """Start all random streams afresh, the environment's included; None changes nothing."""
        super().set_random_seed(seed)
        if seed is not None:
            self.seed, self.seeds_environment = seed, True
            self.generators = split_seed(seed, self.device)

    def add_transitions(self, data: Logged, *, scaled_actions: bool | None = None) -> None:
        """Learn from logged transitions too; with some, no random episode is played.

        They count as transitions for ``learning_starts``, but not as timesteps. Training on them is done when `learn`
        begins its next episode.

        Args:
            data: an SB3 `ReplayBuffer` or `DictReplayBuffer`, a Minari dataset, or a mapping of arrays, steps first:
                "observation" [n, S], "action" [n, A], "next_observation" [n, S], "reward" [n] and "terminated" [n]
                (if it is left out, none was), and "episode" [n], integers that are equal for steps of one episode (if
                it is left out, all are of one). Dict observations are dicts of such. Of a buffer with
                ``optimize_memory_usage`` the last steps of episodes are left out: it does not keep what they led to.
            scaled_actions: whether actions are given in [-1, 1] whatever the action space, as SB3's algorithms keep
                them in their buffers. None: so it is in a `ReplayBuffer`, and in nothing else.

        Raises:
            EnvironmentDataError: a shape, a number that is not finite, or an action out of bounds. Nothing is stored.
            TypeError: the data are none of these.
        """
        self.collector.add_logged(read_logged(data, scaled_actions, self.observation_space, self.action_space))

    def to_arrays(self) -> dict[str, Any]:
        """Copies of all stored transitions, as `add_transitions` takes them; see `tasks.exported.arrays`.

        Raises:
            EnvironmentDataError: nothing is stored.
        """
        return arrays(self.store, original_space(self.env, self.observation_space), self.action_space)

    def to_replay_buffer(self, buffer_size: int | None = None, device: torch.device | str = "auto") -> ReplayBuffer:
        """All stored transitions as SB3's off-policy algorithms keep them.

            sac.replay_buffer = agent.to_replay_buffer()

        Args:
            buffer_size: rows of the buffer, at least as many as are stored, which is what None gives.
            device: where the buffer's samples are placed.

        Raises:
            EnvironmentDataError: nothing is stored.
        """
        space = original_space(self.env, self.observation_space)
        return replay_buffer(self.store, space, self.action_space, buffer_size, device)

    def to_minari(self, dataset_id: str, **metadata: Any) -> Any:
        """Write all stored episodes as a new Minari dataset, and return it; see `tasks.exported.minari_dataset`.

        Args:
            dataset_id: "namespace/name-v0".
            **metadata: of `minari.create_dataset_from_buffers`, such as ``env``, ``author`` and ``description``.

        Raises:
            EnvironmentDataError: nothing is stored.
            ImportError: Minari is not installed.
            ValueError: the id is not one of Minari's, or the dataset exists.
        """
        space = original_space(self.env, self.observation_space)
        metadata = {"algorithm_name": type(self).__name__, **metadata}
        return minari_dataset(self.store, space, self.action_space, dataset_id, **metadata)

    # ---------------------------------------------------------------------------------------------------- learning

    def learn(
        self: SelfAgent,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "MPC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        run_folder: str | os.PathLike[str] | RunCheckpoints | None = None,
        resume: bool = False,
        checkpoint_every: int | None = None,
    ) -> SelfAgent:
        """Act, record and train for ``total_timesteps`` environment steps, the random ones included.

        May be called again: data and model persist, and random actions are not repeated. With
        ``reset_num_timesteps=False`` counting, logs and a running episode go on where they were. Training belongs to
        an episode's start; it is also done when the last step ends an episode, so that the agent one gets has seen
        every finished episode. After a stop by a callback, ``learn(0, reset_num_timesteps=False)`` does so.

        An environment that was stepped by others in between (`evaluate_policy` on the very object that the agent
        learns in) cannot go on where it was: then leave ``reset_num_timesteps`` as it is, or call ``set_env`` first.

        Whatever goes wrong, the transitions observed so far stay in ``agent.store``, and `learn` can be called again.

        With a ``run_folder`` they are on disk too: a checkpoint is written at first, after every episode and before a
        training within one, the last two are kept, and one more is written if something fails. ``resume=True`` makes
        the same call, in a program that was killed and started again, go on from there, to the same result bit for bit
        (of several environments: with all data and the same model, in new episodes):

            agent = DGPMPCAgent("ModCartPole-v0", seed=0, tensorboard_log="runs/a/logs")
            agent.learn(total_timesteps=3_200, run_folder="runs/a", resume=True)

        Ctrl-C and SIGTERM then stop `learn` once the running step is finished and a checkpoint written, which holds all
        steps (where the running episode cannot be repeated, a new one begins when the run goes on). A second one stops
        at once.

        Args:
            total_timesteps: environment steps of this call; with ``resume``, of the whole run.
            callback: SB3 callback(s), called after each step.
            log_interval: episodes between two writings of the log.
            tb_log_name: name of the run's folder under ``tensorboard_log``.
            reset_num_timesteps: start counting from zero, with a new episode; a run that goes on never does. Random
                steps count all the same: calls that are shorter than the first episode end exploration once they are
                as many steps as an episode may have; where the environment names no such limit, a warning says so.
            progress_bar: show one on the terminal, and one for each training that takes more than a second.
            run_folder: where to keep checkpoints, for this process alone.
            resume: go on from the checkpoint in ``run_folder``; without one the run begins.
            checkpoint_every: environment steps between checkpoints within an episode, beside those at its end: what a
                power cut may cost. One that cannot be repeated (of a plant, or beside others) keeps the steps, and a
                run that goes on from there begins a new episode.

        Raises:
            EnvironmentDataError: the environment returned something that is not finite.
            EnvironmentFailedError: the environment raised an exception, which is the cause.
            PlanningError: no candidate plan had a finite return.
            RunInUseError: another process holds ``run_folder``.
            CheckpointError: ``run_folder`` holds another run, or one although ``resume`` is false, or damaged files.
            CheckpointWriteError: a checkpoint cannot be written.
            ValueError: the agent was loaded without an environment, or an argument is missing or out of its range.
            KeyboardInterrupt, SystemExit: Ctrl-C or SIGTERM, with ``run_folder``.
        """
        check_reals("[0, inf]", total_timesteps=total_timesteps)
        if self.env is None:
            raise ValueError("the agent has no environment to learn in: pass env=... to load, or call set_env(env)")
        with (
            torch.inference_mode(False),
            torch.enable_grad(),
            safeguard(self, run_folder, resume=resume, checkpoint_every=checkpoint_every) as guard,
            Bars(progress_bar) as self._bars,
        ):
            if guard.goes_on:
                total_timesteps -= self.num_timesteps if resume else 0
                reset_num_timesteps = False
            total_timesteps, callback = self._begin(
                guard, max(total_timesteps, 0), callback, reset_num_timesteps, tb_log_name
            )
            self._training_context = guard.training
            callback.on_training_start(locals(), globals())
            self._bars.begin(total_timesteps - self.num_timesteps)
            try:
                self._control(total_timesteps, callback, log_interval)
            finally:
                self._training_context = nullcontext
            callback.on_training_end()
        return self

    def _begin(
        self,
        guard: Guard,
        total_timesteps: int,
        callback: MaybeCallback,
        reset_num_timesteps: bool,
        tb_log_name: str,
    ) -> tuple[int, BaseCallback]:
        """SB3's `_setup_learn`, with the guard's first checkpoint before there is a logger."""
        if not reset_num_timesteps:
            self.logs.keep_waiting()
        # The logger comes last, and SB3 makes none where there is one of the user's.
        makes_logger, self._custom_logger = not self._custom_logger, True
        try:
            total_timesteps, _ = self._setup_learn(total_timesteps, None, reset_num_timesteps, tb_log_name)
        finally:
            self._custom_logger = not makes_logger
        started, self._last_obs = self._observations, None
        self._last_obs = received_batch(started, (self.n_envs, *self.observation_space.shape), "reset")
        guard.begin(tb_log_name)
        if makes_logger:
            self._logger = self.logs.open(tb_log_name, begin_anew=reset_num_timesteps, in_run=guard.is_on)
        self.logs.hand_over(self.logger)
        if self.verbose >= 1 and not self._has_described:
            print(self.task.describe(), flush=True)
            self._has_described = True
        # Callbacks come last, for they may use the logger as soon as they are given the agent; the guard's after the
        # user's, so that a checkpoint holds what they did.
        return total_timesteps, self._init_callback(callbacks_before(guard, callback))

    def _control(self, total_timesteps: int, callback: BaseCallback, log_interval: int) -> None:
        """Algorithm 2 of the paper, one pass through the loop per control step (of all environments)."""
        while self.num_timesteps < total_timesteps:
            # For each episode: train the model, that is, optimise {Z, theta, beta} and sample U.
            for index in np.flatnonzero(self._starts):
                self._begin_episode(int(index), callback)
            self._fit_if_due()

            # Sample K action sequences and P trajectories of each, update m and v by their returns, repeat.
            observations = self._observations
            if self.is_exploring:
                if (warning := self.explorer.endless_beginning()) is not None:
                    self._warn_once(warning)
                actions = self.explorer.actions(observations)
            else:
                actions = self._plan(observations)

            # Perform the first action of the sequence, append the observed tuple to the data set.
            new_obs, rewards, dones, infos = self._perform(observations, actions)
            self._bars.step(self.n_envs)

            # Re-sample the inducing outputs U.
            if self.is_fitted:
                metrics = self.dynamics.resample(self.task.transitions(self.store), self.generators.fit)
                for name, value in metrics.items():
                    self.logger.record_mean(f"train/{name}", float(value))

            if np.any(dones):
                self._update_info_buffer(infos, dones)
            for index in np.flatnonzero(dones):
                self._end_episode(int(index), callback, log_interval)
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            callback.update_locals(locals())
            if not callback.on_step():
                return
        self._fit_if_due()

    def _plan(self, observations: np.ndarray) -> np.ndarray:
        """The next actions [n, A] of the running episodes' plans, which are made anew when they are used up.

        Each environment is planned for by itself, in worlds that all plans of one moment share.
        """
        generator, actions = self.generators.planning, []
        worlds = self.controller.worlds(generator)
        for running, observation in zip(self.collector.running, observations, strict=True):
            acted = self.controller.act(self.task, observation, running.carried, generator, worlds)
            running.carried = acted.carried
            if acted.info is not None:
                running.record.add_plan(acted.info, acted.seconds, late=acted.late)
            actions.append(acted.action)
        return np.stack(actions)

    def _perform(
        self, observations: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step the environments and store what they did; a step counts only once it is stored."""
        assert self.env is not None
        # Until the step is stored there is no observation to go on from: after an error, learn begins a new episode.
        self._last_obs, before = None, len(self.store)
        try:
            new_obs, rewards, dones, infos, terminated = self.collector.step(
                self.env, observations, actions, self.num_timesteps
            )
        except (EnvironmentFailedError, EnvironmentDataError):
            self._episode_num += len(self.store) > before  # the step ended the episode, and the reset after it failed
            raise
        finally:
            self.num_timesteps += len(self.store) - before
        self._last_obs, self._last_episode_starts = new_obs.copy(), dones.copy()  # callbacks are given the others
        if terminated.any() and self.task.functions.terminated_fn is None and not self.task.learns_termination:
            self._warn_once(
                "the environment ended an episode by termination, which the planner knows nothing of: pass "
                "terminated_fn=..., or give the environment an attribute of that name"
            )
        return new_obs, rewards, dones, infos

    def _begin_episode(self, index: int, callback: BaseCallback) -> None:
        """A new episode starts with a cold plan."""
        received = self._observations[index]
        if not np.all(np.isfinite(received)):
            self._last_obs = None
            raise EnvironmentDataError(
                f"after {self.num_timesteps} steps: the environment's reset returned an observation that is not "
                f"finite: {received}"
            )
        self.collector.begin_episode(index, self._episode_num + 1)
        callback.on_rollout_start()

    def _fit_if_due(self) -> None:
        """Train if an episode ended (or enough was seen since the last time), or exploration did."""
        if not self.is_training_due:
            return
        task = self.task
        task.look_at_precision(self.store, takes_float64=getattr(self.dynamics, "takes_float64", False))
        if not self.is_fitted:
            for disagreement in disagreements(task.functions_of_data, self.store, self.device, exact=task.is_exact):
                self._warn_once(disagreement)
        if task.learns_termination and not task.modelled.terminated and self.store.terminated.any():
            self._model_anew(reward=task.modelled.reward, terminated=True)
        started = time.perf_counter()
        with self._training_context(), self._bars.training(self.dynamics) as losses:
            metrics = dict(self.dynamics.fit(task.transitions(self.store), self.generators.fit))
        self.num_fitted = len(self.store)
        metrics |= self._improve()
        self.collector.add_training(metrics)
        metrics |= {"first_loss": losses[0], "last_loss": losses[-1]} if losses else {}
        metrics |= {"num_transitions": self.num_fitted, "seconds": time.perf_counter() - started}
        for name, value in metrics.items():
            self.logger.record(f"train/{name}", value)

    def _improve(self) -> Mapping[str, float]:
        """What an agent learns beside its model, once that is trained; returns metrics to log."""
        return {}

    def _end_episode(self, index: int, callback: BaseCallback, log_interval: int) -> None:
        """Count, log and print what happened."""
        self._episode_num += 1
        record = self.collector.end_episode(index, self._episode_num)
        if self.verbose >= 1:
            print(record.line(self.num_timesteps), flush=True)
        for name, value in record.metrics().items():
            self.logger.record(name, value)
        if log_interval is not None and self._episode_num % log_interval == 0:
            self.dump_logs()
        callback.on_rollout_end()

    @property
    def _observations(self) -> np.ndarray:
        """The present observations, [n, S]."""
        assert self._last_obs is not None
        return self._last_obs

    @property
    def _starts(self) -> np.ndarray:
        """In which environments the present observation is the first of an episode, [n]."""
        assert self._last_episode_starts is not None
        return self._last_episode_starts

    def dump_logs(self) -> None:
        """Write what was recorded since the last time, with running means and speed."""
        elapsed = max((time.time_ns() - self.start_time) / 1e9, 1e-9)
        self.logger.record("time/episodes", self._episode_num, exclude="tensorboard")
        self.logger.record("time/fps", (self.num_timesteps - self._num_timesteps_at_start) / elapsed)
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logs.record_means(self.logger)
        self.logger.dump(step=self.num_timesteps)

    def _warn_once(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, stacklevel=3)

    # -------------------------------------------------------------------------------------------------- imagining

    def imagine_policy(
        self,
        algorithm: AlgorithmName | type[BaseAlgorithm] = "SAC",
        total_timesteps: int | None = None,
        *,
        num_worlds: int = 20,
        episode_steps: int | None = None,
        starts: StartName | StartFunction = "mixed",
        trial_every: int | None = None,
        patience: int = 8,
        encoded: bool = True,
        seed: int | None = None,
        progress_bar: bool = False,
        **settings: Any,
    ) -> BaseAlgorithm:
        """Train a policy in worlds drawn from the model; it acts by itself, in a fraction of a millisecond.

            policy = agent.imagine_policy(progress_bar=True)
            policy.save("policy.zip")  # a file of Stable-Baselines3's, for SAC.load

        The policy is tried every ``trial_every`` imagined steps in worlds that it never learns in. The best one is
        returned, and training ends once ``patience`` trials have brought no better one. The environment is not asked,
        so look at the policy there before you rely on it: worlds can flatter (docs/imagination.md). `imagine` of
        `gym_dgpmpc.imagination` does the same, and returns all trials too.

        Args:
            algorithm: "SAC", "TD3", "DDPG", "PPO" or "A2C"; "TQC" or "CrossQ" where sb3-contrib is installed; the class
                of another one of Stable-Baselines3's; or "gradient", which climbs the return through the derivatives of
                the worlds, and is a TD3 when it is done (see `PolicyGradient`).
            total_timesteps: imagined steps to learn from, at most; None: what suits the algorithm.
            num_worlds: worlds side by side.
            episode_steps: steps of an imagined episode; None: the environment's time limit, or 200 if that is less.
            starts: where imagined episodes begin: at "starts", the first observations of recorded episodes; at
                "states", any recorded observation; "mixed", at either with equal chances; or a function (n, NumPy
                generator) -> observations [n, S].
            trial_every: imagined steps between two trials; None: what suits the algorithm.
            patience: trials without a better one after which training ends.
            encoded: feed the policy angles as sine and cosine, and everything in units of its spread. Its file then
                names a class of this package, which has to be installed where it is loaded; an exported one does not.
            seed: decides everything random; None: the agent's.
            progress_bar: show one on the terminal.
            **settings: of the algorithm, such as ``policy_kwargs`` and ``learning_rate``.

        Returns:
            The algorithm with the best policy; to train it on, load its saved file with an environment.

        Raises:
            ValueError, TypeError: the agent has not learned yet, or an argument is none or out of its range.
            TrainingError: training diverged.
        """
        with Bars(progress_bar) as bars:
            bars.begin(total_timesteps or budget_of(algorithm_class(algorithm)).total_timesteps)
            imagined = imagine(
                self, algorithm, total_timesteps, num_worlds=num_worlds, episode_steps=episode_steps, starts=starts,
                trial_every=trial_every, patience=patience, encoded=encoded, seed=seed, on_progress=bars.step,
                **settings,
            )  # fmt: skip
        return imagined.model

    # -------------------------------------------------------------------------------------------------- predicting

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
            The action (or n of them), in the action space's shape and dtype, and the state: what the planner carries,
            as arrays [n, ...], and the age [n] of the plans. (CEM carries mean [n, H, A] and standard deviation
            [n, H, A].) An agent that has not learned yet warns once and returns the middle of the action range, or
            uniformly random actions unless ``deterministic``.

        Raises:
            ValueError: observation or state has the wrong shape, or a dict other parts than the environment's.
            EnvironmentDataError: the observation is not finite.
            UnknownRewardError: the agent was loaded without an environment and without a reward function.
            PlanningError: no candidate plan had a finite return.
        """
        return self.policy.predict(observation, state, episode_start, deterministic)

    def forecast(self, observation: Any, actions: np.ndarray, num_particles: int = 100, seed: int = 0) -> np.ndarray:
        """What the model predicts for actions that are given, world by world.

            states = agent.forecast(observation, np.zeros((20, 1)))
            low, high = np.quantile(states[:, 10], [0.05, 0.95], axis=0)  # of each number, ten steps ahead

        Moves none of the random streams that learning and planning draw from.

        Args:
            observation: [S], the first state, in the environment's units; or a dict, if the environment's are.
            actions: [H, A] within the bounds, for any number of steps H.
            num_particles: P, worlds drawn.
            seed: of the worlds, with the agent's: the same forecast comes from the same one, until the model changes.

        Returns:
            The states [P, H + 1, S] in the environment's units, the first of each the observation. They have the fitted
            noise if plans have it. A model that diverges gives values that are not finite.

        Raises:
            ValueError: the agent has not learned yet, a shape is another, or an action is out of bounds.
            EnvironmentDataError: the observation is not finite.
        """
        return forecast(self, observation, actions, num_particles, seed)

    # --------------------------------------------------------------------------------------------- saving and loading

    def save(
        self,
        path: CheckpointPath,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save everything needed to predict and to learn on: see `checkpoints.collect` for what that is.

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
                they were given to the agent that was saved, a ``planner`` that was not given by name, ``dynamics`` of
                a plain `MPCAgent`, ``verbose``, ``tensorboard_log`` and so on. With ``seed`` the random streams begin
                afresh, the environment's included; with another planner or horizon, or fewer actions per plan, the
                plan does.

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
        with torch.inference_mode(False):
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

    @property
    def planner_given(self) -> AnyPlanner:
        """The planner as the constructor was given it."""
        return self.composition.planner

    def arguments(self) -> dict[str, Any]:
        """The constructor arguments as they are now, those that a file holds."""
        own = {name: getattr(self, name) for name in self.own_settings()}
        saved = self.saved_settings(self.composition.planner)
        return {"planner": self.composition.planner_name} | {name: {**self.settings, **own}[name] for name in saved}

    def nouns(self) -> dict[str, Stateful]:
        """What a checkpoint holds, in the order in which it is restored; each knows its own fields."""
        return {
            "task": StateOf(self.task.state_dict, self._load_task),
            "dynamics": self.dynamics,
            "transitions": self.store,
            "progress": Progress(self),
            "random": RandomStreams(self),
            "logs": self.logs,
            "episodes": self.collector,
        }

    def _load_task(self, state: StateDict) -> None:
        before = self.task.modelled
        self.task.load_state_dict(state)
        if self.task.modelled != before:
            self.controller.dynamics = self._new_dynamics()

    def begin_at(self, observation: np.ndarray | None, episode_starts: np.ndarray | None = None) -> None:
        """Let `learn` go on from these observations [n, S]; None lets it begin new episodes."""
        self._last_obs = observation
        if observation is not None:
            self._last_episode_starts = episode_starts


MPCAgent.__signature__ = composed_signature(MPCAgent, MPCAgent.own_settings())  # type: ignore[attr-defined]
