"""The same rollout step by `torch.compile`, which this package does not use: what it would give, and cost."""

import time
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.speed.cases import NUM_CANDIDATES, NUM_PARTICLES, Case, random_actions, seeded
from gym_dgpmpc.dynamics.deep_gp.draws import PathwiseSampler
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.types import Transitions


def compiled_step(case: Case, model: DeepGPDynamics, data: Transitions) -> tuple[Callable[[], None], float]:
    """One rollout step of all layers of a Matern-3/2 model, and the seconds that compiling took."""
    world = model.draw(NUM_PARTICLES, case.horizon, seeded(1))
    assert isinstance(world, PathwiseSampler) and model.kernel.name == "matern32"
    layers = [
        (layer.inverse_lengthscale.unsqueeze(1), *weights, layer.kernel_out[0].mT, layer.feature_out[0].mT)
        for layer, weights in zip(world.layers, world._in_weights, strict=True)
    ]

    def evaluate(x: Tensor) -> Tensor:
        for index, (inverse, near, far, kernel_out, feature_out) in enumerate(layers):
            scaled = x * inverse
            square = scaled.square().sum(-1, keepdim=True)
            augmented = torch.cat([scaled, square, torch.ones_like(square)], dim=-1)
            s = (augmented @ near).clamp_min(1e-36).sqrt()
            value = ((1.0 + s) * torch.exp(-s)) @ kernel_out + torch.cos(augmented @ far) @ feature_out
            x = value if index == len(layers) - 1 else x + value
        return x

    observation = data.observation[0].expand(NUM_PARTICLES, NUM_CANDIDATES, -1)
    x = world.coordinates.encode(observation, random_actions(case)[:, 0])
    compiled = torch.compile(evaluate, fullgraph=True, dynamic=False)
    started = time.perf_counter()
    with torch.no_grad():
        difference = (compiled(x) - evaluate(x)).abs().max()
    seconds = time.perf_counter() - started
    assert difference < 1e-2, f"torch.compile gave something else, by {difference}"

    def step() -> None:
        with torch.no_grad():
            compiled(x)

    return step, seconds
