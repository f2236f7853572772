"""When gradients are recorded, and how what has none says so: a room above all others.

Planning costs nothing for gradients that nobody asked for. They are recorded where an argument requires one, and
everywhere else the code is that of values alone.
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from gym_dgpmpc.errors import NotDifferentiableError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def is_asked(*values: object) -> bool:
    """Whether a gradient is to be recorded: that is allowed here, and one of the tensors requires one."""
    return torch.is_grad_enabled() and any(isinstance(value, Tensor) and value.requires_grad for value in values)


def grad_if_asked(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """In place of `torch.no_grad`: nothing is recorded, unless an argument requires a gradient."""

    @wraps(function)
    def wrapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with torch.set_grad_enabled(is_asked(*args, *kwargs.values())):
            return function(*args, **kwargs)

    return wrapped


def not_differentiable(sampler: object) -> NotDifferentiableError:
    """The error of a world through which no gradient comes."""
    return NotDifferentiableError(
        f"{type(sampler).__name__} has no gradients: its next states do not follow from state and action by "
        "differentiable operations of PyTorch. Plan by a planner that asks for none (cem, icem or mppi), or with draws "
        "that have them (of a deep or a sparse Gaussian process, or of networks; not AMM with split_noise)"
    )


def refuse_if_asked(sampler: object, *values: object) -> None:
    """Raise NotDifferentiableError where a gradient is asked for of a sampler that has none."""
    if is_asked(*values):
        raise not_differentiable(sampler)
