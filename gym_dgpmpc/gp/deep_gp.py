"""A deep Gaussian process: layers composed, with homoscedastic noise on the last.

f = f_L o ... o f_1 with sparse whitened layers (`layer.py`). Inner layers map the input space to itself with an
identity mean; the last maps to the targets with mean zero (Salimbeni and Deisenroth 2017). `inference/` samples the
inducing outputs and the hyperparameters of what is defined here; `dynamics/` makes a transition model of it. As in
`layer.py`, a leading axis "C" stands for the models of C chains.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.gp.layer import Layer, conditional, factorise

NOISE_FLOOR = 1e-6
"""Lower bound of the noise variance, in standardised targets; single-precision data cannot resolve less."""


class DeepGP(NamedTuple):
    """A deep Gaussian process with L layers, T targets and inputs of size D, by its hyperparameters {theta, Z, beta}.

    Every layer has a kernel of its own, as a rule the same one.
    """

    layers: tuple[Layer, ...]
    log_noise: Float[Tensor, "*c T"]

    @property
    def noise_variance(self) -> Float[Tensor, "*c T"]:
        return NOISE_FLOOR + self.log_noise.exp()

    def output_sizes(self) -> list[int]:
        """Outputs of each layer: D for the inner ones, T for the last."""
        inner = [layer.inducing_inputs.shape[-1] for layer in self.layers[:-1]]
        return [*inner, self.log_noise.shape[-1]]

    def whitened_shapes(self) -> list[tuple[int, int]]:
        """(M_l, O_l) of each layer's whitened inducing outputs."""
        return [
            (layer.inducing_inputs.shape[-2], size)
            for layer, size in zip(self.layers, self.output_sizes(), strict=True)
        ]

    def split(self, whitened: Float[Tensor, "*p V"]) -> list[Tensor]:
        """The layers' whitened inducing outputs v_l "*p M_l O_l" as views of one flat vector, as inference keeps it."""
        shapes = self.whitened_shapes()
        by_layer = whitened.split([m * o for m, o in shapes], dim=-1)
        return [flat.unflatten(-1, shape) for flat, shape in zip(by_layer, shapes, strict=True)]

    def num_whitened(self) -> int:
        """V, the length of the flat vector of all whitened inducing outputs."""
        return sum(m * o for m, o in self.whitened_shapes())

    def num_inner(self) -> int:
        """How many of them belong to the inner layers, which come first."""
        return sum(m * o for m, o in self.whitened_shapes()[:-1])

    def parameters(self) -> list[Tensor]:
        """The tensors that the hyperparameter optimiser moves."""
        return [tensor for layer in self.layers for tensor in layer.parameters().values()] + [self.log_noise]

    def with_parameters(self, parameters: Sequence[Tensor]) -> "DeepGP":
        """The same kernels with other tensors, given in the order of `parameters`."""
        each = iter(parameters)
        layers = [Layer(layer.kernel, *(next(each) for _ in layer.parameters())) for layer in self.layers]
        return DeepGP(tuple(layers), next(each))

    def at(self, chain: Int[Tensor, "n"]) -> "DeepGP":
        """The models of these chains, the same one more than once if need be."""
        return self.with_parameters([tensor[chain] for tensor in self.parameters()])


class Factorised(NamedTuple):
    """A model and L_z of its layers, computed once for all that is done with these hyperparameters.

    Gradients with respect to the hyperparameters need none through the factors; see `layer.project`.
    """

    model: DeepGP
    factors: list[Float[Tensor, "*c M M"]]


def factorise_all(model: DeepGP) -> Factorised:
    """The model with L_z of every layer.

    Raises:
        FactorisationError: see `linalg.cholesky`.
    """
    return Factorised(model, [factorise(layer) for layer in model.layers])


def propagate(
    factorised: Factorised,
    whitened: list[Tensor],
    x: Float[Tensor, "*p n D"],
    generator: torch.Generator,
) -> tuple[Float[Tensor, "*p n T"], Float[Tensor, "*p n"]]:
    """Mean and variance of the last layer, given one sample through each inner layer (its marginals)."""
    x = propagate_inner(factorised, whitened, x, generator)
    return conditional(factorised.model.layers[-1], factorised.factors[-1], whitened[-1], x)


def propagate_inner(
    factorised: Factorised,
    whitened: list[Tensor],
    x: Float[Tensor, "*p n D"],
    generator: torch.Generator,
) -> Float[Tensor, "*p n D"]:
    """What the last layer is fed: one sample through each inner layer (its marginals); ``x`` itself if L = 1."""
    model, factors = factorised
    for layer, factor, v in zip(model.layers[:-1], factors[:-1], whitened[:-1], strict=True):
        mean, variance = conditional(layer, factor, v, x)
        noise = torch.randn(mean.shape, generator=generator, dtype=x.dtype, device=x.device)
        # The floor keeps the square root's gradient finite where the variance vanishes.
        x = x + mean + variance.clamp_min(1e-12).sqrt().unsqueeze(-1) * noise
    return x


def propagate_means(
    factorised: Factorised, whitened: list[Tensor], x: Float[Tensor, "*p n D"]
) -> Float[Tensor, "*p n T"]:
    """The last layer's mean where every inner layer has its own: what is drawn, but for the inner layers' variance."""
    model, factors = factorised
    last = len(factors) - 1
    for index, (layer, factor, v) in enumerate(zip(model.layers, factors, whitened, strict=True)):
        mean, _ = conditional(layer, factor, v, x)
        x = mean if index == last else x + mean
    return x


def posterior_mean(factorised: Factorised, samples: Float[Tensor, "n C V"]) -> Callable[[Tensor], Tensor]:
    """From inputs "n D" to the mean of their targets "n T" over two samples of each chain: ample for residuals."""
    some = samples[:: -(-len(samples) // 2)]
    whitened = factorised.model.split(some)
    return lambda x: propagate_means(factorised, whitened, x.expand(*some.shape[:2], -1, -1)).mean((0, 1))


def log_likelihood(
    model: DeepGP,
    mean: Float[Tensor, "*p n T"],
    variance: Float[Tensor, "*p n"],
    target: Float[Tensor, "n T"],
) -> Float[Tensor, "*p n"]:
    """log N(y | mean, variance + noise), summed over the independent targets: the last layer integrated out."""
    total = variance.unsqueeze(-1) + model.noise_variance.unsqueeze(-2)
    return -0.5 * ((target - mean).square() / total + total.log() + math.log(2 * math.pi)).sum(-1)
