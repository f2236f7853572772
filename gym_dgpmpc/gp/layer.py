"""One sparse Gaussian-process layer with whitened inducing outputs.

`deep_gp.py` composes layers; the collapsed bound (`sgpr.py`) differentiates through `project`, the draws of a trained
model reuse `factorise`. All outputs of a layer share one ARD kernel, so one factorisation serves them all.

A layer may stand for C layers side by side, those of C chains: every tensor then has a leading axis "C", which the
points have too, before their own.
"""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import Kernel, pairwise_sqdist, scaled_sqdist
from gym_dgpmpc.gp.linalg import cholesky
from gym_dgpmpc.gp.projection import projection


class Layer(NamedTuple):
    """Kernel, its hyperparameters theta, and inducing inputs Z of one layer."""

    kernel: Kernel
    inducing_inputs: Float[Tensor, "*c M D"]
    log_lengthscale: Float[Tensor, "*c D"]
    log_variance: Float[Tensor, "*c"]

    @property
    def lengthscale(self) -> Tensor:
        return self.log_lengthscale.exp()

    @property
    def variance(self) -> Tensor:
        return self.log_variance.exp()

    def parameters(self) -> dict[str, Tensor]:
        """Every tensor by name."""
        return {name: getattr(self, name) for name in PARAMETERS}


PARAMETERS = ("inducing_inputs", "log_lengthscale", "log_variance")
"""The tensors of a `Layer`, which training moves and states hold; the kernel is a setting."""


def parameter_shapes(num_inducing: int, input_size: int) -> dict[str, tuple[int, ...]]:
    """The shape of each of the `PARAMETERS` of a layer with M inducing inputs of D numbers."""
    return dict(zip(PARAMETERS, ((num_inducing, input_size), (input_size,), ()), strict=True))


def factorise(layer: Layer) -> Float[Tensor, "*c M M"]:
    """L_z, the lower Cholesky factor of K_zz + jitter.

    Raises:
        FactorisationError: see `linalg.cholesky`.
    """
    z = layer.inducing_inputs
    unit = layer.kernel.correlation(scaled_sqdist(z, z, layer.lengthscale))
    return _matrix(layer.variance.sqrt()) * cholesky(unit, unit.new_ones(()))


def conditional(
    layer: Layer,
    factor: Float[Tensor, "*c M M"],
    whitened: Float[Tensor, "*p M O"],
    x: Float[Tensor, "*p n D"],
) -> tuple[Float[Tensor, "*p n O"], Float[Tensor, "*p n"]]:
    """Mean and marginal variance of f(x) - m(x) given u = L_z v, p(f | u) of the sparse Gaussian process.

    mean = k_xz L_z^-T v, variance = k_xx - |L_z^-1 k_zx|^2, the same for every output.
    """
    projected = project(layer, factor, x)
    # The kernel's variance enters here and not in the large matrix, which training differentiates through.
    variance = layer.variance.unsqueeze(-1) * (1.0 - projected.square().sum(-2))
    return _matrix(layer.variance.sqrt()) * (projected.mT @ whitened), variance.clamp_min(0.0)


def joint_conditional(
    layer: Layer,
    factor: Float[Tensor, "*c M M"],
    whitened: Float[Tensor, "*p M O"],
    x: Float[Tensor, "*p n D"],
) -> tuple[Float[Tensor, "*p n O"], Float[Tensor, "*p n n"]]:
    """As `conditional`, with the full covariance of the n points: k_xx' - k_xz K_zz^-1 k_zx'."""
    projected = project(layer, factor, x)
    prior = layer.kernel.correlation(pairwise_sqdist(x / layer.lengthscale.unsqueeze(-2)))
    covariance = _matrix(layer.variance) * (prior - projected.mT @ projected)
    return _matrix(layer.variance.sqrt()) * (projected.mT @ whitened), covariance


def project(layer: Layer, factor: Float[Tensor, "*c M M"], x: Float[Tensor, "*p n D"]) -> Float[Tensor, "*p M n"]:
    """L_z^-1 k_zx / sigma, of which every column has a length of at most one.

    Args:
        factor: `factorise` of this very layer. Gradients with respect to the layer are complete without any flowing
            through the factor; it may have been computed without gradients.
    """
    lengthscale = layer.lengthscale.unsqueeze(-2)
    unit = (factor / _matrix(layer.variance.sqrt())).detach()
    return projection(layer.kernel, x / lengthscale, layer.inducing_inputs / lengthscale, unit)


def _matrix(scale: Float[Tensor, "*c"]) -> Float[Tensor, "*c 1 1"]:
    """In the shape that multiplies a matrix of each chain."""
    return scale[..., None, None]
