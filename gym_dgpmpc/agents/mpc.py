"""Model-predictive control with any dynamics model and any planner, as a Stable-Baselines3 algorithm.

Learning is Algorithm 2 of Gadd et al. (2020), "Sample-Efficient Reinforcement Learning using Deep Gaussian
Processes"; it stands in one function, `MPCAgent._control`.
"""

import os
import time
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger

from gym_dgpmpc.agents.acting import ActingAgent
from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.agents.running import next_episode
from gym_dgpmpc.checkpoints.collect import pending_logs
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.checkpoints.safeguard import Safeguard
from gym_dgpmpc.errors import EnvironmentDataError
from gym_dgpmpc.tasks.reward_guard import disagreements

SelfAgent = TypeVar("SelfAgent", bound="MPCAgent")


ENDLESS = 1000
"""Random steps after which it is told that no episode has ended. Gymnasium's own tasks have at most as many."""


class MPCAgent(ActingAgent):
    """Learns a dynamics model from its own experience and acts by planning through it.

    The first steps are uniformly random. From then on the model is trained at each episode's start, and every action
    comes from a plan: P worlds are drawn from the model, and the planner searches the H actions with the highest
    return, averaged over the worlds.

    `predict` carries the plan in SB3's recurrent state, as a warm start for the next step: pass on the state that it
    returns (`evaluate_policy` does). Without it every step is planned from scratch, which costs return.

    In a VecEnv of n environments each is planned for by itself, in worlds that they share, so a step takes n plans; all
    transitions go into one store, and the model is re-sampled once for each step of all.

    Args:
        env: the environment, its id, or a VecEnv; actions a bounded Box, observations a vector or a Dict of vectors.
        dynamics: the model to learn; or a function (observation size, action size, `ObservationSpec`) -> model, which
            is needed if the model has to predict reward or termination too, and may be called again when that is found.
        planner: the optimiser of action sequences; its horizon is the plan's.
        reward_fn: r(s, a, s'), batched over leading dimensions, in torch. None: the environment's ``reward_fn`` or
            `compute_reward`, or what is known of Gymnasium's own; if there is none, or with "learned", the model
            predicts it.
        terminated_fn: whether an episode ends in s', batched likewise. None: the environment's ``terminated_fn`` (which
            may be None: never), or what is known; if there is none, or with "learned", the model predicts it from the
            first termination on.
        observation_spec: how a model that ``dynamics`` makes reads observations; default: the environment's
            ``observation_spec``, or what is known. Of a Dict it means the vector of the parts in alphabetical order.
        num_particles: P, worlds drawn for each plan.
        actions_per_plan: actions performed of each plan before the next one is made.
        learning_starts: transitions before the first training, of random actions if they were not logged; default:
            those of one episode in each environment, or ``train_freq`` if these come first.
        train_freq: environment steps between two trainings, for tasks that never end or whose episodes are very long
            or very short; default: one at every episode's start.
        time_budget: seconds that a plan may take, drawing its worlds included; the best plan found by then is used.
            None: as long as it takes. With a budget the clock decides, so a run does not repeat itself exactly.
        stats_window_size: episodes that the logged means are over.
        tensorboard_log: folder for TensorBoard, or None.
        verbose: 0 for silence, 1 for one line per episode, 2 for SB3's tables of logged values besides.
        seed: decides everything random: environment, exploration, training and planning. None draws one, kept in
            ``agent.seed``, and leaves the environment's own seed alone.
        device: where planning computes ("cpu", "cuda", or "auto"); dynamics and planner must live there too.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: there is no reward function, and the model cannot be given the reward to predict.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        self._pending_logs: list[tuple[str, float, int, Any]] = []  # of a checkpoint, for the logger of `learn`
        self._log_run: str | None = None  # the folder under `tensorboard_log` that a run with a folder logs in
        self._safeguard: Safeguard | None = None
        self._has_described = False  # whether it was said where reward and termination come from

    @property
    def is_training_due(self) -> bool:
        """Whether `learn` would begin by training: an episode or exploration has ended, or ``train_freq`` is due."""
        num_new = len(self.store) - self.num_fitted
        starts = self._last_episode_starts is not None and bool(self._last_episode_starts.any())
        due = starts if self.train_freq is None else num_new >= self.train_freq
        return num_new > 0 and not self.is_exploring and (due or not self.is_fitted)

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
            reset_num_timesteps: start counting from zero, with a new episode; a run that goes on never does.
            progress_bar: show one.
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
        if self.env is None:
            raise ValueError("the agent has no environment to learn in: pass env=... to load, or call set_env(env)")
        if run_folder is None and (resume or checkpoint_every is not None):
            raise ValueError("resume and checkpoint_every need a run_folder")
        guard: AbstractContextManager[Safeguard | None] = nullcontext()
        if run_folder is not None:
            guard = Safeguard(self, run_folder, resume=resume, checkpoint_every=checkpoint_every)
        with guard as self._safeguard:
            if self._safeguard is not None and self._safeguard.goes_on:
                total_timesteps -= self.num_timesteps if resume else 0
                reset_num_timesteps = False
                self._safeguard.continue_logs()
            total_timesteps, callback = self._setup_learn(
                max(total_timesteps, 0), callback, reset_num_timesteps, tb_log_name, progress_bar
            )
            callback.on_training_start(locals(), globals())
            self._control(total_timesteps, callback, log_interval)
            callback.on_training_end()
        return self

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
                self._warn_of_an_endless_beginning()
                actions = np.stack([self.planning.uniform(self.generators.exploration) for _ in self._running])
            else:
                actions = self._plan(observations)

            # Perform the first action of the sequence, append the observed tuple to the data set.
            rewards, dones, infos = self._perform_and_append(observations, actions)

            # Re-sample the inducing outputs U.
            if self.is_fitted:
                metrics = self.dynamics.resample(self.modelled.transitions(self.store), self.generators.fit)
                for name, value in metrics.items():
                    self.logger.record_mean(f"train/{name}", float(value))

            if np.any(dones):
                self._update_info_buffer(infos, dones)
            for index in np.flatnonzero(dones):
                self._end_episode(int(index), callback, log_interval)
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            callback.update_locals(locals())
            goes_on = callback.on_step()
            if self._safeguard is not None:
                self._safeguard.after_step(episode_ended=bool(np.any(dones)))
            if not goes_on:
                return
        self._fit_if_due()

    def _warn_of_an_endless_beginning(self) -> None:
        has_ended = any(running.has_explored for running in self._running)
        if self.learning_starts is None and len(self.store) == ENDLESS * self.n_envs and not has_ended:
            self._warn_once(
                f"after {ENDLESS} random steps no episode has ended, and nothing is learned before one does: give the "
                "environment a time limit (gymnasium.wrappers.TimeLimit), or pass learning_starts=... and, if episodes "
                "never end, train_freq=..."
            )

    def _begin_episode(self, index: int, callback: BaseCallback) -> None:
        """A new episode starts with a cold plan."""
        received = self._observations[index]
        if not np.all(np.isfinite(received)):
            self._last_obs = None
            raise EnvironmentDataError(
                f"after {self.num_timesteps} steps: the environment's reset returned an observation that is not "
                f"finite: {received}"
            )
        running = self._running[index]
        running.carried = self.planning.cold
        running.record = EpisodeRecord(self._episode_num + 1, self.planning.horizon)
        running.index = next_episode(self.store, [other for other in self._running if other is not running])
        callback.on_rollout_start()

    def _fit_if_due(self) -> None:
        """Train if an episode ended (or enough was seen since the last time), or exploration did."""
        if not self.is_training_due:
            return
        if not self.is_fitted:
            for disagreement in disagreements(self.task, self.store, self.device):
                self._warn_once(disagreement)
        if self.learns_termination and not self.modelled.terminated and self.store.terminated.any():
            self.new_model(reward=self.modelled.reward, terminated=True)
        started = time.perf_counter()
        with nullcontext() if self._safeguard is None else self._safeguard.training():
            metrics = dict(self.dynamics.fit(self.modelled.transitions(self.store), self.generators.fit))
        self.num_fitted = len(self.store)
        metrics |= {"num_transitions": self.num_fitted, "seconds": time.perf_counter() - started}
        for name, value in metrics.items():
            self.logger.record(f"train/{name}", value)

    def _end_episode(self, index: int, callback: BaseCallback, log_interval: int) -> None:
        """Count, log and print what happened."""
        running = self._running[index]
        running.has_explored = True
        self._episode_num += 1
        running.record.number = self._episode_num
        if self.verbose >= 1:
            print(running.record.line(self.num_timesteps), flush=True)
        for name, value in running.record.metrics().items():
            self.logger.record(name, value)
        if log_interval is not None and self._episode_num % log_interval == 0:
            self.dump_logs()
        callback.on_rollout_end()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "MPC",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if not reset_num_timesteps:
            self._pending_logs = pending_logs(self)  # the next logger is given what this one has not written
        # The logger comes last, and SB3 makes none where there is one of the user's.
        makes_logger, self._custom_logger = not self._custom_logger, True
        try:
            total_timesteps, _ = super()._setup_learn(total_timesteps, None, reset_num_timesteps, tb_log_name)
        finally:
            self._custom_logger = not makes_logger
        if self._safeguard is not None:
            self._safeguard.begin(tb_log_name)
        if makes_logger:
            self._logger = self._new_logger(tb_log_name, reset_num_timesteps)
        for name, value, count, excluded in self._pending_logs:
            self.logger.record(name, value, tuple(excluded or ()))
            self.logger.name_to_count[name] = count
        self._pending_logs = []
        if self.verbose >= 1 and not self._has_described:
            print(self.task.describe(can_learn_termination=self.learns_termination), flush=True)
            self._has_described = True
        # Callbacks come last, for they may use the logger as soon as they are given the agent.
        return total_timesteps, self._init_callback(callback, progress_bar)

    def _new_logger(self, tb_log_name: str, reset_num_timesteps: bool) -> Logger:
        """SB3's, in the folder of the run if there is one, else in the next or the newest of that name."""
        verbose = max(self.verbose - 1, 0)  # SB3 prints its tables at verbose=1; here that level is a line per episode
        if self._safeguard is None or self.tensorboard_log is None or self._log_run is None:
            return configure_logger(verbose, self.tensorboard_log, tb_log_name, reset_num_timesteps)
        formats = ["stdout", "tensorboard"] if verbose else ["tensorboard"]
        return configure(os.path.join(self.tensorboard_log, self._log_run), formats)
