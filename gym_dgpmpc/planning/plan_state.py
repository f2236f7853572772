"""The plan that is carried from one control step to the next, and its form in SB3's recurrent `state` slot."""

from typing import NamedTuple

import numpy as np
import torch

from gym_dgpmpc.types import Plan

PolicyState = tuple[np.ndarray, ...]
"""Mean [n, H, A], standard deviation [n, H, A] and age [n] of the plans of n environments."""


class PlanState(NamedTuple):
    """A plan, and how many of its actions have been performed; at age 0 it is a warm start, to be optimised first."""

    plan: Plan
    age: int = 0


def pack(states: list[PlanState]) -> PolicyState:
    """The plans of n environments as arrays whose first dimension is n, as SB3 passes them on."""
    mean = torch.stack([state.plan.mean for state in states]).cpu().numpy()
    std = torch.stack([state.plan.std for state in states]).cpu().numpy()
    return mean, std, np.array([state.age for state in states], dtype=np.int64)


def unpack(state: PolicyState, cold: PlanState, num_envs: int, actions_per_plan: int) -> list[PlanState]:
    """The inverse of `pack`; ``cold`` gives shape, dtype and device.

    Raises:
        ValueError: the state is not one that this agent's `predict` returned for ``num_envs`` observations.
    """
    shape = tuple(cold.plan.mean.shape)
    shapes = [np.shape(array) for array in state]
    if shapes != [(num_envs, *shape), (num_envs, *shape), (num_envs,)]:
        raise ValueError(
            f"state must be what predict returned for {num_envs} observation(s): arrays of shapes "
            f"{(num_envs, *shape)} (mean), the same (std) and {(num_envs,)} (age), got {shapes}"
        )
    mean, std = (torch.as_tensor(array).to(cold.plan.mean) for array in state[:2])
    ages = [int(age) for age in state[2]]
    if not all(0 <= age < actions_per_plan for age in ages):
        raise ValueError(f"the age of a plan lies in 0 to {actions_per_plan - 1} actions, got {ages}")
    return [PlanState(Plan(mean[i], std[i]), age) for i, age in enumerate(ages)]
