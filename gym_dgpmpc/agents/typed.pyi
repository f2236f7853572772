"""The named agents as type checkers see them, with every argument; nothing here runs.

Written by `python -m tests.agents.typed` from the settings of the agents' parts: change these, and write it anew.
"""

from collections.abc import Callable, Sequence
from gym_dgpmpc.agents.acting import PolicyAgent
from gym_dgpmpc.agents.dgp_mpc import DGPMPCAgent
from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.types import ObservationSpec, Planner, RewardFn, TerminatedFn
from gymnasium.core import Env
from os import PathLike
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv
from torch import device
from typing import Any, Literal

class DGPMPCAgentBase(MPCAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        num_layers: int = 2,
        kernel: Literal["rbf", "matern72", "matern52", "matern32", "matern12"] = "matern32",
        linear: bool = False,
        num_inducing: int = 100,
        draw: Literal["pathwise", "joint", "marginal"] = "pathwise",
        refresh: Literal["step", "plan"] = "plan",
        num_features: int = 64,
        first_training_iterations: int = 1000,
        training_iterations: int = 300,
        num_chains: int = 5,
        num_samples: int = 100,
        sample_spacing: int = 20,
        resample_samples: int = 5,
        relocate: bool = True,
        add_noise: bool = True,
        split_noise: bool = True,
        compile: bool = True,
        step_size: float = 0.1,
        decay: float = 0.05,
        hyperparameters: Literal["sampled", "optimised"] = "optimised",
        hyperparameter_step_size: float = 0.02,
        learning_rate: float = 0.1,
        hyperparameters_every: int = 1,
        window_size: int = 1,
        batch_size: int = 256,
        gibbs_every: int = 20,
        gibbs_rows: int = 4096,
        patience: int | None = None,
        look_every: int = 100,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def num_layers(self) -> int: ...
    @property
    def kernel(self) -> Literal["rbf", "matern72", "matern52", "matern32", "matern12"]: ...
    @property
    def linear(self) -> bool: ...
    @property
    def num_inducing(self) -> int: ...
    @property
    def draw(self) -> Literal["pathwise", "joint", "marginal"]: ...
    @property
    def refresh(self) -> Literal["step", "plan"]: ...
    @property
    def num_features(self) -> int: ...
    @property
    def first_training_iterations(self) -> int: ...
    @property
    def training_iterations(self) -> int: ...
    @property
    def num_chains(self) -> int: ...
    @property
    def num_samples(self) -> int: ...
    @property
    def sample_spacing(self) -> int: ...
    @property
    def resample_samples(self) -> int: ...
    @property
    def relocate(self) -> bool: ...
    @property
    def add_noise(self) -> bool: ...
    @property
    def split_noise(self) -> bool: ...
    @property
    def compile(self) -> bool: ...
    @property
    def step_size(self) -> float: ...
    @property
    def decay(self) -> float: ...
    @property
    def hyperparameters(self) -> Literal["sampled", "optimised"]: ...
    @property
    def hyperparameter_step_size(self) -> float: ...
    @property
    def hyperparameters_every(self) -> int: ...
    @property
    def window_size(self) -> int: ...
    @property
    def batch_size(self) -> int: ...
    @property
    def gibbs_every(self) -> int: ...
    @property
    def gibbs_rows(self) -> int: ...
    @property
    def patience(self) -> int | None: ...
    @property
    def look_every(self) -> int: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...

class DeepPILCOAgentBase(PolicyAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        num_hidden_layers: int = 2,
        hidden_size: int = 200,
        dropout: float = 0.05,
        prior_lengthscale: float = 1.0,
        model_noise_std: float | None = None,
        learning_rate: float = 0.001,
        batch_size: int = 100,
        num_epochs: int = 1000,
        patience: int | None = None,
        add_noise: bool = True,
        split_noise: bool = False,
        num_worlds: int = 50,
        num_paths: int = 1,
        first_search_steps: int = 300,
        search_steps: int = 300,
        search_step_size: float = 0.03,
        policy_dropout: float = 0.0,
        match_moments: bool = True,
        policy_form: Literal["rbf", "linear"] = "rbf",
        num_centres: int = 50,
        search_horizon: int | None = None,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def num_hidden_layers(self) -> int: ...
    @property
    def hidden_size(self) -> int: ...
    @property
    def dropout(self) -> float: ...
    @property
    def prior_lengthscale(self) -> float: ...
    @property
    def model_noise_std(self) -> float | None: ...
    @property
    def batch_size(self) -> int: ...
    @property
    def num_epochs(self) -> int: ...
    @property
    def patience(self) -> int | None: ...
    @property
    def add_noise(self) -> bool: ...
    @property
    def split_noise(self) -> bool: ...
    @property
    def num_worlds(self) -> int: ...
    @property
    def num_paths(self) -> int: ...
    @property
    def first_search_steps(self) -> int: ...
    @property
    def search_steps(self) -> int: ...
    @property
    def search_step_size(self) -> float: ...
    @property
    def policy_dropout(self) -> float: ...
    @property
    def match_moments(self) -> bool: ...
    @property
    def policy_form(self) -> Literal["rbf", "linear"]: ...
    @property
    def num_centres(self) -> int: ...
    @property
    def search_horizon(self) -> int | None: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...

class DynaAgentBase(DGPMPCAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        num_layers: int = 2,
        kernel: Literal["rbf", "matern72", "matern52", "matern32", "matern12"] = "matern32",
        linear: bool = False,
        num_inducing: int = 100,
        draw: Literal["pathwise", "joint", "marginal"] = "pathwise",
        refresh: Literal["step", "plan"] = "plan",
        num_features: int = 64,
        first_training_iterations: int = 1000,
        training_iterations: int = 300,
        num_chains: int = 5,
        num_samples: int = 100,
        sample_spacing: int = 20,
        resample_samples: int = 5,
        relocate: bool = True,
        add_noise: bool = True,
        split_noise: bool = True,
        compile: bool = True,
        step_size: float = 0.1,
        decay: float = 0.05,
        hyperparameters: Literal["sampled", "optimised"] = "optimised",
        hyperparameter_step_size: float = 0.02,
        learning_rate: float = 0.1,
        hyperparameters_every: int = 1,
        window_size: int = 1,
        batch_size: int = 256,
        gibbs_every: int = 20,
        gibbs_rows: int = 4096,
        patience: int | None = None,
        look_every: int = 100,
        algorithm: Literal["gradient", "SAC", "TD3", "DDPG", "PPO", "A2C", "TQC", "CrossQ"] = "SAC",
        acts_by: Literal["policy", "planner"] = "policy",
        imagined_timesteps: int | None = None,
        num_worlds: int = 20,
        trial_every: int | None = None,
        trial_patience: int = 8,
        proposes: bool = False,
        terminal_value: bool = False,
        value_depths: int = 1,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def num_layers(self) -> int: ...
    @property
    def kernel(self) -> Literal["rbf", "matern72", "matern52", "matern32", "matern12"]: ...
    @property
    def linear(self) -> bool: ...
    @property
    def num_inducing(self) -> int: ...
    @property
    def draw(self) -> Literal["pathwise", "joint", "marginal"]: ...
    @property
    def refresh(self) -> Literal["step", "plan"]: ...
    @property
    def num_features(self) -> int: ...
    @property
    def first_training_iterations(self) -> int: ...
    @property
    def training_iterations(self) -> int: ...
    @property
    def num_chains(self) -> int: ...
    @property
    def num_samples(self) -> int: ...
    @property
    def sample_spacing(self) -> int: ...
    @property
    def resample_samples(self) -> int: ...
    @property
    def relocate(self) -> bool: ...
    @property
    def add_noise(self) -> bool: ...
    @property
    def split_noise(self) -> bool: ...
    @property
    def compile(self) -> bool: ...
    @property
    def step_size(self) -> float: ...
    @property
    def decay(self) -> float: ...
    @property
    def hyperparameters(self) -> Literal["sampled", "optimised"]: ...
    @property
    def hyperparameter_step_size(self) -> float: ...
    @property
    def hyperparameters_every(self) -> int: ...
    @property
    def window_size(self) -> int: ...
    @property
    def batch_size(self) -> int: ...
    @property
    def gibbs_every(self) -> int: ...
    @property
    def gibbs_rows(self) -> int: ...
    @property
    def patience(self) -> int | None: ...
    @property
    def look_every(self) -> int: ...
    @property
    def algorithm(self) -> Literal["gradient", "SAC", "TD3", "DDPG", "PPO", "A2C", "TQC", "CrossQ"]: ...
    @property
    def acts_by(self) -> Literal["policy", "planner"]: ...
    @property
    def imagined_timesteps(self) -> int | None: ...
    @property
    def num_worlds(self) -> int: ...
    @property
    def trial_every(self) -> int | None: ...
    @property
    def trial_patience(self) -> int: ...
    @property
    def proposes(self) -> bool: ...
    @property
    def terminal_value(self) -> bool: ...
    @property
    def value_depths(self) -> int: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...

class GPMPCAgentBase(MPCAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        kernel: Literal["rbf", "matern72", "matern52", "matern32", "matern12"] = "rbf",
        num_inducing: int = 200,
        exact: bool = False,
        max_training_iterations: int = 200,
        draw: Literal["DS", "MM", "AMM"] = "DS",
        add_noise: bool = False,
        split_noise: bool = True,
        update_within_episode: bool = False,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def kernel(self) -> Literal["rbf", "matern72", "matern52", "matern32", "matern12"]: ...
    @property
    def num_inducing(self) -> int: ...
    @property
    def exact(self) -> bool: ...
    @property
    def max_training_iterations(self) -> int: ...
    @property
    def draw(self) -> Literal["DS", "MM", "AMM"]: ...
    @property
    def add_noise(self) -> bool: ...
    @property
    def split_noise(self) -> bool: ...
    @property
    def update_within_episode(self) -> bool: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...

class MCPILCOAgentBase(PolicyAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        num_layers: int = 1,
        kernel: Literal["rbf", "matern72", "matern52", "matern32", "matern12"] = "rbf",
        linear: bool = False,
        num_inducing: int = 100,
        draw: Literal["pathwise", "joint", "marginal"] = "pathwise",
        refresh: Literal["step", "plan"] = "plan",
        num_features: int = 64,
        first_training_iterations: int = 1000,
        training_iterations: int = 300,
        num_chains: int = 5,
        num_samples: int = 100,
        sample_spacing: int = 20,
        resample_samples: int = 5,
        relocate: bool = True,
        add_noise: bool = True,
        split_noise: bool = True,
        compile: bool = True,
        step_size: float = 0.1,
        decay: float = 0.05,
        hyperparameters: Literal["sampled", "optimised"] = "optimised",
        hyperparameter_step_size: float = 0.02,
        learning_rate: float = 0.1,
        hyperparameters_every: int = 1,
        window_size: int = 1,
        batch_size: int = 256,
        gibbs_every: int = 20,
        gibbs_rows: int = 4096,
        patience: int | None = None,
        look_every: int = 100,
        num_worlds: int = 25,
        num_paths: int = 8,
        first_search_steps: int = 300,
        search_steps: int = 300,
        search_step_size: float = 0.03,
        policy_dropout: float = 0.25,
        match_moments: bool = False,
        policy_form: Literal["rbf", "linear"] = "rbf",
        num_centres: int = 100,
        search_horizon: int | None = None,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def num_layers(self) -> int: ...
    @property
    def kernel(self) -> Literal["rbf", "matern72", "matern52", "matern32", "matern12"]: ...
    @property
    def linear(self) -> bool: ...
    @property
    def num_inducing(self) -> int: ...
    @property
    def draw(self) -> Literal["pathwise", "joint", "marginal"]: ...
    @property
    def refresh(self) -> Literal["step", "plan"]: ...
    @property
    def num_features(self) -> int: ...
    @property
    def first_training_iterations(self) -> int: ...
    @property
    def training_iterations(self) -> int: ...
    @property
    def num_chains(self) -> int: ...
    @property
    def num_samples(self) -> int: ...
    @property
    def sample_spacing(self) -> int: ...
    @property
    def resample_samples(self) -> int: ...
    @property
    def relocate(self) -> bool: ...
    @property
    def add_noise(self) -> bool: ...
    @property
    def split_noise(self) -> bool: ...
    @property
    def compile(self) -> bool: ...
    @property
    def step_size(self) -> float: ...
    @property
    def decay(self) -> float: ...
    @property
    def hyperparameters(self) -> Literal["sampled", "optimised"]: ...
    @property
    def hyperparameter_step_size(self) -> float: ...
    @property
    def hyperparameters_every(self) -> int: ...
    @property
    def window_size(self) -> int: ...
    @property
    def batch_size(self) -> int: ...
    @property
    def gibbs_every(self) -> int: ...
    @property
    def gibbs_rows(self) -> int: ...
    @property
    def patience(self) -> int | None: ...
    @property
    def look_every(self) -> int: ...
    @property
    def num_worlds(self) -> int: ...
    @property
    def num_paths(self) -> int: ...
    @property
    def first_search_steps(self) -> int: ...
    @property
    def search_steps(self) -> int: ...
    @property
    def search_step_size(self) -> float: ...
    @property
    def policy_dropout(self) -> float: ...
    @property
    def match_moments(self) -> bool: ...
    @property
    def policy_form(self) -> Literal["rbf", "linear"]: ...
    @property
    def num_centres(self) -> int: ...
    @property
    def search_horizon(self) -> int | None: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...

class MixtureMPCAgentBase(MPCAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        members: Sequence[Literal["deep-gp", "sparse-gp", "ensemble"]] = ('deep-gp', 'ensemble'),
        score_every: int = 5,
        evidence_share: float = 0.5,
        deep_gp_num_layers: int = 2,
        deep_gp_kernel: Literal["rbf", "matern72", "matern52", "matern32", "matern12"] = "matern32",
        deep_gp_linear: bool = False,
        deep_gp_num_inducing: int = 100,
        deep_gp_draw: Literal["pathwise", "joint", "marginal"] = "pathwise",
        deep_gp_refresh: Literal["step", "plan"] = "plan",
        deep_gp_num_features: int = 64,
        deep_gp_first_training_iterations: int = 1000,
        deep_gp_training_iterations: int = 300,
        deep_gp_num_chains: int = 5,
        deep_gp_num_samples: int = 100,
        deep_gp_sample_spacing: int = 20,
        deep_gp_resample_samples: int = 5,
        deep_gp_relocate: bool = True,
        deep_gp_add_noise: bool = True,
        deep_gp_split_noise: bool = True,
        deep_gp_compile: bool = True,
        deep_gp_step_size: float = 0.1,
        deep_gp_decay: float = 0.05,
        deep_gp_hyperparameters: Literal["sampled", "optimised"] = "optimised",
        deep_gp_hyperparameter_step_size: float = 0.02,
        deep_gp_learning_rate: float = 0.1,
        deep_gp_hyperparameters_every: int = 1,
        deep_gp_window_size: int = 1,
        deep_gp_batch_size: int = 256,
        deep_gp_gibbs_every: int = 20,
        deep_gp_gibbs_rows: int = 4096,
        deep_gp_patience: int | None = None,
        deep_gp_look_every: int = 100,
        sparse_gp_kernel: Literal["rbf", "matern72", "matern52", "matern32", "matern12"] = "rbf",
        sparse_gp_num_inducing: int = 200,
        sparse_gp_exact: bool = False,
        sparse_gp_max_training_iterations: int = 200,
        sparse_gp_draw: Literal["DS", "MM", "AMM"] = "DS",
        sparse_gp_add_noise: bool = True,
        sparse_gp_split_noise: bool = True,
        sparse_gp_update_within_episode: bool = False,
        ensemble_num_members: int = 5,
        ensemble_num_hidden_layers: int = 3,
        ensemble_hidden_size: int = 500,
        ensemble_weight_decay: Sequence[float] = (0.0001, 0.00025, 0.00025, 0.0005),
        ensemble_learning_rate: float = 0.001,
        ensemble_batch_size: int = 32,
        ensemble_num_epochs: int = 300,
        ensemble_patience: int | None = 15,
        ensemble_draw: Literal["TS1", "TSinf", "DS", "MM", "expectation"] = "TSinf",
        ensemble_add_noise: bool = True,
        ensemble_split_noise: bool = False,
        ensemble_half_precision: bool = False,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def members(self) -> Sequence[Literal["deep-gp", "sparse-gp", "ensemble"]]: ...
    @property
    def score_every(self) -> int: ...
    @property
    def evidence_share(self) -> float: ...
    @property
    def deep_gp_num_layers(self) -> int: ...
    @property
    def deep_gp_kernel(self) -> Literal["rbf", "matern72", "matern52", "matern32", "matern12"]: ...
    @property
    def deep_gp_linear(self) -> bool: ...
    @property
    def deep_gp_num_inducing(self) -> int: ...
    @property
    def deep_gp_draw(self) -> Literal["pathwise", "joint", "marginal"]: ...
    @property
    def deep_gp_refresh(self) -> Literal["step", "plan"]: ...
    @property
    def deep_gp_num_features(self) -> int: ...
    @property
    def deep_gp_first_training_iterations(self) -> int: ...
    @property
    def deep_gp_training_iterations(self) -> int: ...
    @property
    def deep_gp_num_chains(self) -> int: ...
    @property
    def deep_gp_num_samples(self) -> int: ...
    @property
    def deep_gp_sample_spacing(self) -> int: ...
    @property
    def deep_gp_resample_samples(self) -> int: ...
    @property
    def deep_gp_relocate(self) -> bool: ...
    @property
    def deep_gp_add_noise(self) -> bool: ...
    @property
    def deep_gp_split_noise(self) -> bool: ...
    @property
    def deep_gp_compile(self) -> bool: ...
    @property
    def deep_gp_step_size(self) -> float: ...
    @property
    def deep_gp_decay(self) -> float: ...
    @property
    def deep_gp_hyperparameters(self) -> Literal["sampled", "optimised"]: ...
    @property
    def deep_gp_hyperparameter_step_size(self) -> float: ...
    @property
    def deep_gp_learning_rate(self) -> float: ...
    @property
    def deep_gp_hyperparameters_every(self) -> int: ...
    @property
    def deep_gp_window_size(self) -> int: ...
    @property
    def deep_gp_batch_size(self) -> int: ...
    @property
    def deep_gp_gibbs_every(self) -> int: ...
    @property
    def deep_gp_gibbs_rows(self) -> int: ...
    @property
    def deep_gp_patience(self) -> int | None: ...
    @property
    def deep_gp_look_every(self) -> int: ...
    @property
    def sparse_gp_kernel(self) -> Literal["rbf", "matern72", "matern52", "matern32", "matern12"]: ...
    @property
    def sparse_gp_num_inducing(self) -> int: ...
    @property
    def sparse_gp_exact(self) -> bool: ...
    @property
    def sparse_gp_max_training_iterations(self) -> int: ...
    @property
    def sparse_gp_draw(self) -> Literal["DS", "MM", "AMM"]: ...
    @property
    def sparse_gp_add_noise(self) -> bool: ...
    @property
    def sparse_gp_split_noise(self) -> bool: ...
    @property
    def sparse_gp_update_within_episode(self) -> bool: ...
    @property
    def ensemble_num_members(self) -> int: ...
    @property
    def ensemble_num_hidden_layers(self) -> int: ...
    @property
    def ensemble_hidden_size(self) -> int: ...
    @property
    def ensemble_weight_decay(self) -> Sequence[float]: ...
    @property
    def ensemble_learning_rate(self) -> float: ...
    @property
    def ensemble_batch_size(self) -> int: ...
    @property
    def ensemble_num_epochs(self) -> int: ...
    @property
    def ensemble_patience(self) -> int | None: ...
    @property
    def ensemble_draw(self) -> Literal["TS1", "TSinf", "DS", "MM", "expectation"]: ...
    @property
    def ensemble_add_noise(self) -> bool: ...
    @property
    def ensemble_split_noise(self) -> bool: ...
    @property
    def ensemble_half_precision(self) -> bool: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...

class PETSAgentBase(MPCAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        num_members: int = 5,
        num_hidden_layers: int = 3,
        hidden_size: int = 500,
        weight_decay: Sequence[float] = (0.0001, 0.00025, 0.00025, 0.0005),
        learning_rate: float = 0.001,
        batch_size: int = 32,
        num_epochs: int = 5,
        patience: int | None = None,
        draw: Literal["TS1", "TSinf", "DS", "MM", "expectation"] = "TSinf",
        add_noise: bool = True,
        split_noise: bool = False,
        half_precision: bool = False,
        horizon: int = 25,
        num_candidates: int = 400,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 20,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def num_members(self) -> int: ...
    @property
    def num_hidden_layers(self) -> int: ...
    @property
    def hidden_size(self) -> int: ...
    @property
    def weight_decay(self) -> Sequence[float]: ...
    @property
    def batch_size(self) -> int: ...
    @property
    def num_epochs(self) -> int: ...
    @property
    def patience(self) -> int | None: ...
    @property
    def draw(self) -> Literal["TS1", "TSinf", "DS", "MM", "expectation"]: ...
    @property
    def add_noise(self) -> bool: ...
    @property
    def split_noise(self) -> bool: ...
    @property
    def half_precision(self) -> bool: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...

class PILCOAgentBase(PolicyAgent):
    def __init__(
        self,
        *args: str | type[BasePolicy] | Env | VecEnv | None,
        policy: str | type[BasePolicy] = "MPCPolicy",
        env: Env | VecEnv | str | None = None,
        num_inducing: int = 100,
        exact: bool = False,
        max_training_iterations: int = 200,
        num_points: int = 50,
        max_search_iterations: int = 100,
        policy_form: Literal["rbf", "linear"] = "rbf",
        num_centres: int = 100,
        search_horizon: int | None = None,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        risk: Literal["mean", "mean-std", "cvar", "worst", "best"] = "mean",
        risk_aversion: float = 1.0,
        cvar_share: float = 0.2,
        learning_starts: int | None = None,
        exploration: Literal["uniform", "held", "coloured", "chirp"] = "uniform",
        exploration_hold: int = 5,
        exploration_beta: float = 1.0,
        train_freq: int | None = None,
        observation_spec: ObservationSpec | None = None,
        time_budget: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | PathLike[str] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        planner: Literal["cem", "icem", "mppi", "gradient"] | str | Callable[..., Planner] | Planner | None = "cem",
        reward_fn: RewardFn | Literal["learned"] | None = None,
        terminated_fn: TerminatedFn | Literal["learned"] | Literal["never"] | None = None,
        first_controller: Callable[[Any], Any] | None = None,
        device: device | str = "cpu",
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        control_cost: float = 0.0,
        num_starts: int = 4,
        optimiser: Literal["adam", "lbfgs"] = "lbfgs",
        action_step: float = 0.1,
        start_from: Literal["plan", "cem"] = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
    ) -> None: ...
    @property
    def num_inducing(self) -> int: ...
    @property
    def exact(self) -> bool: ...
    @property
    def max_training_iterations(self) -> int: ...
    @property
    def num_points(self) -> int: ...
    @property
    def max_search_iterations(self) -> int: ...
    @property
    def policy_form(self) -> Literal["rbf", "linear"]: ...
    @property
    def num_centres(self) -> int: ...
    @property
    def search_horizon(self) -> int | None: ...
    @property
    def horizon(self) -> int: ...
    @property
    def num_candidates(self) -> int: ...
    @property
    def num_elites(self) -> int | None: ...
    @property
    def num_iterations(self) -> int: ...
    @property
    def smoothing(self) -> float: ...
    @property
    def min_std(self) -> float: ...
