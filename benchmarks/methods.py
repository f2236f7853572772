"""The methods that are compared: the class of each, and its settings on a task.

A method's settings are all keyword arguments that it is made with: the defaults of its class, overridden by the presets
for the task, then by what the method's name says, by what the task needs, and by what the user asks for.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise

from benchmarks.tasks import Task
from gym_dgpmpc.agents import (
    DeepPILCOAgent,
    DGPMPCAgent,
    GPMPCAgent,
    MCPILCOAgent,
    MixtureMPCAgent,
    MPCAgent,
    PETSAgent,
    PILCOAgent,
    presets,
)
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.planning.registry import planner_factory, settings_of_others
from gym_dgpmpc.settings import settings_of

NO_SETTINGS = {
    "env",
    "policy",
    "seed",
    "verbose",
    "tensorboard_log",
    "stats_window_size",
    "device",
    "first_controller",
    "_init_setup_model",
}
"""Arguments that do not influence what is learned, or that the runner sets itself."""
MAX_LAYERS = 5
TD3_NOISE = 0.1
"""Standard deviation of the exploration of Fujimoto et al. (2018), in half the width of the action range."""

OPTIMUM: Mapping[str, Any] = {"num_epochs": 300, "patience": 15}
"""An ensemble's training to its held-out optimum: until 15 epochs in a row bring nothing, 300 at most."""

_FASTER: Mapping[str, Any] = {"half_precision": True}
"""A third of the time where the processor has instructions for it; what it does to predictions: docs/deviations.md."""

Settings = dict[str, Any]
Presets = Callable[[Task], Mapping[str, Any]]


@dataclass(frozen=True)
class PlanningMethod:
    """A method that learns a model and plans with it, or plans with the true one.

    It plans by CEM unless presets or what is asked for name another ``planner``. Presets of planners that it does not
    plan by do not count.

    Attributes:
        name: its name in a report.
        make_agent: an agent's class, or a function with the same arguments.
        presets: settings by task.
        fixed: settings that the name stands for.
    """

    name: str
    make_agent: Callable[..., MPCAgent]
    presets: Presets
    fixed: Mapping[str, Any] = field(default_factory=dict)

    is_model_free: ClassVar[bool] = False

    def settings(self, task: Task, **asked: Any) -> Settings:
        """Every argument on this task.

        Raises:
            ValueError: the agent has no argument of a name that is asked for.
        """
        given = {**self.presets(task), **self.fixed, **task.for_planning}
        defaults, planner = _defaults(self.make_agent), {**given, **asked}.get("planner", "cem")
        mine = settings_of(planner_factory(planner))
        of_others = settings_of_others(planner)
        if planner != "cem":  # whose settings the agents' signatures have
            defaults = {**{name: setting.default for name, setting in mine.items()}, **defaults}
        defaults, given = (
            {name: value for name, value in settings.items() if name not in of_others} for settings in (defaults, given)
        )
        return _complete(self.name, defaults, given, asked)

    def make(self, env: gymnasium.Env, settings: Settings, seed: int, **arguments: Any) -> MPCAgent:
        """Make the agent; ``arguments`` are those that are not settings."""
        return self.make_agent(env, **settings, seed=seed, **arguments)


