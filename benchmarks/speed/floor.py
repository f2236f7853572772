"""The bare arithmetic of a pathwise plan in PyTorch, without anything around it: what a plan is held against."""

from collections.abc import Callable
from functools import partial

import torch

from benchmarks.speed.cases import NUM_CANDIDATES, NUM_FEATURES, NUM_INDUCING, NUM_PARTICLES, Case, seeded
from gym_dgpmpc.data.encoding import Encoder


def outputs(case: Case, num_layers: int) -> list[int]:
    """The number of outputs of each layer, from the first to the last."""
    encoder = Encoder(case.observation_size, case.action_size, case.spec)
    return [encoder.input_size] * (num_layers - 1) + [encoder.target_size]


def rollout_flops(case: Case, num_layers: int) -> float:
    """Multiplications and additions of the two products of all layers in one rollout step of P K points."""
    size = Encoder(case.observation_size, case.action_size, case.spec).input_size
    points, frequencies = NUM_PARTICLES * NUM_CANDIDATES, NUM_FEATURES // 2
    columns_in, columns_out = NUM_INDUCING + frequencies, NUM_INDUCING + NUM_FEATURES
    return sum(2.0 * points * (size * columns_in + out * columns_out) for out in outputs(case, num_layers))


def bare_step(case: Case, num_layers: int) -> Callable[[], None]:
    """Products, square roots, exponentials and waves of one rollout step, into buffers, a particle at a time."""
    size = Encoder(case.observation_size, case.action_size, case.spec).input_size
    random = partial(torch.randn, generator=seeded(0))
    points = random(NUM_CANDIDATES, size + 2)
    near, far = random(size + 2, NUM_INDUCING), random(size, NUM_FEATURES // 2)
    distances, angles = torch.empty(NUM_CANDIDATES, NUM_INDUCING), torch.empty(NUM_CANDIDATES, NUM_FEATURES // 2)
    waves = torch.empty(NUM_CANDIDATES, NUM_FEATURES)
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
                torch.mm(points[:, :size], far, out=angles)
                torch.cos(angles, out=waves[:, : NUM_FEATURES // 2])
                torch.sin(angles, out=waves[:, NUM_FEATURES // 2 :])
                torch.mm(distances, kernel_out, out=out)
                torch.mm(waves, feature_out, out=out)

    return step


def bare_training(num_layers: int, batch_size: int, num_chains: int, num_iterations: int) -> Callable[[], None]:
    """What training iterations of all chains, one of which moves hyperparameters, cannot do without, in float64.

    Per layer and iteration the kernel's maps and the two products with L^-1 of a gradient by the inducing outputs; once
    a Cholesky, its inverse, and the three products more of a gradient by the hyperparameters.
    """
    random = partial(torch.randn, generator=seeded(0), dtype=torch.float64)
    matrix, eye = random(NUM_INDUCING, NUM_INDUCING), torch.eye(NUM_INDUCING, dtype=torch.float64)
    covariance = (matrix @ matrix.mT + NUM_INDUCING * eye).repeat(num_chains, 1, 1)
    right = random(num_chains, NUM_INDUCING, batch_size)
    positive = right.abs()

    def iterations() -> None:
        for _ in range(num_layers):
            factor = torch.linalg.cholesky_ex(covariance)[0]
            inverse = torch.linalg.solve_triangular(factor, eye, upper=False)
            for _ in range(num_iterations):
                torch.exp(right)
                torch.sqrt(positive)
                projected = inverse @ right
                inverse.mT @ projected
            _ = inverse.mT @ (right @ projected.mT) @ inverse

    return iterations
