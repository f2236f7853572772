"""The log likelihood of a deep Gaussian process and its gradients in closed form, for C chains at once.

What `sampler.py` calls at every step. Automatic differentiation of `gp.deep_gp.propagate` gives the same numbers (a
test compares them) at several times the cost: here one factorisation, and its inverse, serve every evaluation until the
hyperparameters move again, and a gradient that is not wanted costs nothing. `layers.py` has what a layer does.

The model, layer by layer, of a datum x with the latents e_l ~ N(0, I) of its inner layers:

    h_0 = x,  h_l = h_{l-1} + m_l(h_{l-1}) + s_l(h_{l-1}) e_l,  y ~ N(m_L(h_{L-1}), s_L(h_{L-1})^2 + noise)

with m_l, s_l^2 the conditional moments given the layer's inducing outputs (`gp.layer.conditional`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.deep_gp import DeepGP, Factorised, log_likelihood
from gym_dgpmpc.gp.linalg import Factorise, by_lapack
from gym_dgpmpc.inference import compiled_layers
from gym_dgpmpc.inference.layers import LayerTerms, Passed, Seen, layer_gradients, layer_terms, moments, see

LEAST_VARIANCE = 1e-12
"""Of an inner layer, so that the square root's gradient stays finite where the variance vanishes."""


class Prepared(NamedTuple):
    """A model of C chains, with what all evaluations under its hyperparameters share."""

    model: DeepGP
    layers: list[LayerTerms]

    @property
    def factorise(self) -> Factorise:
        """How matrices of such models are factorised."""
        return by_lapack if self.layers[0].compiled is None else compiled_layers.factorise

    @property
    def factorised(self) -> Factorised:
        """The model as the rest of the package takes it."""
        return Factorised(self.model, [layer.variance.sqrt() * layer.factor for layer in self.layers])


class Gradients(NamedTuple):
    """Of the mean log likelihood of a batch."""

    whitened: Float[Tensor, "C V"]
    parameters: list[Tensor] | None
    """In the order of `DeepGP.parameters`; None where they were not wanted."""


def prepare(model: DeepGP, *, compile: bool = True) -> Prepared:
    """Factorise the layers.

    Args:
        compile: evaluate in compiled code, where there is any for this machine and these kernels.

    Raises:
        FactorisationError: see `linalg.cholesky`.
    """
    return Prepared(model, [layer_terms(layer, compile=compile) for layer in model.layers])


def pass_first(prepared: Prepared, whitened: Float[Tensor, "C M O"], seen: Seen) -> Passed:
    """The points through the first of the layers, which may be the last."""
    return moments(prepared.layers[0], whitened, seen, 0.0 if len(prepared.layers) == 1 else LEAST_VARIANCE)


def forward(
    prepared: Prepared,
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
    layers = prepared.layers
    passed = [first or pass_first(prepared, whitened[0], see(layers[0], x))]
    for index, (layer, v) in enumerate(zip(layers[1:], whitened[1:], strict=True), 1):
        x = torch.addcmul(x + passed[-1].mean, passed[-1].variance.sqrt().unsqueeze(-1), latents[index - 1])
        passed.append(moments(layer, v, see(layer, x), 0.0 if index == len(layers) - 1 else LEAST_VARIANCE))
    return passed


def likelihood(prepared: Prepared, passed: Sequence[Passed], y: Float[Tensor, "n T"]) -> Float[Tensor, "C n"]:
    """log p(y | inducing outputs, latents) of each point: the last layer integrated out, given its inputs."""
    return log_likelihood(prepared.model, passed[-1].mean, passed[-1].variance, y)


def gradients(
    prepared: Prepared,
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
    num_points, model = len(y), prepared.model
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
    for index in reversed(range(len(passed))):
        layer, wanted = prepared.layers[index], {"of_points": index > 0, "of_parameters": of_parameters}
        found = layer_gradients(layer, whitened[index], passed[index], mean_bar, variance_bar, **wanted)
        whitened_bar.append(found.whitened)
        parameters_bar = [*(found.parameters or ()), *parameters_bar]
        if found.points is not None:
            # Onto what the layer below gave: through this layer, and past it, whose mean function is the identity.
            through = mean_bar = found.points if through is None else found.points + through
            below = passed[index - 1].variance
            variance_bar = 0.5 * (mean_bar * latents[index - 1]).sum(-1) / below.sqrt()
    flat = torch.cat([bar.flatten(-2) for bar in reversed(whitened_bar)], dim=-1)
    return Gradients(flat, parameters_bar if of_parameters else None)
