"""One sparse Gaussian-process layer with whitened inducing outputs.

`deep_gp.py` composes layers; the collapsed bound (`sgpr.py`) differentiates through `project`, the draws of a trained
model reuse `factorise`. All outputs of a layer share one ARD kernel, so one factorisation serves them all.

A layer may stand for C layers side by side, those of C chains: every tensor then has a leading axis "C", which the
points have too, before their own.
"""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import Kernel, pairwise_sqdist, sqdist
from gym_dgpmpc.gp.linalg import cholesky
from gym_dgpmpc.gp.projection import linear_covariance, projection


class Layer(NamedTuple):
    """Kernel, its hyperparameters theta, and inducing inputs Z of one layer.

    k(x, x') = variance (r(|x - x'|^2) + sum_d slope_d^2 x_d x'_d), inputs over the lengthscales. The second term, of
    functions that are linear, is there if ``log_slope`` is given.
    """

    kernel: Kernel
    inducing_inputs: Float[Tensor, "*c M D"]
    log_lengthscale: Float[Tensor, "*c D"]
    log_variance: Float[Tensor, "*c"]
    log_slope: Float[Tensor, "*c D"] | None = None

    @property
    def lengthscale(self) -> Tensor:
        return self.log_lengthscale.exp()

    @property
    def variance(self) -> Tensor:
        return self.log_variance.exp()

    @property
    def slope_variance(self) -> Tensor | None:
        """Of the linear part, over ``variance``."""
        return None if self.log_slope is None else (2.0 * self.log_slope).exp()

    def parameters(self) -> dict[str, Tensor]:
        """Every tensor by name: what training moves and states hold; the kernel is a setting."""
        return {name: value for name, value in self._asdict().items() if isinstance(value, Tensor)}


def parameter_shapes(num_inducing: int, input_size: int, *, linear: bool = False) -> dict[str, tuple[int, ...]]:
    """The shape of each of the parameters of a layer with M inducing inputs of D numbers.

    Args:
        linear: its kernel has a linear part.
    """
    shapes = {"inducing_inputs": (num_inducing, input_size), "log_lengthscale": (input_size,), "log_variance": ()}
    return shapes | ({"log_slope": (input_size,)} if linear else {})


def factorise(layer: Layer) -> Float[Tensor, "*c M M"]:
    """L_z, the lower Cholesky factor of K_zz + jitter.

    Raises:
        FactorisationError: see `linalg.cholesky`.
    """
    z = layer.inducing_inputs / layer.lengthscale.unsqueeze(-2)
    unit = layer.kernel.correlation(sqdist(z, z))
    if layer.slope_variance is not None:
        unit = unit + linear_covariance(z, z, layer.slope_variance)
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
    own = _own_variance(layer, x)
    variance = layer.variance.unsqueeze(-1) * (own - projected.square().sum(-2))
    return _matrix(layer.variance.sqrt()) * (projected.mT @ whitened), variance.clamp_min(0.0)


def joint_conditional(
    layer: Layer,
    factor: Float[Tensor, "*c M M"],
    whitened: Float[Tensor, "*p M O"],
    x: Float[Tensor, "*p n D"],
) -> tuple[Float[Tensor, "*p n O"], Float[Tensor, "*p n n"]]:
    """As `conditional`, with the full covariance of the n points: k_xx' - k_xz K_zz^-1 k_zx'."""
    projected = project(layer, factor, x)
    scaled = x / layer.lengthscale.unsqueeze(-2)
    prior = layer.kernel.correlation(pairwise_sqdist(scaled))
    if layer.slope_variance is not None:
        prior = prior + linear_covariance(scaled, scaled, layer.slope_variance)
    covariance = _matrix(layer.variance) * (prior - projected.mT @ projected)
    return _matrix(layer.variance.sqrt()) * (projected.mT @ whitened), covariance


def project(layer: Layer, factor: Float[Tensor, "*c M M"], x: Float[Tensor, "*p n D"]) -> Float[Tensor, "*p M n"]:
    """L_z^-1 k_zx / sigma; without a linear part every column has a length of at most one.

    Args:
        factor: `factorise` of this very layer. Gradients with respect to the layer are complete without any flowing
            through the factor; it may have been computed without gradients.
    """
    lengthscale = layer.lengthscale.unsqueeze(-2)
    unit = (factor / _matrix(layer.variance.sqrt())).detach()
    return projection(layer.kernel, x / lengthscale, layer.inducing_inputs / lengthscale, unit, layer.slope_variance)


def _own_variance(layer: Layer, x: Float[Tensor, "*p n D"]) -> Float[Tensor, "*p n"] | float:
    """k(x, x) over the variance."""
    if layer.slope_variance is None:
        return 1.0
    return 1.0 + ((x / layer.lengthscale.unsqueeze(-2)).square() * layer.slope_variance.unsqueeze(-2)).sum(-1)


def _matrix(scale: Float[Tensor, "*c"]) -> Float[Tensor, "*c 1 1"]:
    """In the shape that multiplies a matrix of each chain."""
    return scale[..., None, None]
