"""The log likelihood of a deep Gaussian process and its gradients in closed form, for C chains at once.

What `sampler.py` calls at every step. Automatic differentiation of `gp.deep_gp.propagate` gives the same numbers (a
test compares them) at several times the cost: here one factorisation, and its inverse, serve every evaluation until the
hyperparameters move again, and a gradient that is not wanted costs nothing.

The model, layer by layer, of a datum x with the latents e_l ~ N(0, I) of its inner layers:

    h_0 = x,  h_l = h_{l-1} + m_l(h_{l-1}) + s_l(h_{l-1}) e_l,  y ~ N(m_L(h_{L-1}), s_L(h_{L-1})^2 + noise)

with m_l, s_l^2 the conditional moments given the layer's inducing outputs (`gp.layer.conditional`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gym_dgpmpc.gp.deep_gp import Factorised, log_likelihood
from gym_dgpmpc.gp.kernels import Kernel, sqdist

LEAST_VARIANCE = 1e-12
"""Of an inner layer, so that the square root's gradient stays finite where the variance vanishes."""


class LayerTerms(NamedTuple):
    """What all evaluations under the same hyperparameters share of a layer."""

    kernel: Kernel
    lengthscale: Float[Tensor, "C 1 D"]
    variance: Float[Tensor, "C 1 1"]
    centres: Float[Tensor, "C M D"]
    """Inducing inputs over the lengthscales."""
    inverse: Float[Tensor, "C M M"]
    """L^-1 of the correlations, L L^T = r(Z, Z) + jitter."""
    own_slope: Float[Tensor, "C M M"]
    """dk/d(r^2) between the inducing inputs."""


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

    def since(self, first: int) -> "Passed":
        """The points from ``first`` on."""
        scaled, projected, slope = self.seen
        seen = Seen(scaled[:, first:], projected[..., first:], slope[:, first:])
        return Passed(seen, self.mean[:, first:], self.variance[:, first:])


class Gradients(NamedTuple):
    """Of the mean log likelihood of a batch."""

    whitened: Float[Tensor, "C V"]
    parameters: list[Tensor] | None
    """In the order of `DeepGP.parameters`; None where they were not wanted."""


def layer_terms(factorised: Factorised) -> list[LayerTerms]:
    """The terms of every layer."""
    terms = []
    for layer, factor in zip(factorised.model.layers, factorised.factors, strict=True):
        variance = layer.variance[:, None, None]
        lengthscale = layer.lengthscale.unsqueeze(-2)
        centres = layer.inducing_inputs / lengthscale
        _, own_slope = layer.kernel.correlation_and_slope(sqdist(centres, centres))
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        unit = factor / variance.sqrt()
        inverse = torch.linalg.solve_triangular(unit, eye.expand_as(unit), upper=False)
        terms.append(LayerTerms(layer.kernel, lengthscale, variance, centres, inverse, own_slope))
    return terms


def see(terms: LayerTerms, x: Float[Tensor, "C n D"]) -> Seen:
    """What a layer needs of its inputs."""
    scaled = x / terms.lengthscale
    value, slope = terms.kernel.correlation_and_slope(sqdist(scaled, terms.centres))
    return Seen(scaled, terms.inverse @ value.mT, slope)


def moments(terms: LayerTerms, whitened: Float[Tensor, "C M O"], seen: Seen, least: float) -> Passed:
    """Conditional mean and variance, the latter not below ``least``."""
    mean = terms.variance.sqrt() * (seen.projected.mT @ whitened)
    variance = terms.variance.squeeze(-1) * (1.0 - seen.projected.square().sum(-2))
    return Passed(seen, mean, variance.clamp_min(least))


def pass_first(terms: Sequence[LayerTerms], whitened: Float[Tensor, "C M O"], seen: Seen) -> Passed:
    """The points through the first of these layers, which may be the last."""
    return moments(terms[0], whitened, seen, 0.0 if len(terms) == 1 else LEAST_VARIANCE)


def forward(
    terms: Sequence[LayerTerms],
    whitened: Sequence[Tensor],
    x: Float[Tensor, "C n D"],
    latents: Sequence[Float[Tensor, "C n D"]],
    first: Passed | None = None,
) -> list[Passed]:
    """The points through all layers.

    Args:
        latents: e_l of each inner layer.
        first: how ``x`` passes the first layer, if that is known already.
    """
    passed = [first or pass_first(terms, whitened[0], see(terms[0], x))]
    for index, (layer, v) in enumerate(zip(terms[1:], whitened[1:], strict=True), 1):
        x = x + passed[-1].mean + passed[-1].variance.sqrt().unsqueeze(-1) * latents[index - 1]
        passed.append(moments(layer, v, see(layer, x), 0.0 if index == len(terms) - 1 else LEAST_VARIANCE))
    return passed


