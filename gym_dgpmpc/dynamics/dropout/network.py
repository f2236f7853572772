"""A network whose hidden units are left out at random, as a pure function of its parameters and of what is kept.

Gal and Ghahramani (2016), "Dropout as a Bayesian Approximation: Representing Model Uncertainty in Deep Learning": with
masks z of zeros and ones, each one with probability q, the network

    f(x) = b_L + W_L^T (z_{L-1} s(b_{L-1} + ... W_2^T (z_1 s(b_1 + W_1^T x)))),

s being the sigmoid, is a draw from a distribution over functions that approximates the posterior of a network with the
prior N(0, 1/l^2) on its weights. `model.py` trains it and draws from it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.dynamics.networks import Parameters, initial_weight, layers_of, named_layers

LEAST_LOG_NOISE = -14.0
"""Of the noise's variance, in units of the targets' own: what does not vary at all would send it to minus infinity."""

Kept = Sequence[Float[Tensor, "*#b U"]]
"""What the units of each hidden layer are multiplied by: zeros and ones, or the chance of a one for their mean."""


class DropoutNetwork(NamedTuple):
    """Parameters: fully connected layers, and the log variance of each target's noise."""

    weights: tuple[Float[Tensor, "I O"], ...]
    biases: tuple[Float[Tensor, " O"], ...]
    log_noise: Float[Tensor, " T"]

    def parameters(self) -> Parameters:
        """Every tensor by name."""
        return named_layers(self.weights, self.biases) | {"log_noise": self.log_noise}

    @classmethod
    def from_parameters(cls, named: Parameters) -> "DropoutNetwork":
        """The inverse of `parameters`."""
        return cls(*layers_of(named), named["log_noise"])

    @property
    def noise_variance(self) -> Float[Tensor, " T"]:
        """Of the standardised targets."""
        return self.log_noise.clamp_min(LEAST_LOG_NOISE).exp()


def initial_network(
    sizes: Sequence[tuple[int, int]], log_noise: float, generator: torch.Generator, device: torch.device
) -> DropoutNetwork:
    """Weights by `initial_weight`, biases zero."""
    weights = tuple(initial_weight(inputs, outputs, generator, device) for inputs, outputs in sizes)
    biases = tuple(torch.zeros_like(weight[0]) for weight in weights)
    return DropoutNetwork(weights, biases, torch.full_like(biases[-1], log_noise))


def draw_kept(
    network: DropoutNetwork, rate: float, generator: torch.Generator, *shape: int
) -> tuple[Float[Tensor, "*b U"], ...]:
    """Masks of the given shape for every hidden layer: each unit is left out with the chance ``rate``."""
    return tuple(
        (torch.rand(*shape, len(bias), generator=generator, dtype=bias.dtype, device=bias.device) >= rate).to(bias)
        for bias in network.biases[:-1]
    )


def mean_kept(network: DropoutNetwork, rate: float) -> tuple[Float[Tensor, " U"], ...]:
    """The masks' mean: with one hidden layer that of the functions, and near it with more."""
    return tuple(torch.full_like(bias, 1.0 - rate) for bias in network.biases[:-1])


def predict(network: DropoutNetwork, kept: Kept, x: Float[Tensor, "*b D"]) -> Float[Tensor, "*b T"]:
    """The function of these masks at standardised inputs."""
    *inner, (weight, bias) = zip(network.weights, network.biases, strict=True)
    for (hidden_weight, hidden_bias), mask in zip(inner, kept, strict=True):
        x = torch.sigmoid(x @ hidden_weight + hidden_bias) * mask
    return x @ weight + bias


def misfit(network: DropoutNetwork, kept: Kept, x: Float[Tensor, "n D"], y: Float[Tensor, "n T"]) -> Float[Tensor, ""]:
    """Mean negative log likelihood of a row, up to a constant: sum_t [(y - f(x))^2 / (2 s_t^2) + log(s_t^2) / 2]."""
    variance = network.noise_variance
    by_target = (y - predict(network, kept, x)).square() / variance + variance.log()
    return 0.5 * by_target.sum(-1).mean()


def decays(num_layers: int, rate: float, lengthscale: float, num_rows: int) -> Mapping[str, Mapping[str, Any]]:
    """Adam's decay of each parameter: l^2 / N for biases, q l^2 / N for weights of whose inputs the share q is kept.

    Decay / 2 |W|^2 is then the divergence from the prior, up to a constant, over the N rows that `misfit` is a mean
    over (their eq. 6 and appendix 4.2, with 1/tau the noise's variance).
    """
    share = lengthscale**2 / num_rows
    found = {}
    for i in range(num_layers):
        kept = 1.0 if i == 0 else 1.0 - rate
        found[f"layers.{i}.weight"] = {"weight_decay": kept * share}
        found[f"layers.{i}.bias"] = {"weight_decay": share}
    return found
