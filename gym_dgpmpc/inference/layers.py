"""One layer of C chains: what its points are to it, their moments, and the gradients of these, in closed form.

`gradients.py` composes layers. Compiled code does the same (`compiled_layers.py`) where there is any; what stands here
in PyTorch is for GPUs, for kernels of your own, and for machines without a compiler.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import Kernel, sqdist
from gym_dgpmpc.gp.layer import Layer
from gym_dgpmpc.gp.linalg import cholesky
from gym_dgpmpc.gp.projection import linear_covariance
from gym_dgpmpc.inference import compiled_layers
from gym_dgpmpc.inference.compiled_layers import CompiledLayer


class LayerTerms(NamedTuple):
    """What all evaluations under the same hyperparameters share of a layer."""

    kernel: Kernel
    lengthscale: Float[Tensor, "C 1 D"]
    variance: Float[Tensor, "C 1 1"]
    centres: Float[Tensor, "C M D"]
    """Inducing inputs over the lengthscales."""
    factor: Float[Tensor, "C M M"]
    """L of the correlations, L L^T = r(Z, Z) + jitter."""
    inverse: Float[Tensor, "C M M"]
    """L^-1."""
    own_slope: Float[Tensor, "C M M"]
    """dk/d(r^2) between the inducing inputs."""
    linear: Float[Tensor, "C D"] | None
    """Variances of the slopes of the kernel's linear part."""
    compiled: CompiledLayer | None
    """What takes the place of PyTorch."""


class Seen(NamedTuple):
    """n points of each chain, seen by a layer."""

    scaled: Float[Tensor, "C n D"]
    projected: Float[Tensor, "C M n"]
    """A = L^-1 r(Z, x)."""
    slope: Float[Tensor, "C n M"]


class Passed(NamedTuple):
    """n points of each chain, passed through a layer."""

    seen: Seen
    mean: Float[Tensor, "C n O"]
    variance: Float[Tensor, "C n"]


class LayerGradients(NamedTuple):
    """Of what a layer was given."""

    whitened: Float[Tensor, "C M O"]
    points: Float[Tensor, "C n D"] | None
    parameters: list[Tensor] | None
    """In the order of `gp.layer.Layer.parameters`."""


def layer_terms(layer: Layer, *, compile: bool = True) -> LayerTerms:
    """The terms of a layer.

    Raises:
        FactorisationError: see `linalg.cholesky`.
    """
    lengthscale, variance, linear = layer.lengthscale, layer.variance, layer.slope_variance
    centres = layer.inducing_inputs / lengthscale.unsqueeze(-2)
    compiled = None
    if compile and compiled_layers.can_take(layer.kernel, centres):
        compiled = CompiledLayer(layer.kernel, lengthscale, variance, centres, linear)
        correlations, own_slope = compiled.own_correlations()
        factor = cholesky(correlations, factorise=compiled_layers.factorise)
        inverse = compiled.invert(factor)
    else:
        correlations, own_slope = layer.kernel.correlation_and_slope(sqdist(centres, centres))
        if linear is not None:
            correlations = correlations + linear_covariance(centres, centres, linear)
        factor = cholesky(correlations)
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    return LayerTerms(
        layer.kernel, lengthscale.unsqueeze(-2), variance[:, None, None], centres, factor, inverse, own_slope, linear,
        compiled,
    )  # fmt: skip


def see(terms: LayerTerms, x: Float[Tensor, "C n D"]) -> Seen:
    """What a layer needs of its inputs."""
    if terms.compiled is not None:
        return Seen(*terms.compiled.see(x))
    scaled = x / terms.lengthscale
    value, slope = terms.kernel.correlation_and_slope(sqdist(scaled, terms.centres))
    if terms.linear is not None:
        value = value + linear_covariance(scaled, terms.centres, terms.linear)
    return Seen(scaled, terms.inverse @ value.mT, slope)


def moments(terms: LayerTerms, whitened: Float[Tensor, "C M O"], seen: Seen, least: float) -> Passed:
    """Conditional mean and variance, the latter not below ``least``."""
    if terms.compiled is not None:
        return Passed(seen, *terms.compiled.moments(whitened, seen.scaled, seen.projected, least))
    mean = terms.variance.sqrt() * (seen.projected.mT @ whitened)
    own = 1.0 if terms.linear is None else 1.0 + (seen.scaled.square() * terms.linear.unsqueeze(-2)).sum(-1)
    variance = terms.variance.squeeze(-1) * (own - seen.projected.square().sum(-2))
    return Passed(seen, mean, variance.clamp_min(least))


