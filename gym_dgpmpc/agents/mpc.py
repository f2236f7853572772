"""Model-predictive control with any dynamics model and any planner, as a Stable-Baselines3 algorithm.

Learning is Algorithm 2 of Gadd et al. (2020), "Sample-Efficient Reinforcement Learning using Deep Gaussian
Processes"; it stands in one function, `MPCAgent._control`.
"""

import os
import time
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger

from gym_dgpmpc.agents.base import PlanningAgent
from gym_dgpmpc.agents.env_state import episode_start
from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.agents.run_checkpoints import RunCheckpoints
from gym_dgpmpc.agents.safeguard import Safeguard
from gym_dgpmpc.agents.saving import pending_logs
from gym_dgpmpc.errors import EnvironmentDataError, EnvironmentFailedError

SelfAgent = TypeVar("SelfAgent", bound="MPCAgent")


class MPCAgent(PlanningAgent):
    """Learns a dynamics model from its own experience and acts by planning through it.

    The first steps are uniformly random. From then on the model is trained at each episode's start, and every action
    comes from a plan: P worlds are drawn from the model, and the planner searches the H actions with the highest
    return, averaged over the worlds.

    `predict` carries the plan in SB3's recurrent state, as a warm start for the next step: pass on the state that it
    returns (`evaluate_policy` does). Without it every step is planned from scratch, which costs return.

    Args:
        env: the environment, its id, or a VecEnv of one environment; actions a bounded Box, observations a vector.
        dynamics: the model to learn.
        planner: the optimiser of action sequences; its horizon is the plan's.
        reward_fn: r(s, a, s'), batched over leading dimensions, in torch; default: the environment's ``reward_fn``.
        terminated_fn: whether an episode ends in s', batched likewise; default: the environment's ``terminated_fn``,
            and if it has none, the planner takes episodes not to end.
        num_particles: P, worlds drawn for each plan.
        actions_per_plan: actions performed of each plan before the next one is made.
        learning_starts: environment steps of uniform random actions; default: those of one episode.
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
        UnknownRewardError: there is no reward function.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        self._carried = self.planning.cold  # the running episode's plan
        self._record = EpisodeRecord(1, self.planning.horizon)
        self._episode_index = 0  # of the running episode in the store
        self._explored_episode = False  # whether an episode of random actions has ended
        self._pending_logs: list[tuple[str, float, int, Any]] = []  # of a checkpoint, for the logger of `learn`
        self._log_run: str | None = None  # the folder under `tensorboard_log` that a run with a folder logs in
        self._safeguard: Safeguard | None = None

    @property
    def is_exploring(self) -> bool:
        """Whether the next action is random because there are too few transitions to learn from."""
        if self.is_fitted:
            return False
        return not self._explored_episode if self.learning_starts is None else len(self.store) < self.learning_starts

    @property
    def is_training_due(self) -> bool:
        """Whether `learn` would begin by training: an episode or exploration has ended, and brought transitions."""
        starts = self._last_episode_starts is not None and bool(self._last_episode_starts[0])
        due = not self.is_exploring and (starts or not self.is_fitted)
        return due and len(self.store) > self.num_fitted

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
        every finished episode.

        An environment that was stepped by others in between (`evaluate_policy` on the very object that the agent
        learns in) cannot go on where it was: then leave ``reset_num_timesteps`` as it is, or call ``set_env`` first.

        Whatever goes wrong, the transitions observed so far stay in ``agent.store``, and `learn` can be called again.

        With a ``run_folder`` they are on disk too: a checkpoint is written at first and after every episode, the last
        two are kept, and one more is written if something fails. ``resume=True`` makes the same call, in a program that
        was killed and started again, go on from there, to the same result bit for bit:

            agent = DGPMPCAgent("ModCartPole-v0", seed=0, tensorboard_log="runs/a/logs")
            agent.learn(total_timesteps=3_200, run_folder="runs/a", resume=True)

        Ctrl-C and SIGTERM then stop `learn` once the running step is finished and a checkpoint written (in simulators;
        elsewhere that of the last episode's end counts). A second one stops at once.

        Args:
            total_timesteps: environment steps of this call; with ``resume``, of the whole run.
            callback: SB3 callback(s), called after each step.
            log_interval: episodes between two writings of the log.
            tb_log_name: name of the run's folder under ``tensorboard_log``.
            reset_num_timesteps: start counting from zero, with a new episode; a run that goes on never does.
            progress_bar: show one.
            run_folder: where to keep checkpoints, for this process alone.
            resume: go on from the checkpoint in ``run_folder``; without one the run begins.
            checkpoint_every: environment steps between checkpoints within an episode, beside those at its end.

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
        """Algorithm 2 of the paper, one pass through the loop per control step."""
        while self.num_timesteps < total_timesteps:
            # For each episode: train the model, that is, optimise {Z, theta, beta} and sample U.
            if self._starts_episode:
                self._begin_episode(callback)
            self._fit_if_due()

            # Sample K action sequences and P trajectories of each, update m and v by their returns, repeat.
            observation = self._observation
            if self.is_exploring:
                action = self.planning.uniform(self.generators.exploration)
            else:
                action = self._plan(observation)

            # Perform the first action of the sequence, append the observed tuple to the data set.
            rewards, dones, infos = self._perform_and_append(observation, action)

            # Re-sample the inducing outputs U.
            if self.is_fitted:
                self.dynamics.resample(self.store.transitions(), self.generators.fit)

            if dones[0]:
                self._end_episode(infos, dones, callback, log_interval)
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            callback.update_locals(locals())
            goes_on = callback.on_step()
            if self._safeguard is not None:
                self._safeguard.after_step(episode_ended=bool(dones[0]))
            if not goes_on:
                return
        self._fit_if_due()

    def _begin_episode(self, callback: BaseCallback) -> None:
        """A new episode starts with a cold plan."""
        received = self._observation
        if not np.all(np.isfinite(received)):
            self._last_obs = None
            raise EnvironmentDataError(
                f"after {self.num_timesteps} steps: the environment's reset returned an observation that is not "
                f"finite: {received}"
            )
        self._carried = self.planning.cold
        self._record = EpisodeRecord(self._episode_num + 1, self.planning.horizon)
        self._episode_index = int(self.store.episodes[-1]) + 1 if len(self.store) else 0
        callback.on_rollout_start()

    def _fit_if_due(self) -> None:
        """Train if an episode ended, or exploration did, and there is something new to learn from."""
        if not self.is_training_due:
            return
        started = time.perf_counter()
        with nullcontext() if self._safeguard is None else self._safeguard.stop.at_any_time():
            metrics = dict(self.dynamics.fit(self.store.transitions(), self.generators.fit))
        self.num_fitted = len(self.store)
        metrics |= {"num_transitions": self.num_fitted, "seconds": time.perf_counter() - started}
        for name, value in metrics.items():
            self.logger.record(f"train/{name}", value)

    def _plan(self, observation: np.ndarray) -> np.ndarray:
        """The next action [A] of the running episode's plan, which is made anew when it is used up."""
        started, late = time.perf_counter(), self.planning.num_late
        action, self._carried, info = self.planning.plan(
            self.task, observation, self._carried, self.generators.planning
        )
        if info is not None:
            seconds = time.perf_counter() - started
            self._record.add_plan(info, seconds, late=self.planning.num_late > late)
        return action

    def _perform_and_append(
        self, observation: np.ndarray, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step the environment and store what it did; a step counts only once it is stored."""
        # Until then there is no observation to go on from: after an error, learn begins a new episode.
        self._last_obs = None
        assert self.env is not None
        start = episode_start(self.env)
        if start is not None:
            start.last_step = None
        try:
            new_obs, rewards, dones, infos = self.env.step(action.reshape(1, *self.action_space.shape))
        except Exception as error:
            step = self.num_timesteps
            self._keep_last_step(observation, action)
            named = isinstance(error, EnvironmentFailedError)
            what = str(error) if named else f"the environment raised {type(error).__name__}: {error}"
            raise EnvironmentFailedError(f"step {step}: {what}") from (error.__cause__ if named else error)
        assert isinstance(new_obs, np.ndarray)
        # At an episode's end the environment has been reset already, and the true next observation is set aside.
        next_observation = infos[0]["terminal_observation"] if dones[0] else new_obs[0]
        terminated = bool(dones[0]) and not infos[0].get("TimeLimit.truncated", False)
        if self._vec_normalize_env is not None:
            rewards = self._vec_normalize_env.get_original_reward()
        self._append(observation, action, next_observation, float(rewards[0]), terminated)
        self._last_obs, self._last_episode_starts = new_obs, dones
        if terminated and self.task.terminated_fn is None:
            self._warn_once(
                "the environment ended an episode by termination, which the planner knows nothing of: pass "
                "terminated_fn=..., or give the environment an attribute of that name"
            )
        return rewards, dones, list(infos)

    def _append(
        self, observation: np.ndarray, action: np.ndarray, after: np.ndarray, reward: float, terminated: bool
    ) -> None:
        self.store.append(observation, action, after, reward=reward, terminated=terminated, episode=self._episode_index)
        self.num_timesteps += 1
        self._record.add_reward(reward)

    def _keep_last_step(self, observation: np.ndarray, action: np.ndarray) -> None:
        """Store the step that ended an episode, where it is the reset after it that failed."""
        start = episode_start(self.env)
        if start is None or start.last_step is None or not any(start.last_step[2:4]):
            return
        after, reward, terminated, _, _ = start.last_step
        with suppress(EnvironmentDataError):
            self._append(observation, action, after, float(np.float32(reward)), bool(terminated))
            self._explored_episode = True
            self._episode_num += 1

    def _end_episode(
        self, infos: list[dict[str, Any]], dones: np.ndarray, callback: BaseCallback, log_interval: int
    ) -> None:
        """Count, log and print what happened."""
        self._explored_episode = True
        self._episode_num += 1
        self._update_info_buffer(infos, dones)
        if self.verbose >= 1:
            print(self._record.line(self.num_timesteps), flush=True)
        for name, value in self._record.metrics().items():
            self.logger.record(name, value)
        if log_interval is not None and self._episode_num % log_interval == 0:
            self.dump_logs()
        callback.on_rollout_end()

    @property
    def _observation(self) -> np.ndarray:
        """The present observation, [S]."""
        assert self._last_obs is not None
        return self._last_obs[0]

    @property
    def _starts_episode(self) -> bool:
        """Whether the present observation is the first of an episode."""
        assert self._last_episode_starts is not None
        return bool(self._last_episode_starts[0])

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
            found = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
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
        return found

    def _new_logger(self, tb_log_name: str, reset_num_timesteps: bool) -> Logger:
        """SB3's, in the folder of the run if there is one, else in the next or the newest of that name."""
        verbose = max(self.verbose - 1, 0)  # SB3 prints its tables at verbose=1; here that level is a line per episode
        if self._safeguard is None or self.tensorboard_log is None or self._log_run is None:
            return configure_logger(verbose, self.tensorboard_log, tb_log_name, reset_num_timesteps)
        formats = ["stdout", "tensorboard"] if verbose else ["tensorboard"]
        return configure(os.path.join(self.tensorboard_log, self._log_run), formats)
