"""PETS: an ensemble of probabilistic networks for the dynamics, the cross-entropy method for the plan.

Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models".
"""

import os
from collections.abc import Sequence
from typing import ClassVar

import torch
from stable_baselines3.common.type_aliases import GymEnv

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.dynamics.ensemble.draws import Propagation
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.planning import make_planner
from gym_dgpmpc.tasks.task import Learned
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn


class PETSAgent(MPCAgent):
    """PETS, an `MPCAgent` made of an `EnsembleDynamics` and a `CEM`.

        agent = PETSAgent("SwingUpCartPole-v0", **PETS["SwingUpCartPole-v0"], seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)

    The settings that PETS was published with are in `presets.PETS`, those of the paper's comparison in
    `presets.COMPARISON_PETS`. The defaults are the former on the cart-pole.

    Args:
        env: the environment, its id, or a VecEnv; actions a bounded Box, observations a vector or a Dict of vectors.
        num_members: B, networks.
        num_hidden_layers: layers of each between inputs and outputs.
        hidden_size: width of each of them.
        weight_decay: of every layer's weights, the last layer's included; the loss holds decay / 2 |W|^2.
        learning_rate: of Adam.
        batch_size: transitions per network and gradient.
        num_epochs: passes over the data at each training.
        draw: how particles move through the networks: "TS1" (each through a network drawn anew at each step), "TSinf"
            (each through one network for the whole plan), "DS" (by the ensemble's mean and total variance), "MM" (as
            DS, then redrawn from a candidate's moments) or "expectation" (along the ensemble's mean).
        half_precision: compute most of a network in bfloat16 while planning: faster by a multiple on processors with
            instructions for it, and off by some 0.3 % of a prediction.
        num_particles: P, particles of each candidate; for "TS1" and "TSinf" a multiple of ``num_members``.
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
        "num_members",
        "num_hidden_layers",
        "hidden_size",
        "weight_decay",
        "learning_rate",
        "batch_size",
        "num_epochs",
        "draw",
        "half_precision",
        "horizon",
        "num_candidates",
        "num_elites",
        "num_iterations",
    )

    def __init__(
        self,
        env: GymEnv | str | None,
        *,
        num_members: int = 5,
        num_hidden_layers: int = 3,
        hidden_size: int = 500,
        weight_decay: Sequence[float] = (1e-4, 2.5e-4, 2.5e-4, 5e-4),
        learning_rate: float = 1e-3,
        batch_size: int = 32,
        num_epochs: int = 5,
        draw: Propagation = "TSinf",
        half_precision: bool = False,
        num_particles: int = 20,
        horizon: int = 25,
        num_candidates: int = 400,
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
        self.num_members, self.num_hidden_layers, self.hidden_size = num_members, num_hidden_layers, hidden_size
        self.weight_decay = tuple(weight_decay)  # an agent's file gives a list
        self._adam_learning_rate = learning_rate
        self.batch_size, self.num_epochs, self.draw = batch_size, num_epochs, draw
        self.half_precision = half_precision
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
        self.learning_rate = learning_rate  # the base class has one of its own, which nothing uses

    def _setup_model(self) -> None:
        """Build the planner for the environment's spaces; the model follows when it is known what it has to predict."""
        self.planner = make_planner(
            "cem",
            self.action_space,
            self.device,
            horizon=self.horizon,
            num_candidates=self.num_candidates,
            num_elites=self.num_elites,
            num_iterations=self.num_iterations,
        )
        super()._setup_model()
        if self.draw in ("TS1", "TSinf") and self.num_particles % self.num_members:
            raise ValueError(
                f"the draw {self.draw} needs a multiple of num_members = {self.num_members} as num_particles, "
                f"got {self.num_particles}"
            )

    def _make_dynamics(
        self, observation_size: int, action_size: int, observation_spec: ObservationSpec
    ) -> EnsembleDynamics:
        return EnsembleDynamics(
            observation_size,
            action_size,
            observation_spec,
            num_members=self.num_members,
            num_hidden_layers=self.num_hidden_layers,
            hidden_size=self.hidden_size,
            weight_decay=self.weight_decay,
            learning_rate=self._adam_learning_rate,
            batch_size=self.batch_size,
            num_epochs=self.num_epochs,
            draw=self.draw,
            half_precision=self.half_precision,
            device=self.device,
        )
