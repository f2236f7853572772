"""GP-MPC: one sparse Gaussian process for the dynamics, the cross-entropy method for the plan.

The Gaussian-process baselines of Chua et al. (2018) and of Gadd et al. (2020): GP-DS and GP-MM.
"""

import os
from typing import ClassVar

import torch
from stable_baselines3.common.type_aliases import GymEnv

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.agents.parts import cem_planner
from gym_dgpmpc.dynamics.sparse_gp.model import GPDraw, SparseGPDynamics
from gym_dgpmpc.tasks.task import LEARNED, Learned, flat_size
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn


class GPMPCAgent(MPCAgent):
    """The comparison's Gaussian process, an `MPCAgent` made of a `SparseGPDynamics` and a `CEM`.

        agent = GPMPCAgent("ModCartPole-v0", **COMPARISON_GP["ModCartPole-v0"], draw="MM", seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)

    Args:
        env: the environment, its id, or a VecEnv; actions a bounded Box, observations a vector or a Dict of vectors.
        kernel: "rbf", "matern52", "matern32" or "matern12", with one lengthscale per input, shared by the outputs.
        num_inducing: M, inducing points.
        exact: make every transition an inducing point: the exact Gaussian process, for small data.
        max_training_iterations: of the optimiser, at each training.
        draw: how particles move: "DS" (each by its own draw from the Gaussian at its place), "MM" (as DS, then redrawn
            from a candidate's moments) or "AMM" (a Gaussian per candidate through its analytic moments; kernel "rbf",
            and more particles than an observation has numbers).
        add_noise: draw the observations' noise too, instead of the function alone.
        update_within_episode: condition on each transition at once, hyperparameters frozen.
        num_particles: P, particles of each candidate.
        horizon: H, steps that a plan looks ahead.
        num_candidates: K, action sequences tried in each iteration of the planner.
        num_elites: the best of them, that the next iteration starts from; default: a tenth.
        num_iterations: the most iterations of a plan.
        actions_per_plan: actions performed of each plan before the next one is made.
        learning_starts: transitions before the first training, of random actions if they were not logged; default:
            those of one episode in each environment.
        train_freq: environment steps between two trainings; default: one at every episode's start.
        time_budget: seconds that a plan may take, or None; see `MPCAgent`.
        reward_fn: r(s, a, s'), batched over leading dimensions, in torch. None: what the environment offers or is
            known to have; if there is none, or with "learned", the model predicts it.
        terminated_fn: whether an episode ends in s', batched likewise. None: as for the reward; what must be learned is
            so from the first termination on.
        observation_spec: how the model reads observations; default: what the environment offers or is known to need.
        stats_window_size: episodes that the logged means are over.
        tensorboard_log: folder for TensorBoard, or None.
        verbose: 0 for silence, 1 for one line per episode, 2 for SB3's tables of logged values besides.
        seed: decides everything random: environment, exploration, training and planning. None draws one, kept in
            ``agent.seed``, and leaves the environment's own seed alone.
        device: "cpu", "cuda", or "auto" for the second where there is one.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    saved_arguments: ClassVar[tuple[str, ...]] = (
        *MPCAgent.saved_arguments,
        "kernel",
        "num_inducing",
        "exact",
        "max_training_iterations",
        "draw",
        "add_noise",
        "update_within_episode",
        "horizon",
        "num_candidates",
        "num_elites",
        "num_iterations",
    )

    def __init__(
        self,
        env: GymEnv | str | None,
        *,
        kernel: str = "rbf",
        num_inducing: int = 200,
        exact: bool = False,
        max_training_iterations: int = 200,
        draw: GPDraw = "DS",
        add_noise: bool = False,
        update_within_episode: bool = False,
        num_particles: int = 5,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        actions_per_plan: int = 1,
        learning_starts: int | None = None,
        train_freq: int | None = None,
        time_budget: float | None = None,
        reward_fn: RewardFn | Learned | None = None,
        terminated_fn: TerminatedFn | Learned | None = None,
        observation_spec: ObservationSpec | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | os.PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        _init_setup_model: bool = True,
    ):
        self.kernel, self.num_inducing, self.exact = kernel, num_inducing, exact
        self.max_training_iterations, self.draw = max_training_iterations, draw
        self.add_noise, self.update_within_episode = add_noise, update_within_episode
        self.horizon, self.num_candidates = horizon, num_candidates
        self.num_elites, self.num_iterations = num_elites, num_iterations
        super().__init__(
            env,
            reward_fn=reward_fn,
            terminated_fn=terminated_fn,
            observation_spec=observation_spec,
            num_particles=num_particles,
            actions_per_plan=actions_per_plan,
            learning_starts=learning_starts,
            train_freq=train_freq,
            time_budget=time_budget,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _setup_model(self) -> None:
        """Build the planner for the environment's spaces; the model follows when it is known what it has to predict."""
        self.planner = cem_planner(
            self.action_space,
            self.device,
            horizon=self.horizon,
            num_candidates=self.num_candidates,
            num_elites=self.num_elites,
            num_iterations=self.num_iterations,
        )
        super()._setup_model()

    def _make_dynamics(
        self, observation_size: int, action_size: int, observation_spec: ObservationSpec
    ) -> SparseGPDynamics:
        largest = observation_size
        if self._task is not None:
            # Termination is learned from the first one on, in the middle of a run: too late to say this then.
            learned = (self._task.reward_fn is None) + (self._task.terminated_source == LEARNED)
            largest = max(largest, flat_size(self.observation_space) + learned)
        if self.draw == "AMM" and self.num_particles <= largest:
            raise ValueError(
                f"the draw AMM needs more particles than the {largest} numbers of an observation and of what else "
                "is or may be learned (the reward and, unless terminated_fn says when episodes end, termination), got "
                f"num_particles = {self.num_particles}"
            )
        return SparseGPDynamics(
            observation_size,
            action_size,
            observation_spec,
            kernel=self.kernel,
            num_inducing=self.num_inducing,
            exact=self.exact,
            max_training_iterations=self.max_training_iterations,
            draw=self.draw,
            add_noise=self.add_noise,
            update_within_episode=self.update_within_episode,
            device=self.device,
        )
