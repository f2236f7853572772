"""Hyperparameters and inducing inputs of a sparse Gaussian process, by L-BFGS on the collapsed bound.

Nothing is sampled and nothing is random: the bound's exact gradient and SciPy's optimiser decide everything.
"""

import math
from typing import NamedTuple

import numpy as np
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.gp.layer import Layer
from gym_dgpmpc.gp.sgpr import collapsed_bound
from gym_dgpmpc.types import ProgressFn

LENGTHSCALES, VARIANCES, NOISE_VARIANCES = (0.01, 1e3), (1e-4, 1e4), (1e-6, 10.0)
"""Limits of the hyperparameters, for standardised data: beyond them factorisations fail and the bound gains nothing."""


class Maximum(NamedTuple):
    """What the optimiser found."""

    model: DeepGP
    bound: float  # nats per datum and output
    num_iterations: int


def maximise_bound(
    model: DeepGP,
    data: Data,
    max_iterations: int,
    *,
    free_inducing_inputs: bool = True,
    on_progress: ProgressFn | None = None,
) -> Maximum:
    """Climb the collapsed bound from ``model``, which has one layer.

    Args:
        data: standardised.
        max_iterations: iterations of L-BFGS; each takes about one evaluation of the bound and its gradient.
        free_inducing_inputs: move the inducing inputs too, instead of the hyperparameters alone.
        on_progress: is told after every iteration how many there were, of how many at most, and the negative bound.
    """
    from scipy.optimize import OptimizeResult, minimize  # here, for it takes long to import

    (layer,) = model.layers
    start = [layer.log_lengthscale, layer.log_variance.unsqueeze(0), model.log_noise]
    limits = [LENGTHSCALES, VARIANCES, NOISE_VARIANCES]
    boxes = [
        (math.log(low), math.log(high))
        for values, (low, high) in zip(start, limits, strict=True)
        for _ in range(len(values))
    ]
    if free_inducing_inputs:
        start.append(layer.inducing_inputs.flatten())
        boxes += [(-math.inf, math.inf)] * layer.inducing_inputs.numel()
    sizes = [len(values) for values in start]

    def unpack(flat: torch.Tensor) -> DeepGP:
        log_lengthscale, log_variance, log_noise, *rest = flat.split(sizes)
        inducing = rest[0].view_as(layer.inducing_inputs) if rest else layer.inducing_inputs
        return DeepGP((Layer(layer.kernel, inducing, log_lengthscale, log_variance.squeeze(0)),), log_noise)

    def negative_bound(flat: np.ndarray) -> tuple[float, np.ndarray]:
        with torch.enable_grad():
            position = torch.tensor(flat, dtype=data.x.dtype, device=data.x.device, requires_grad=True)
            candidate = unpack(position)
            value = -collapsed_bound(candidate.layers[0], candidate.noise_variance, *data) / data.y.numel()
            (gradient,) = torch.autograd.grad(value, position)
        return value.item(), gradient.cpu().numpy()

    losses: list[float] = []  # one per iteration

    def report(intermediate_result: OptimizeResult) -> None:
        losses.append(float(intermediate_result.fun))
        if on_progress is not None:
            on_progress(len(losses), max_iterations, losses[-1])

    low, high = np.array(boxes).T
    found = minimize(
        negative_bound,
        torch.cat(start).cpu().numpy().clip(low, high),
        jac=True,
        method="L-BFGS-B",
        bounds=boxes,
        callback=report,
        options={"maxiter": max_iterations},
    )
    return Maximum(unpack(torch.from_numpy(found.x).to(data.x)), -float(found.fun), len(losses))