def choose(terms: LayerTerms, first_one: Bool[Tensor, "C n"], one: Passed, other: Passed) -> Passed:
    """Each point as it passed a layer one way or the other; what the other way was may be overwritten."""
    by_row, by_column = first_one.unsqueeze(-1), first_one.unsqueeze(1)
    if terms.compiled is not None:
        projected = terms.compiled.put(first_one, one.seen.projected.mT, other.seen.projected.mT).mT
        slope = terms.compiled.put(first_one, one.seen.slope, other.seen.slope)
    else:
        projected = torch.where(by_column, one.seen.projected, other.seen.projected)
        slope = torch.where(by_row, one.seen.slope, other.seen.slope)
    seen = Seen(torch.where(by_row, one.seen.scaled, other.seen.scaled), projected, slope)
    variance = torch.where(first_one, one.variance, other.variance)
    return Passed(seen, torch.where(by_row, one.mean, other.mean), variance)


def layer_gradients(
    terms: LayerTerms,
    whitened: Float[Tensor, "C M O"],
    passed: Passed,
    mean_bar: Float[Tensor, "C n O"],
    variance_bar: Float[Tensor, "C n"],
    *,
    of_points: bool = True,
    of_parameters: bool = True,
) -> LayerGradients:
    """Gradients from those of a layer's moments; of the points, and of the parameters, only if they are wanted."""
    seen, mean, variance = passed
    if terms.compiled is not None:
        return LayerGradients(
            *terms.compiled.back(
                whitened, seen, (mean, variance), (mean_bar, variance_bar),
                of_points=of_points, of_parameters=of_parameters,
            )
        )  # fmt: skip
    scale = terms.variance.sqrt()
    whitened_bar = scale * (seen.projected @ mean_bar)
    if not of_points and not of_parameters:
        return LayerGradients(whitened_bar, None, None)
    projected_bar = scale * (whitened @ mean_bar.mT)
    projected_bar -= 2.0 * terms.variance * seen.projected * variance_bar.unsqueeze(-2)
    value_bar = (terms.inverse.mT @ projected_bar).mT
    by_distance = value_bar * seen.slope
    # d |x_i - z_j|^2 / d x_i = 2 (x_i - z_j), summed over the j.
    scaled_bar = 2.0 * (by_distance.sum(-1, keepdim=True) * seen.scaled - by_distance @ terms.centres)
    by_own_variance = (terms.variance.squeeze(-1) * variance_bar).unsqueeze(-1)
    if terms.linear is not None:
        along = value_bar @ terms.centres + 2.0 * by_own_variance * seen.scaled
        scaled_bar += along * terms.linear.unsqueeze(-2)
    points_bar = scaled_bar / terms.lengthscale if of_points else None
    if not of_parameters:
        return LayerGradients(whitened_bar, points_bar, None)
    centres_bar, linear_bar = _centres_gradient(terms, seen, by_distance, value_bar, projected_bar)
    log_lengthscale_bar = -((centres_bar * terms.centres).sum(-2) + (scaled_bar * seen.scaled).sum(-2))
    log_variance_bar = 0.5 * (mean_bar * mean).sum((-2, -1)) + (variance_bar * variance).sum(-1)
    parameters_bar = [centres_bar / terms.lengthscale, log_lengthscale_bar, log_variance_bar]
    if terms.linear is not None and linear_bar is not None:
        linear_bar += (by_own_variance * seen.scaled.square()).sum(-2)
        parameters_bar.append(2.0 * terms.linear * linear_bar)
    return LayerGradients(whitened_bar, points_bar, parameters_bar)


def _centres_gradient(
    terms: LayerTerms,
    seen: Seen,
    by_distance: Float[Tensor, "C n M"],
    value_bar: Float[Tensor, "C n M"],
    projected_bar: Float[Tensor, "C M n"],
) -> tuple[Float[Tensor, "C M D"], Float[Tensor, "C D"] | None]:
    """Of the scaled inducing inputs and the slopes' variances: as `gp.projection` has it, which says where from."""
    centres = terms.centres
    points = by_distance.sum(-2).unsqueeze(-1) * centres - by_distance.mT @ seen.scaled
    lower = (projected_bar @ seen.projected.mT).tril()
    lower.diagonal(dim1=-2, dim2=-1).mul_(0.5)
    covariance_bar = -(terms.inverse.mT @ lower @ terms.inverse)
    symmetric = 0.5 * (covariance_bar + covariance_bar.mT)
    by_own_distance = symmetric * terms.own_slope
    own = by_own_distance.sum(-1, keepdim=True) * centres - by_own_distance @ centres
    centres_bar = 2.0 * points + 4.0 * own
    if terms.linear is None:
        return centres_bar, None
    seen_from, seen_own = value_bar.mT @ seen.scaled, symmetric @ centres
    centres_bar += (seen_from + 2.0 * seen_own) * terms.linear.unsqueeze(-2)
    return centres_bar, (centres * (seen_from + seen_own)).sum(-2)


def gram(terms: LayerTerms, seen: Seen, weights: Float[Tensor, "C T n"]) -> Float[Tensor, "C T M M"]:
    """A diag(w) A^T for each row of weights."""
    if terms.compiled is not None:
        return terms.compiled.gram(seen.projected, weights)
    return (seen.projected.unsqueeze(1) * weights.unsqueeze(2)) @ seen.projected.mT.unsqueeze(1)
