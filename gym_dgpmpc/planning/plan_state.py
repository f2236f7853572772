"""The plan that is carried from one control step to the next: in the agent, in SB3's `state` slot and in a file.

Nothing here knows what a planner's plan holds; a plan is stacked and taken apart by its own fields.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from gym_dgpmpc.types import Plan

PackedPlans = tuple[np.ndarray, ...]
"""The plans of n environments in SB3's `state` slot: the fields of a plan in order, each [n, ...], and the ages [n]."""

AGE = "plan.age"


class PlanState(NamedTuple):
    """A plan, and how many of its actions have been performed; at age 0 it is a warm start, to be optimised first."""

    plan: Plan
    age: int = 0


def pack(states: Sequence[PlanState]) -> PackedPlans:
    """The plans of n environments as arrays whose first dimension is n, as SB3 passes them on."""
    return tuple(tensor.numpy() for tensor in plans_to_tensors(states).values())


def unpack(packed: PackedPlans, cold: PlanState, num_envs: int, actions_per_plan: int) -> list[PlanState]:
    """The inverse of `pack`; ``cold`` gives fields, shapes, dtypes and device.

    Raises:
        ValueError: it is not what `pack` makes of ``num_envs`` plans of this kind.
    """
    names = list(_shapes(cold, num_envs))
    if len(packed) != len(names):
        raise ValueError(f"state must be what predict returned: {len(names)} arrays {names}, got {len(packed)}")
    tensors = {name: torch.from_numpy(np.array(array)) for name, array in zip(names, packed, strict=True)}
    return plans_from_tensors(tensors, cold, num_envs, actions_per_plan)


def plans_to_tensors(states: Sequence[PlanState]) -> dict[str, Tensor]:
    """The plans of n environments, on the CPU: each field as "plan.<field>" [n, ...], and "plan.age" [n]."""
    plans = [state.plan._asdict() for state in states]
    fields = {f"plan.{name}": torch.stack([plan[name] for plan in plans]).cpu() for name in plans[0]}
    return fields | {AGE: torch.tensor([state.age for state in states], dtype=torch.int64, device="cpu")}


def plans_from_tensors(
    tensors: Mapping[str, Tensor], cold: PlanState, num_envs: int, actions_per_plan: int
) -> list[PlanState]:
    """The inverse of `plans_to_tensors`; ``cold`` gives fields, shapes, dtypes and device.

    Raises:
        KeyError: a field is missing.
        ValueError: a shape is wrong, an age is out of range, or an action is not finite.
    """
    expected = _shapes(cold, num_envs)
    found = {name: tuple(tensors[name].shape) for name in expected}
    if found != expected:
        raise ValueError(
            f"state must be what predict returned for {num_envs} observation(s): arrays of shapes "
            f"{_described(expected)}, got {list(found.values())}"
        )
    fields = {
        name: tensors[f"plan.{name}"].to(device=value.device, dtype=value.dtype)
        for name, value in cold.plan._asdict().items()
    }
    ages = [int(age) for age in tensors[AGE]]
    if not all(0 <= age < actions_per_plan for age in ages):
        raise ValueError(f"the age of a plan must lie in 0 to {actions_per_plan - 1} actions, got {ages}")
    plans = [plan_of(cold.plan, {name: value[i] for name, value in fields.items()}) for i in range(num_envs)]
    for plan in plans:
        if not plan.actions.isfinite().all():
            raise ValueError(f"the actions of a carried plan must be finite, got {plan.actions}")
    return [PlanState(plan, age) for plan, age in zip(plans, ages, strict=True)]


def plan_of(like: Plan, fields: Mapping[str, Tensor]) -> Plan:
    """A plan of the kind of ``like``, with these fields."""
    return cast(Any, type(like))(**fields)


def _shapes(cold: PlanState, num_envs: int) -> dict[str, tuple[int, ...]]:
    fields = {f"plan.{name}": (num_envs, *value.shape) for name, value in cold.plan._asdict().items()}
    return fields | {AGE: (num_envs,)}


def _described(shapes: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{shape} ({name.removeprefix('plan.')})" for name, shape in shapes.items())
