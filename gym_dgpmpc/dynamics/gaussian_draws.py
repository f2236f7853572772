"""Draws from a model that predicts a Gaussian at each point: every particle for itself, or through its moments.

Used by the ensemble and by the sparse GP. The names are those of Chua et al. (2018), "Deep Reinforcement Learning in a
Handful of Trials using Probabilistic Dynamics Models".
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import grad_if_asked
from gym_dgpmpc.dynamics.coordinates import Coordinates


class Gaussian(NamedTuple):
    """Means and variances of the (standardised) targets at P x K points; no variance means none is drawn."""

    mean: Float[Tensor, "P K T"]
    variance: Float[Tensor, "P K T"] | None


class GaussianSampler:
    """The draws `DS`, `MM` and `expectation`.

    Args:
        predict: standardised inputs "P K D" to the Gaussian there.
        coordinates: raw states to standardised coordinates and back.
        generator: of the states' device.
        match_moments: `MM`, see `match_moments`; otherwise every particle goes on from its own draw.
    """

    def __init__(
        self,
        predict: Callable[[Tensor], Gaussian],
        coordinates: Coordinates,
        generator: torch.Generator,
        *,
        match_moments: bool = False,
    ):
        self._predict, self._coordinates, self._generator = predict, coordinates, generator
        self._match_moments = match_moments

    @grad_if_asked
    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        mean, variance = self._predict(self._coordinates.encode(observation, action))
        target = mean if variance is None else mean + root(variance) * normals_like(mean, self._generator)
        states = self._coordinates.decode(observation, target)
        return match_moments(states, self._generator) if self._match_moments else states


def match_moments(states: Float[Tensor, "P K S"], generator: torch.Generator) -> Float[Tensor, "P K S"]:
    """Replace the particles of each candidate by draws from the diagonal Gaussian of their mean and variance.

    The variance is the population's, 1/P sum (s - mean)^2, so with P particles the spread shrinks by (P - 1)/P at each
    step, as in the published code of PETS. The moments are those of the next state, where that code takes the change's.
    """
    variance, mean = torch.var_mean(states, dim=0, correction=0, keepdim=True)
    return mean + root(variance) * normals_like(states, generator)


def root(variance: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The standard deviation, whose gradient is taken as zero where nothing varies: there it has none."""
    constant = variance == 0
    return variance.masked_fill(constant, 1.0).sqrt().masked_fill(constant, 0.0)


def normals_like(like: Float[Tensor, "*b"], generator: torch.Generator) -> Float[Tensor, "*b"]:
    """Standard normals of the same shape, dtype and device."""
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)