@dataclass(frozen=True)
class ModelFreeMethod:
    """One of Stable-Baselines3's algorithms, with its defaults where ``fitted`` has nothing else.

    Attributes:
        name: its name in a report.
        algorithm: its class.
        fitted: settings by task.
        acts_by: the method of the policy that chooses the actions of a run, except random ones.
    """

    name: str
    algorithm: type[BaseAlgorithm]
    fitted: Presets
    acts_by: str = "predict"

    is_model_free: ClassVar[bool] = True

    def settings(self, task: Task, **asked: Any) -> Settings:
        """Every argument on this task that is a plain value, and the task's arguments of the environment.

        Raises:
            ValueError: the algorithm has no argument of a name that is asked for.
        """
        return {**_complete(self.name, _defaults(self.algorithm), self.fitted(task), asked), **task.for_model_free}

    def make(self, env: gymnasium.Env, settings: Settings, seed: int) -> BaseAlgorithm:
        """Make the algorithm, on the CPU and silent."""
        names = inspect.signature(self.algorithm).parameters
        arguments = {name: value for name, value in settings.items() if name in names}
        if settings.get("exploration_noise") is not None:
            assert isinstance(env.action_space, spaces.Box)
            size = env.action_space.shape
            arguments["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, settings["exploration_noise"]))
        policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
        return self.algorithm(policy, env, **arguments, seed=seed, device="cpu")


Method = PlanningMethod | ModelFreeMethod


def true_dynamics_agent(
    env: gymnasium.Env,
    *,
    horizon: int = 30,
    num_candidates: int = 300,
    num_elites: int | None = None,
    num_iterations: int = 5,
    actions_per_plan: int = 1,
    learning_starts: int | None = None,
    seed: int | None = None,
    verbose: int = 0,
    tensorboard_log: str | None = None,
) -> MPCAgent:
    """An agent that plans with the simulator itself, in one world.

    It learns nothing from random actions, but takes them all the same: the episodes of some tasks depend on how many
    there were before, and so it meets the same ones as the other agents.

    Raises:
        ValueError: the environment's simulator cannot be used; see `Simulator`.
    """
    return MPCAgent(
        env,
        TrueDynamics(env),
        horizon=horizon,
        num_candidates=num_candidates,
        num_elites=num_elites,
        num_iterations=num_iterations,
        num_particles=1,
        actions_per_plan=actions_per_plan,
        learning_starts=learning_starts,
        seed=seed,
        verbose=verbose,
        tensorboard_log=tensorboard_log,
    )


def dgp_mpc(num_layers: int, kernel: str) -> str:
    """The name of DGP-MPC with this depth and kernel."""
    return f"DGP-MPC L={num_layers} {kernel}"


def random_steps(task: Task) -> int:
    """The number of random steps with which planning agents start on a task."""
    return _planning(task).get("learning_starts") or task.episode_steps


def _planning(task: Task) -> Mapping[str, Any]:
    """The paper's settings on its tasks, this package's own on Gymnasium's, and the model's.

    Not `presets.PLANNING`: beside the paper, and beside rivals as published, all methods plan and explore as the paper
    does. A suite may ask for it, for every method alike.
    """
    return _of(presets.PAPER, presets.STOCK, presets.DEEP_GP)(task)


def _mixed(task: Task) -> Mapping[str, Any]:
    """As the deep Gaussian process alone, with PETS's networks beside it, which are trained to their optimum."""
    return presets.for_mixture(_planning(task), presets.NETWORKS.get(task.preset, {}))


def _planning_alone(task: Task) -> Mapping[str, Any]:
    names = inspect.signature(true_dynamics_agent).parameters
    return {name: value for name, value in _planning(task).items() if name in names}


def _off_policy(task: Task) -> Mapping[str, Any]:
    """On the paper's tasks one random episode at first, as for planning agents."""
    return {"learning_starts": task.episode_steps} if task.preset in presets.PAPER else {}


def _on_policy(task: Task) -> Mapping[str, Any]:
    """One episode per update, in the largest minibatches of up to PPO's 64 that divide it."""
    divisors = [size for size in range(1, 65) if task.episode_steps % size == 0]
    return {"n_steps": task.episode_steps, "batch_size": max(divisors)}


def _of(*tables: Mapping[str, Mapping[str, Any]]) -> Presets:
    """What tables have for a task, the later ones over the earlier."""
    return lambda task: {name: value for table in tables for name, value in table.get(task.preset, {}).items()}


def _defaults(made_by: Callable[..., Any]) -> Settings:
    parameters = inspect.signature(made_by).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not p.empty and p.name not in NO_SETTINGS}


def _complete(name: str, defaults: Settings, given: Mapping[str, Any], asked: Mapping[str, Any]) -> Settings:
    settings = {**defaults, **given}
    unknown = sorted(set(asked) - set(settings))
    if unknown:
        raise ValueError(f"{name} has no settings {unknown}; it has {sorted(settings)}")
    return settings | dict(asked)


ALL_METHODS: tuple[Method, ...] = (
    *(
        PlanningMethod(dgp_mpc(layers, kernel), DGPMPCAgent, _planning, {"num_layers": layers, "kernel": kernel})
        for layers in range(1, MAX_LAYERS + 1)
        for kernel in KERNELS
    ),
    *(
        PlanningMethod(f"PETS {draw}", PETSAgent, _of(presets.COMPARISON_PETS), {"draw": draw, **_FASTER})
        for draw in ("TS1", "TSinf")
    ),
    PlanningMethod("PETS as published", PETSAgent, _of(presets.PETS), {"draw": "TSinf", **_FASTER}),
    PlanningMethod(
        "PETS TSinf to its optimum",
        PETSAgent,
        _of(presets.COMPARISON_PETS),
        {"draw": "TSinf", **OPTIMUM, **_FASTER},
    ),
    *(
        PlanningMethod(f"GP-{draw}{name}", GPMPCAgent, _of(presets.COMPARISON_GP), {"draw": draw, "add_noise": noise})
        for draw in ("MM", "DS")
        for name, noise in (("", False), (" with noise", True))
    ),
    PlanningMethod("GP-MPC", GPMPCAgent, _of(presets.COMPARISON_GP), {"draw": "AMM", "planner": "gradient"}),
    PlanningMethod("DGP L=2 and PETS", MixtureMPCAgent, _mixed, {"ensemble_half_precision": True}),
    PlanningMethod("MC-PILCO", MCPILCOAgent, _of(presets.POLICY_SEARCH)),
    PlanningMethod(
        "MC-PILCO DGP L=2", MCPILCOAgent, _of(presets.POLICY_SEARCH), {"num_layers": 2, "kernel": "matern32"}
    ),
    PlanningMethod("DeepPILCO", DeepPILCOAgent, _of(presets.POLICY_SEARCH)),
    PlanningMethod("PILCO", PILCOAgent, _of(presets.POLICY_SEARCH)),
    PlanningMethod("true dynamics", true_dynamics_agent, _planning_alone),
    ModelFreeMethod("SAC", SAC, _off_policy),
    ModelFreeMethod("TD3", TD3, lambda task: {**_off_policy(task), "exploration_noise": TD3_NOISE}),
    ModelFreeMethod("CrossQ", CrossQ, _off_policy),
    ModelFreeMethod("TQC", TQC, _off_policy),
    ModelFreeMethod("PPO", PPO, _on_policy, acts_by="forward"),
)

METHODS: Mapping[str, Method] = {method.name: method for method in ALL_METHODS}
"""All methods by name."""
