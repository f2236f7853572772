"""Observations whose changes float32 would hide: finding them, and scoring them in float64.

A place in metres of a map (5e5), a time stamp (1.7e9) or degrees of latitude are large beside what a step changes.
`task.py` looks at the stored transitions before each training. From when such a number is found, the model is given
float64 transitions, and a plan's states are float64; everything else stays as it is.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gym_dgpmpc.data.normaliser import SOLVER_NOISE
from gym_dgpmpc.tasks.functions import TaskFunctions
from gym_dgpmpc.types import RewardFn, TerminatedFn, Transitions

HIDDEN = 1e-2
"""Float32 hides a number's changes if it may round the number by more than this fraction of them."""
FAR = 1e3
"""Of float32 observations only numbers as large as this are warned of: a number that rests near one is no fault."""


def hidden_changes(data: Transitions) -> Bool[Tensor, "S"]:
    """Whether float32 hides how each number of the observations changes (root mean square over the transitions)."""
    before, after = data.observation.double(), data.next_observation.double()
    change = (after - before).square().mean(0).sqrt()
    rounding = torch.finfo(torch.float32).eps * torch.maximum(before.abs().amax(0), after.abs().amax(0))
    return (change > SOLVER_NOISE) & (rounding > HIDDEN * change)


def warn_of_hidden_changes(data: Transitions, what: str) -> None:
    """One warning that changes of observations are lost to float32, if they are.

    Args:
        data: as they are stored.
        what: why float64 does not help here, and what would.
    """
    far = data.next_observation.abs().amax(0) > FAR
    lost = (hidden_changes(data) & far).nonzero().flatten().tolist()
    if lost:
        largest = data.next_observation[:, lost].abs().amax(0).tolist()
        warnings.warn(
            f"the numbers {lost} of the observation are so large ({', '.join(f'{each:.3g}' for each in largest)}) that "
            f"float32 rounds away what a step changes of them: {what}, or subtract a constant from them in the "
            "environment",
            stacklevel=5,
        )


def in_double(functions: TaskFunctions, data: Transitions) -> TaskFunctions:
    """The functions for float64 states; one that cannot take them is given float32, with a warning.

    Args:
        functions: as they are planned with.
        data: float64 vectors and actions, of any batch, to try them on.
    """
    reward_fn, terminated_fn = functions.reward_fn, functions.terminated_fn
    if reward_fn is not None and not _takes(reward_fn, *data):
        _warn_of_single("reward_fn")
        reward_fn = SingleReward(reward_fn)
    if terminated_fn is not None and not _takes(terminated_fn, data.next_observation):
        _warn_of_single("terminated_fn")
        terminated_fn = SingleTermination(terminated_fn)
    return functions._replace(reward_fn=reward_fn, terminated_fn=terminated_fn)


def _takes(function: Any, *arguments: Tensor) -> bool:
    try:
        function(*arguments)
    except Exception:  # whatever a function raises that mixes them with float32 of its own
        return False
    return True


def _warn_of_single(name: str) -> None:
    warnings.warn(
        f"{name} does not take float64 tensors, so it is given observations rounded to float32, which hides what a "
        "step changes of them: make its own tensors by observation.new_tensor(...)",
        stacklevel=5,
    )


@dataclass(frozen=True)
class SingleReward:
    """A reward function that is given float32."""

    reward_fn: RewardFn

    def __call__(
        self,
        observation: Float[Tensor, "*b S"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S"],
    ) -> Float[Tensor, "*b"]:
        return self.reward_fn(observation.float(), action.float(), next_observation.float())


@dataclass(frozen=True)
class SingleTermination:
    """A termination function that is given float32."""

    terminated_fn: TerminatedFn

    def __call__(self, next_observation: Float[Tensor, "*b S"]) -> Bool[Tensor, "*b"]:
        return self.terminated_fn(next_observation.float())
