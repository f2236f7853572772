"""Whether the functions that are planned with agree with what the environment returned: the first data tell."""

import torch
from torch import Tensor

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.tasks.functions import TaskFunctions

TOLERANCE = 1e-3
"""Of the largest reward's magnitude. Stored numbers are float32, and some known rewards are exact to 3e-4 only."""


@torch.no_grad()
def disagreements(functions: TaskFunctions, store: TransitionStore, device: torch.device | str = "cpu") -> list[str]:
    """What does not agree between a task's functions and stored transitions, in words and numbers; empty if all does.

    A reward that deliberately is not the one that `step` returns is not compared.
    """
    observation, action, after = (tensor.to(device) for tensor in store.transitions())
    found = []
    if functions.reward_fn is not None and functions.is_reported:
        planned, returned = functions.reward_fn(observation, action, after).cpu(), store.rewards
        limit = TOLERANCE * returned.abs().max().clamp(min=1e-3)
        found += _told("reward_fn", planned.to(returned.dtype), returned, ~((planned - returned).abs() <= limit))
    if functions.terminated_fn is not None:
        planned = functions.terminated_fn(after).cpu()
        found += _told("terminated_fn", planned, store.terminated, planned != store.terminated)
    return found


def _told(name: str, planned: Tensor, returned: Tensor, bad: Tensor) -> list[str]:
    count = int(bad.sum())
    if not count:
        return []
    # The worst; what is not a number is worse than anything.
    distance = (planned.float() - returned.float()).abs().nan_to_num(nan=torch.inf).masked_fill(~bad, -1.0)
    step = int(distance.argmax())
    return [
        f"{name} disagrees with what the environment returned in {count} of {len(bad)} transitions, most at number "
        f"{step}: {name} gives {planned[step].item():.6g}, the environment returned {returned[step].item():.6g}. "
        "What is planned for is then not what is obtained"
    ]
