"""Adam (Kingma and Ba 2015): as a pure `init` and `step` on one tensor, and what PyTorch's own starts from.

`sampler.py` takes a step at every iteration, which by PyTorch's optimiser costs more than all its arithmetic. The
ensemble uses that, with `adam_memory`: PyTorch's own start takes the process's default device, which may be another.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

KEPT, KEPT_OF_SQUARES, LEAST = 0.9, 0.999, 1e-8
"""How much of the running means a step keeps, and what keeps it finite: the paper's beta_1, beta_2 and epsilon."""


class AdamState(NamedTuple):
    """Steps so far, and running means of the gradient and of its square."""

    num_steps: int
    gradient: Float[Tensor, "*c V"]
    square: Float[Tensor, "*c V"]


def init(position: Float[Tensor, "*c V"]) -> AdamState:
    """Before the first step."""
    return AdamState(0, torch.zeros_like(position), torch.zeros_like(position))


def step(
    state: AdamState, position: Float[Tensor, "*c V"], gradient: Float[Tensor, "*c V"], learning_rate: float
) -> tuple[AdamState, Float[Tensor, "*c V"]]:
    """One step down the gradient: the new state and position."""
    num_steps = state.num_steps + 1
    mean = torch.lerp(state.gradient, gradient, 1.0 - KEPT)
    square = torch.lerp(state.square, gradient.square(), 1.0 - KEPT_OF_SQUARES)
    # The running means begin at zero, and are too small by these factors.
    scale = (square / (1.0 - KEPT_OF_SQUARES**num_steps)).sqrt_().add_(LEAST)
    moved = torch.addcdiv(position, mean, scale, value=-learning_rate / (1.0 - KEPT**num_steps))
    return AdamState(num_steps, mean, square), moved


def adam_memory(
    parameter: Tensor, num_updates: int = 0, moments: tuple[Tensor, Tensor] | None = None
) -> dict[str, Tensor]:
    """The state of `torch.optim.Adam` for one parameter.

    Args:
        parameter: what it moves.
        num_updates: how often it has moved it.
        moments: means of the gradient and of its square, of the parameter's shape; None: zeros.
    """
    first, second = (torch.zeros_like(parameter), torch.zeros_like(parameter)) if moments is None else moments
    step = torch.tensor(float(num_updates), dtype=torch.float32, device="cpu")
    return {"step": step, "exp_avg": first.detach().clone(), "exp_avg_sq": second.detach().clone()}
