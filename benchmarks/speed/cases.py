"""The sizes of the paper's tasks, data of these sizes, and the timing that every figure here is made with."""

import resource
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc.agents.presets import PAPER
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.planning.cem import CEM
from gym_dgpmpc.planning.rollout import rollout_objective
from gym_dgpmpc.types import DynamicsModel, ObservationSpec, Transitions

NUM_CANDIDATES, NUM_PARTICLES, NUM_INDUCING, NUM_FEATURES, BATCH_SIZE = 300, 5, 100, 64, 256


class Case(NamedTuple):
    """A task of the paper, as far as cost goes: what is learned does not change it."""

    name: str
    observation_size: int
    action_size: int
    spec: ObservationSpec
    horizon: int
    num_iterations: int
    hidden: tuple[int, int]
    """Layers and width of PETS's networks."""


def case(name: str, env_id: str, hidden: tuple[int, int]) -> Case:
    """The sizes that agents meet in the environment, with the paper's settings for it."""
    env, settings = gymnasium.make(env_id), PAPER[env_id]
    assert isinstance(env.observation_space, Box) and isinstance(env.action_space, Box)
    sizes = env.observation_space.shape[0], env.action_space.shape[0]
    spec = env.get_wrapper_attr("observation_spec")
    return Case(name, *sizes, spec, settings["horizon"], settings["num_iterations"], hidden)


CASES = (
    case("cart-pole", "ModCartPole-v0", (3, 500)),
    case("reacher", "BiasedReacher-v0", (4, 200)),
    case("half-cheetah", "RiskSensitiveHalfCheetah-v0", (4, 200)),
)

DRAWS: Mapping[str, dict[str, Any]] = {
    "pathwise, step": {"draw": "pathwise", "refresh": "step"},
    "pathwise, plan": {"draw": "pathwise", "refresh": "plan"},
    "pathwise, step, PyTorch": {"draw": "pathwise", "refresh": "step", "compile": False},
    "marginal": {"draw": "marginal"},
    "joint": {"draw": "joint"},
}
"""Names in the tables, and the arguments of `DeepGPDynamics` behind them."""

BY_STEP = ("marginal", "joint")
"""Draws so slow that single rollout steps are timed and multiplied by the number of them in a plan."""


def timed(call: Callable[[], Any], repeats: int, scale: float = 1.0) -> dict[str, float]:
    """Milliseconds of one call times ``scale``, after two calls that are not counted.

    Median and 95th percentile by the clock, and the least time of the processor, which others that use it change least.
    """
    call(), call()
    samples = []
    for _ in range(repeats):
        started, used = time.perf_counter(), time.process_time()
        call()
        samples.append((time.perf_counter() - started, time.process_time() - used))
    clock, processor = 1e3 * scale * np.array(samples).T
    percentiles = {"p50_ms": float(np.median(clock)), "p95_ms": float(np.quantile(clock, 0.95))}
    return percentiles | {"cpu_ms": float(processor.min()), "repeats": repeats}


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_actions(case: Case) -> Tensor:
    """K candidate sequences of H actions."""
    return 2.0 * torch.rand(NUM_CANDIDATES, case.horizon, case.action_size, generator=seeded(2)) - 1.0


def transitions(case: Case, num: int, seed: int = 0) -> Transitions:
    """A smooth system of the case's sizes under random actions."""
    generator = seeded(seed)
    size = case.observation_size
    observation = torch.randn(num, size, generator=generator)
    action = 2.0 * torch.rand(num, case.action_size, generator=generator) - 1.0
    mixing = 0.1 * torch.randn(size + case.action_size, size, generator=generator)
    after = observation + torch.tanh(torch.cat([observation, action], dim=1) @ mixing)
    constant = list(case.spec.constant)
    after[:, constant] = observation[:, constant]
    return Transitions(observation, action, after)


def reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """As cheap as rewards are: how near one number is to where it should be, less the action's cost."""
    return -(next_observation[..., 0] - 0.5).square() - 0.01 * action.square().sum(-1)


def deep_gp(case: Case, num_layers: int, data: Transitions, **settings: Any) -> DeepGPDynamics:
    """A fitted deep GP of the case's sizes; a few iterations, since cost does not depend on what was learned."""
    arguments = {"num_inducing": NUM_INDUCING, "num_features": NUM_FEATURES, "num_samples": 10} | settings
    model = DeepGPDynamics(
        case.observation_size, case.action_size, case.spec, num_layers=num_layers, first_training_iterations=30,
        sample_spacing=1, **arguments,
    )  # fmt: skip
    model.fit(data, seeded(0))
    return model


def planner(case: Case, num_candidates: int = NUM_CANDIDATES) -> CEM:
    """CEM with all its iterations, never stopped early."""
    bound = torch.ones(case.action_size)
    return CEM(
        action_low=-bound, action_high=bound, horizon=case.horizon, num_candidates=num_candidates,
        num_elites=num_candidates // 10, num_iterations=case.num_iterations, min_std=0.0,
    )  # fmt: skip


def plan_call(
    case: Case,
    model: DynamicsModel,
    data: Transitions,
    num_candidates: int = NUM_CANDIDATES,
    num_particles: int = NUM_PARTICLES,
) -> Callable[[], None]:
    """One plan from scratch: draw a world, optimise."""
    cem, generator = planner(case, num_candidates), seeded(1)

    def plan() -> None:
        world = model.draw(num_particles, case.horizon, generator)
        objective = rollout_objective(world, reward, data.observation[0], num_particles)
        cem.plan(objective, cem.initial_plan(), generator)

    return plan


def step_call(case: Case, model: DynamicsModel, data: Transitions) -> Callable[[], None]:
    """One rollout step of all particles and candidates."""
    world = model.draw(NUM_PARTICLES, case.horizon, seeded(1))
    state = data.observation[0].expand(NUM_PARTICLES, NUM_CANDIDATES, -1).contiguous()
    action = random_actions(case)[:, 0]

    def step() -> None:
        world(state, action, 0)

    return step


def peak_memory_mb() -> float:
    """The most memory that the process has held, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
