"""An ensemble of probabilistic networks as pure functions of its parameters, all members in one batched product.

Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models", with the
initial values, bounds and losses of their published code. `model.py` trains it and draws from it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from gym_dgpmpc.dynamics.networks import Parameters, initial_weight, layers_of, named_layers

MAX_LOGVAR, MIN_LOGVAR = 0.5, -10.0
"""Where the learned bounds of the predicted log variance start."""

BOUND_PENALTY = 0.01

ROWS_AT_ONCE = 320
"""Points per member that go through the layers together on a CPU, so that a layer's values stay in the cache."""


class Ensemble(NamedTuple):
    """Parameters of B networks: fully connected, swish between the layers, a mean and a log variance per target."""

    weights: tuple[Float[Tensor, "B I O"], ...]
    biases: tuple[Float[Tensor, "B 1 O"], ...]
    max_logvar: Float[Tensor, "T"]
    min_logvar: Float[Tensor, "T"]

    def parameters(self) -> Parameters:
        """Every tensor by name."""
        bounds = {"max_logvar": self.max_logvar, "min_logvar": self.min_logvar}
        return named_layers(self.weights, self.biases) | bounds

    @classmethod
    def from_parameters(cls, named: Parameters) -> "Ensemble":
        """The inverse of `parameters`."""
        return cls(*layers_of(named), named["max_logvar"], named["min_logvar"])

    def at(self, members: Int[Tensor, "C"]) -> "Ensemble":
        """Copies of these members, each as often as it is named."""
        weights, biases = (tuple(value[members] for value in values) for values in (self.weights, self.biases))
        return self._replace(weights=weights, biases=biases)


def initial_ensemble(
    num_members: int, sizes: Sequence[tuple[int, int]], generator: torch.Generator, device: torch.device
) -> Ensemble:
    """Weights by `initial_weight`; biases zero; the last layer gives T means and T log variances."""
    weights = [initial_weight(inputs, outputs, generator, device, num_members) for inputs, outputs in sizes]
    biases = [torch.zeros(num_members, 1, outputs, dtype=torch.float32, device=device) for _, outputs in sizes]
    num_targets = sizes[-1][1] // 2
    bounds = (
        torch.full((num_targets,), bound, dtype=torch.float32, device=device) for bound in (MAX_LOGVAR, MIN_LOGVAR)
    )
    return Ensemble(tuple(weights), tuple(biases), *bounds)


def half_precision(ensemble: Ensemble) -> Ensemble:
    """The layers between the first and the last, which cost nearly all the time, in bfloat16."""
    weights, biases = (
        (values[0], *(value.bfloat16() for value in values[1:-1]), values[-1])
        for values in (ensemble.weights, ensemble.biases)
    )
    return ensemble._replace(weights=weights, biases=biases)


class Prediction(NamedTuple):
    """Every member's Gaussian over the targets at its own points."""

    mean: Float[Tensor, "B n T"]
    logvar: Float[Tensor, "B n T"]


def predict(ensemble: Ensemble, x: Float[Tensor, "B n D"]) -> Prediction:
    """Mean and log variance, the latter kept softly between the bounds: v <- max - softplus(max - v), then likewise.

    Args:
        x: standardised inputs, separate ones for each member. Each layer computes in the precision of its weights.
    """
    if not torch.is_grad_enabled() and x.device.type == "cpu" and x.shape[1] > ROWS_AT_ONCE:
        predictions = [predict(ensemble, rows) for rows in x.split(ROWS_AT_ONCE, dim=1)]
        return Prediction(*(torch.cat(values, dim=1) for values in zip(*predictions, strict=True)))
    *inner, last = zip(ensemble.weights, ensemble.biases, strict=True)
    # Where no gradient is recorded the activation overwrites its argument: memory traffic is what is left to save.
    in_place = not torch.is_grad_enabled()
    for weight, bias in inner:
        x = F.silu(torch.baddbmm(bias, x.to(weight.dtype), weight), inplace=in_place)
    mean, logvar = torch.baddbmm(last[1], x.to(last[0].dtype), last[0]).chunk(2, dim=-1)
    logvar = ensemble.max_logvar - F.softplus(ensemble.max_logvar - logvar)
    return Prediction(mean, ensemble.min_logvar + F.softplus(logvar - ensemble.min_logvar))


def loss(ensemble: Ensemble, x: Float[Tensor, "B n D"], y: Float[Tensor, "B n T"]) -> Float[Tensor, ""]:
    """What training minimises, besides the decay of the weights,

        sum_b mean_{n, t} [(y - mean)^2 exp(-logvar) + logvar] + 0.01 (sum_t max_logvar - sum_t min_logvar),

    the first term twice the negative log likelihood of a target, up to a constant.
    """
    return misfit(ensemble, x, y).sum() + BOUND_PENALTY * (ensemble.max_logvar.sum() - ensemble.min_logvar.sum())


def misfit(ensemble: Ensemble, x: Float[Tensor, "B n D"], y: Float[Tensor, "B n T"]) -> Float[Tensor, "B"]:
    """Twice each member's mean negative log likelihood of a target, up to a constant."""
    mean, logvar = predict(ensemble, x)
    return ((y - mean).square() * torch.exp(-logvar) + logvar).mean((-2, -1))
