"""One sparse Gaussian-process layer with whitened inducing outputs.

`deep_gp.py` composes layers; training differentiates through `conditional`, the draws of a trained model reuse
`factorise`. All outputs of a layer share one ARD kernel, so one factorisation serves them all.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import Kernel, correlation, pairwise_sqdist, scaled_sqdist
from gym_dgpmpc.gp.linalg import cholesky


class Layer(NamedTuple):
    """Hyperparameters theta and inducing inputs Z of one layer."""

    inducing_inputs: Float[Tensor, "M D"]
    log_lengthscale: Float[Tensor, "D"]
    log_variance: Float[Tensor, ""]

    @property
    def lengthscale(self) -> Tensor:
        return self.log_lengthscale.exp()

    @property
    def variance(self) -> Tensor:
        return self.log_variance.exp()


def covariance(
    kernel: Kernel, layer: Layer, x: Float[Tensor, "*b n D"], z: Float[Tensor, "m D"]
) -> Float[Tensor, "*b n m"]:
    """k(x, z) under the layer's hyperparameters."""
    return layer.variance * correlation(kernel, scaled_sqdist(x, z, layer.lengthscale))


def factorise(kernel: Kernel, layer: Layer) -> Float[Tensor, "M M"]:
    """L_z, the lower Cholesky factor of K_zz + jitter.

    Raises:
        FactorisationError: see `linalg.cholesky`.
    """
    return cholesky(covariance(kernel, layer, layer.inducing_inputs, layer.inducing_inputs), layer.variance)


def conditional(
    kernel: Kernel,
    layer: Layer,
    factor: Float[Tensor, "M M"],
    whitened: Float[Tensor, "*p M O"],
    x: Float[Tensor, "*p n D"],
) -> tuple[Float[Tensor, "*p n O"], Float[Tensor, "*p n"]]:
    """Mean and marginal variance of f(x) - m(x) given u = L_z v, p(f | u) of the sparse Gaussian process.

    mean = k_xz L_z^-T v, variance = k_xx - |L_z^-1 k_zx|^2, the same for every output.
    """
    projected = _project(kernel, layer, factor, x)
    variance = layer.variance - projected.square().sum(-2)
    return projected.mT @ whitened, variance.clamp_min(0.0)


def joint_conditional(
    kernel: Kernel,
    layer: Layer,
    factor: Float[Tensor, "M M"],
    whitened: Float[Tensor, "*p M O"],
    x: Float[Tensor, "*p n D"],
) -> tuple[Float[Tensor, "*p n O"], Float[Tensor, "*p n n"]]:
    """As `conditional`, with the full covariance of the n points: k_xx' - k_xz K_zz^-1 k_zx'."""
    projected = _project(kernel, layer, factor, x)
    prior = layer.variance * correlation(kernel, pairwise_sqdist(x / layer.lengthscale))
    return projected.mT @ whitened, prior - projected.mT @ projected


def _project(kernel: Kernel, layer: Layer, factor: Tensor, x: Tensor) -> Tensor:
    """L_z^-1 k_zx "*p M n"."""
    return torch.linalg.solve_triangular(factor, covariance(kernel, layer, x, layer.inducing_inputs).mT, upper=False)