def likelihood(factorised: Factorised, passed: Sequence[Passed], y: Float[Tensor, "n T"]) -> Float[Tensor, "C n"]:
    """log p(y | inducing outputs, latents) of each point: the last layer integrated out, given its inputs."""
    return log_likelihood(factorised.model, passed[-1].mean, passed[-1].variance, y)


def choose(first_one: Bool[Tensor, "C n"], one: Passed, other: Passed) -> Passed:
    """Each point as it passed a layer one way or the other."""
    by_row, by_column = first_one.unsqueeze(-1), first_one.unsqueeze(1)
    seen = Seen(
        torch.where(by_row, one.seen.scaled, other.seen.scaled),
        torch.where(by_column, one.seen.projected, other.seen.projected),
        torch.where(by_row, one.seen.slope, other.seen.slope),
    )
    variance = torch.where(first_one, one.variance, other.variance)
    return Passed(seen, torch.where(by_row, one.mean, other.mean), variance)


def gradients(
    factorised: Factorised,
    terms: Sequence[LayerTerms],
    whitened: Sequence[Tensor],
    passed: Sequence[Passed],
    latents: Sequence[Float[Tensor, "C n D"]],
    y: Float[Tensor, "n T"],
    *,
    of_parameters: bool,
) -> Gradients:
    """Gradients of the mean of `likelihood` over the points, by reverse accumulation through the layers.

    Args:
        passed: what `forward` gave.
        latents: that it was given.
        of_parameters: whether those of the hyperparameters and inducing inputs are wanted too.
    """
    num_points, model = len(y), factorised.model
    noise = model.noise_variance.unsqueeze(-2)
    total = passed[-1].variance.unsqueeze(-1) + noise
    residual = (y - passed[-1].mean) / total
    mean_bar = residual / num_points
    by_variance = 0.5 * (residual.square() - 1.0 / total) / num_points
    variance_bar = by_variance.sum(-1)
    # d noise / d log noise; the floor does not move.
    noise_bar = by_variance.sum(-2) * model.log_noise.exp()
    whitened_bar: list[Tensor] = []
    parameters_bar: list[Tensor] = [noise_bar]
    through = None  # the gradient of the layer's output that comes from the layers above it, past their means
    for index in reversed(range(len(terms))):
        layer, v, (seen, mean, variance) = terms[index], whitened[index], passed[index]
        scale = layer.variance.sqrt()
        whitened_bar.append(scale * (seen.projected @ mean_bar))
        if index == 0 and not of_parameters:
            break
        projected_bar = scale * (v @ mean_bar.mT) - 2.0 * layer.variance * seen.projected * variance_bar.unsqueeze(-2)
        by_distance = (layer.inverse.mT @ projected_bar).mT * seen.slope
        # d |x_i - z_j|^2 / d x_i = 2 (x_i - z_j), summed over the j.
        scaled_bar = 2.0 * (by_distance.sum(-1, keepdim=True) * seen.scaled - by_distance @ layer.centres)
        if of_parameters:
            centres_bar = _centres_gradient(layer, seen, by_distance, projected_bar)
            log_lengthscale_bar = -((centres_bar * layer.centres).sum(-2) + (scaled_bar * seen.scaled).sum(-2))
            log_variance_bar = 0.5 * (mean_bar * mean).sum((-2, -1)) + (variance_bar * variance).sum(-1)
            parameters_bar = [centres_bar / layer.lengthscale, log_lengthscale_bar, log_variance_bar, *parameters_bar]
        if index:
            # Onto what the layer below gave: through this layer, and past it, whose mean function is the identity.
            mean_bar = scaled_bar / layer.lengthscale
            through = mean_bar = mean_bar if through is None else mean_bar + through
            below = passed[index - 1].variance
            variance_bar = 0.5 * (mean_bar * latents[index - 1]).sum(-1) / below.sqrt()
    flat = torch.cat([bar.flatten(-2) for bar in reversed(whitened_bar)], dim=-1)
    return Gradients(flat, parameters_bar if of_parameters else None)


def _centres_gradient(
    layer: LayerTerms, seen: Seen, by_distance: Float[Tensor, "C n M"], projected_bar: Float[Tensor, "C M n"]
) -> Float[Tensor, "C M D"]:
    """Of the scaled inducing inputs: as `gp.projection` has it, which says where it comes from."""
    centres = layer.centres
    points = by_distance.sum(-2).unsqueeze(-1) * centres - by_distance.mT @ seen.scaled
    lower = (projected_bar @ seen.projected.mT).tril()
    lower.diagonal(dim1=-2, dim2=-1).mul_(0.5)
    covariance_bar = -(layer.inverse.mT @ lower @ layer.inverse)
    by_own_distance = 0.5 * (covariance_bar + covariance_bar.mT) * layer.own_slope
    own = by_own_distance.sum(-1, keepdim=True) * centres - by_own_distance @ centres
    return 2.0 * points + 4.0 * own
