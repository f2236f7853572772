"""Stochastic-gradient Hamiltonian Monte Carlo with an adapted preconditioner, as a pure `init` and `step`.

Samples the flat vector of whitened inducing outputs of a deep Gaussian process from gradients of minibatches. The
recursion is that of Springenberg et al. (2016) as used for deep Gaussian processes by Havasi et al. (2018):
potential U(v) = N * nll(v) with nll the negative log joint *per observation*, so the injected noise scales as
1/sqrt(N). N is an argument of every step: it grows with the data, and a stale N gives a posterior at a wrong
temperature.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.randomness import quick_normals

_TINY = 1e-16


class SGHMCState(NamedTuple):
    """Position, momentum and the running statistics of the gradient that the preconditioner is made of."""

    position: Float[Tensor, "*c V"]
    momentum: Float[Tensor, "*c V"]
    averaging: Float[Tensor, "*c V"]  # xi: the length of the averaging window, per coordinate
    gradient: Float[Tensor, "*c V"]  # g: running mean of the gradient
    square: Float[Tensor, "*c V"]  # g^2: running mean of its square

    def inverse_mass(self) -> Float[Tensor, "*c V"]:
        """M^-1 = 1 / sqrt(g^2)."""
        return (self.square + _TINY).sqrt_().add_(_TINY).reciprocal_()


def init(position: Float[Tensor, "*c V"]) -> SGHMCState:
    """A chain at rest, with unit preconditioner."""
    one = torch.ones_like(position)
    return SGHMCState(position, torch.zeros_like(position), one, one, one)


def adapt(state: SGHMCState, gradient: Float[Tensor, "*c V"]) -> SGHMCState:
    """Update the running statistics: part of every burn-in step, left out while samples are kept."""
    longer = state.averaging + 1.0
    # 1 + xi (1 - g^2 / mean of squares), and the rate 1 / (xi + 1).
    settled = state.gradient.square().div_(state.square + _TINY)
    averaging = torch.addcmul(longer, state.averaging, settled, value=-1.0)
    rate = longer.reciprocal_()
    return state._replace(
        averaging=averaging,
        gradient=torch.lerp(state.gradient, gradient, rate),
        square=torch.lerp(state.square, gradient.square(), rate),
    )


def step(
    state: SGHMCState,
    gradient: Float[Tensor, "*c V"],
    num_data: int,
    generator: torch.Generator,
    *,
    step_size: float | Float[Tensor, "*c V"] = 0.01,
    decay: float = 0.05,
    burn_in: bool = True,
) -> SGHMCState:
    """One step from the gradient of nll at ``state.position``.

    p <- (1 - m) p - eps^2 M^-1 grad + N(0, 2 (eps^2 / N) m M^-1);  v <- v + p

    Args:
        gradient: of the negative log joint per observation, on a minibatch or all data.
        num_data: N, the number of observations in the *current* data.
        step_size: eps, of each coordinate its own if need be.
        decay: m, the friction.
        burn_in: also adapt the preconditioner, before using it.
    """
    if burn_in:
        state = adapt(state, gradient)
    stride = state.inverse_mass().mul_(step_size**2)  # eps^2 M^-1
    deviation = (stride * (2.0 * decay / num_data)).clamp_min_(_TINY).sqrt_()
    noise = quick_normals(gradient.shape, gradient, generator).mul_(deviation)
    momentum = noise.add_(state.momentum, alpha=1.0 - decay).addcmul_(stride, gradient, value=-1.0)
    return state._replace(position=state.position + momentum, momentum=momentum)
