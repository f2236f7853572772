"""DGP-MPC: a deep Gaussian process for the dynamics, the cross-entropy method for the plan.

Gadd et al. (2020), "Sample-Efficient Reinforcement Learning using Deep Gaussian Processes".
"""

import os
from typing import ClassVar

import torch
from stable_baselines3.common.type_aliases import GymEnv

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.agents.parts import cem_planner
from gym_dgpmpc.dynamics.deep_gp.draws import Draw, Refresh
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.tasks.task import Learned
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn


class DGPMPCAgent(MPCAgent):
    """The paper's agent, an `MPCAgent` made of a `DeepGPDynamics` and a `CEM`.

        agent = DGPMPCAgent("ModCartPole-v0", seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)

    The paper's settings of a task are in `presets.PAPER`: ``DGPMPCAgent(env, **PAPER["ModCartPole-v0"])``.

    Args:
        env: the environment, its id, or a VecEnv; actions a bounded Box, observations a vector or a Dict of vectors.
        num_layers: L, layers of the deep GP.
        kernel: of every layer: "rbf", "matern52", "matern32" or "matern12".
        num_inducing: M, inducing points per layer.
        draw: how a world is drawn from the posterior: "pathwise" (functions), "joint" (values, jointly across the
            candidate sequences, as in the paper) or "marginal" (values, independently).
        refresh: for "pathwise": a new function per particle at each "step" of a plan, or one for the whole "plan".
        num_features: F, random features of a pathwise draw.
        first_training_iterations: iterations (one SG-HMC and one Adam step each) of the first training.
        training_iterations: iterations of each later one.
        num_samples: posterior samples kept; the particles of a plan are drawn from them.
        sample_spacing: SG-HMC steps between two kept samples.
        resample_steps: SG-HMC steps after each control step; 0 keeps the posterior as it is within an episode.
        step_size: epsilon of SG-HMC.
        batch_size: transitions per gradient.
        gibbs_every: training iterations between two exact draws of the last layer's inducing outputs; 0 leaves them to
            SG-HMC alone, as in the paper.
        num_particles: P, worlds drawn for each plan.
        horizon: H, steps that a plan looks ahead.
        num_candidates: K, action sequences tried in each iteration of the planner.
        num_elites: the best of them, that the next iteration starts from; default: a tenth.
        num_iterations: the most iterations of a plan.
        actions_per_plan: actions performed of each plan before the next one is made.
        learning_starts: transitions before the first training, of random actions if they were not logged; default:
            those of one episode in each environment.
        train_freq: environment steps between two trainings; default: one at every episode's start.
        compile: roll plans out in compiled code, which a C++ compiler builds once in a few seconds; without one, or on
            another device than the CPU, PyTorch does it, several times slower. Not saved with the agent.
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
        "num_layers",
        "kernel",
        "num_inducing",
        "draw",
        "refresh",
        "num_features",
        "first_training_iterations",
        "training_iterations",
        "num_samples",
        "sample_spacing",
        "resample_steps",
        "step_size",
        "batch_size",
        "gibbs_every",
        "horizon",
        "num_candidates",
        "num_elites",
        "num_iterations",
    )

    def __init__(
        self,
        env: GymEnv | str | None,
        *,
        num_layers: int = 2,
        kernel: str = "matern32",
        num_inducing: int = 200,
        draw: Draw = "pathwise",
        refresh: Refresh = "step",
        num_features: int = 128,
        first_training_iterations: int = 4000,
        training_iterations: int = 1000,
        num_samples: int = 100,
        sample_spacing: int = 10,
        resample_steps: int = 10,
        step_size: float = 0.02,
        batch_size: int = 256,
        gibbs_every: int = 20,
        num_particles: int = 5,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        actions_per_plan: int = 1,
        learning_starts: int | None = None,
        train_freq: int | None = None,
        compile: bool = True,
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
        self.num_layers, self.kernel, self.num_inducing = num_layers, kernel, num_inducing
        self.draw, self.refresh, self.num_features = draw, refresh, num_features
        self.first_training_iterations, self.training_iterations = first_training_iterations, training_iterations
        self.num_samples, self.sample_spacing, self.resample_steps = num_samples, sample_spacing, resample_steps
        self.step_size, self.batch_size, self.gibbs_every = step_size, batch_size, gibbs_every
        self.horizon, self.num_candidates = horizon, num_candidates
        self.num_elites, self.num_iterations = num_elites, num_iterations
        self.compile = compile
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
    ) -> DeepGPDynamics:
        return DeepGPDynamics(
            observation_size,
            action_size,
            observation_spec,
            num_layers=self.num_layers,
            kernel=self.kernel,
            num_inducing=self.num_inducing,
            draw=self.draw,
            refresh=self.refresh,
            num_features=self.num_features,
            first_training_iterations=self.first_training_iterations,
            training_iterations=self.training_iterations,
            num_samples=self.num_samples,
            sample_spacing=self.sample_spacing,
            resample_steps=self.resample_steps,
            step_size=self.step_size,
            batch_size=self.batch_size,
            gibbs_every=self.gibbs_every,
            compile=self.compile,
            device=self.device,
        )
