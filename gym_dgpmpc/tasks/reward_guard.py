"""Compare the reward and termination functions of the planner with what the environment returned."""

import torch
from torch import Tensor

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.tasks.functions import TaskFunctions

TOLERANCE = 1e-3
"""Rewards may differ by this fraction of the largest one. Stored numbers are float32, and some known rewards are exact
to 3e-4 only."""


@torch.no_grad()
def disagreements(
    functions: TaskFunctions, store: TransitionStore, device: torch.device | str = "cpu", *, exact: bool = False
) -> list[str]:
    """Where a task's functions and the stored transitions disagree, a message for each function; empty if nowhere.

    With ``exact`` they are given the transitions in the precision that they came in. A reward function that is meant to
    differ from what `step` returns is not compared.
    """
    data = store.exact_transitions() if exact else store.transitions()
    # Copies: a function may write into what it is given.
    observation, action, after = (tensor.clone().to(device) for tensor in data)
    found = []
    if functions.reward_fn is not None and functions.is_reported:
        planned, returned = functions.reward_fn(observation, action, after).cpu().to(store.rewards), store.rewards
        limit = TOLERANCE * returned.abs().max().clamp(min=1e-3)
        bad = ~((planned - returned).abs() <= limit)
        found += _disagreement("reward_fn", planned.to(returned.dtype), returned, bad)
    if functions.terminated_fn is not None:
        planned = functions.terminated_fn(after).cpu()
        found += _disagreement("terminated_fn", planned, store.terminated, planned != store.terminated)
    return found


def _disagreement(name: str, planned: Tensor, returned: Tensor, bad: Tensor) -> list[str]:
    """A message about the worst of the ``bad`` transitions; none if there are no such."""
    count = int(bad.sum())
    if not count:
        return []
    # NaN counts as the largest distance.
    distance = (planned.float() - returned.float()).abs().nan_to_num(nan=torch.inf).masked_fill(~bad, -1.0)
    step = int(distance.argmax())
    return [
        f"{name} disagrees with what the environment returned in {count} of {len(bad)} transitions, most in transition "
        f"{step}: {name} gives {planned[step].item():.6g}, the environment returned {returned[step].item():.6g}. "
        "Correct the function: the planner aims at what it says, not at what the environment returns"
    ]
