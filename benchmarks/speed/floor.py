"""The bare arithmetic of a pathwise plan in PyTorch, without anything around it: what a plan is held against."""

from collections.abc import Callable
from functools import partial

import torch

from benchmarks.speed.cases import NUM_CANDIDATES, NUM_INDUCING, NUM_PARTICLES, Case, seeded
from gym_dgpmpc.data.encoding import Encoder

NUM_FEATURES = 128


def outputs(case: Case, num_layers: int) -> list[int]:
    """The number of outputs of each layer, from the first to the last."""
    encoder = Encoder(case.observation_size, case.action_size, case.spec)
    return [encoder.input_size] * (num_layers - 1) + [encoder.target_size]


def rollout_flops(case: Case, num_layers: int) -> float:
    """Multiplications and additions of the two products of all layers in one rollout step of P K points."""
    size = Encoder(case.observation_size, case.action_size, case.spec).input_size
    points, columns = NUM_PARTICLES * NUM_CANDIDATES, NUM_INDUCING + NUM_FEATURES
    return sum(2.0 * points * columns * (size + out) for out in outputs(case, num_layers))


def bare_step(case: Case, num_layers: int) -> Callable[[], None]:
    """Products, square roots, exponentials and cosines of one rollout step, into buffers, a particle at a time."""
    size = Encoder(case.observation_size, case.action_size, case.spec).input_size
    random = partial(torch.randn, generator=seeded(0))
    points = random(NUM_CANDIDATES, size + 2)
    near, far = random(size + 2, NUM_INDUCING), random(size + 2, NUM_FEATURES)
    distances, waves = torch.empty(NUM_CANDIDATES, NUM_INDUCING), torch.empty(NUM_CANDIDATES, NUM_FEATURES)
    positive = torch.rand(NUM_CANDIDATES, NUM_INDUCING, generator=seeded(1)) + 0.5
    last = [
        (random(NUM_INDUCING, out), random(NUM_FEATURES, out), torch.empty(NUM_CANDIDATES, out))
        for out in outputs(case, num_layers)
    ]

    def step() -> None:
        for kernel_out, feature_out, out in last:
            for _ in range(NUM_PARTICLES):
                torch.mm(points, near, out=distances)
                torch.sqrt(positive, out=distances)
                torch.exp(positive, out=distances)
                torch.mm(points, far, out=waves)
                torch.cos(waves, out=waves)
                torch.mm(distances, kernel_out, out=out)
                torch.mm(waves, feature_out, out=out)

    return step


def bare_training(num_layers: int, batch_size: int) -> Callable[[], None]:
    """What one training iteration cannot do without: per layer a Cholesky, four solves, four products, in float64."""
    random = partial(torch.randn, generator=seeded(0), dtype=torch.float64)
    matrix = random(NUM_INDUCING, NUM_INDUCING)
    covariance = matrix @ matrix.mT + NUM_INDUCING * torch.eye(NUM_INDUCING, dtype=torch.float64)
    right = random(NUM_INDUCING, batch_size)

    def iteration() -> None:
        for _ in range(num_layers):
            factor = torch.linalg.cholesky_ex(covariance)[0]
            for _ in range(2):  # a gradient by the inducing outputs, another by the hyperparameters
                projected = torch.linalg.solve_triangular(factor, right, upper=False)
                torch.linalg.solve_triangular(factor.mT, projected, upper=True)
                torch.exp(right)
                torch.sqrt(right)
            outer = right @ projected.mT
            torch.linalg.solve_triangular(factor.mT, outer, upper=True)
            torch.linalg.solve_triangular(factor, outer, upper=False, left=False)

    return iteration
