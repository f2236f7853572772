"""What the planners that score sampled sequences have in common: bounds, plans, scores and deadlines."""

import time
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.types import Objective, Plan


def check_bounds(low: Tensor, high: Tensor) -> None:
    """Raise TypeError or ValueError unless the bounds are two finite floating-point vectors in order."""
    if not (isinstance(low, Tensor) and isinstance(high, Tensor)):
        raise TypeError(
            f"action_low and action_high must be tensors (torch.as_tensor), got {type(low).__name__} and "
            f"{type(high).__name__}"
        )
    if low.ndim != 1 or low.shape != high.shape or low.shape[0] == 0:
        raise ValueError(
            f"action_low and action_high must be vectors of one length, got {tuple(low.shape)} and {tuple(high.shape)}"
        )
    if not low.is_floating_point() or low.dtype != high.dtype:
        raise ValueError(
            f"action_low and action_high must share one floating-point dtype, got {low.dtype}, {high.dtype}"
        )
    # The square, because some spaces are "bounded" by the largest number there is, whose variance overflows.
    if not bool(((high - low).square().isfinite() & (low <= high)).all()):
        raise ValueError(
            "the action bounds must be finite, and action_low nowhere above action_high, "
            f"got {low.tolist()} and {high.tolist()}"
        )


def midpoints(low: Float[Tensor, " A"], high: Float[Tensor, " A"], length: int) -> Float[Tensor, "length A"]:
    """The middle of the action range, ``length`` times."""
    return (low / 2 + high / 2).expand(length, -1).clone()


def check_plan(plan: Plan, like: Plan) -> None:
    """Refuse a plan whose fields are not finite, or not of the shapes and dtypes of those of ``like``.

    Raises:
        ValueError: naming the field.
    """
    expected = like._asdict()
    for name, value in plan._asdict().items():
        shape, dtype = tuple(expected[name].shape), expected[name].dtype
        if value.shape != shape or value.dtype != dtype:
            raise ValueError(
                f"plan.{name} must have shape {shape} and {dtype}, got {tuple(value.shape)} and {value.dtype}"
            )
        if not value.isfinite().all():
            raise ValueError(f"plan.{name} must be finite, got {value}")


def shifted(
    sequence: Float[Tensor, "*b H A"], num_actions: int, end: Float[Tensor, "*#b #n A"]
) -> Float[Tensor, "*b H A"]:
    """Sequences without their first ``num_actions``, with ``end`` in place of what is then missing.

    Raises:
        ValueError: they have fewer actions.
    """
    horizon = sequence.shape[-2]
    if not 0 <= num_actions <= horizon:
        raise ValueError(f"num_actions must lie in 0 to the horizon {horizon}, got {num_actions}")
    rest = sequence[..., num_actions:, :]
    return torch.cat([rest, end.expand(*sequence.shape[:-2], num_actions, -1)], dim=-2)


def iterations(count: int, deadline: float | None) -> Iterator[int]:
    """1 to ``count``, as long as there is time.

    Args:
        count: the most there are.
        deadline: a time of `time.perf_counter`, or None. No iteration begins that would not end by then, were it as
            slow as the slowest so far.
    """
    now, slowest = time.perf_counter(), 0.0
    for iteration in range(1, count + 1):
        if deadline is not None and now + slowest >= deadline:
            return
        yield iteration
        before, now = now, time.perf_counter()
        slowest = max(slowest, now - before)


def with_proposals(candidates: Float[Tensor, "K H A"], proposals: Float[Tensor, "n H A"] | None) -> Tensor:
    """The candidates with others' sequences in the place of the first n, of K at most."""
    if proposals is None or len(proposals) == 0:
        return candidates
    count = min(len(proposals), len(candidates))
    return torch.cat([proposals[:count].to(candidates), candidates[count:]])


def scored(objective: Objective, candidates: Float[Tensor, "K H A"]) -> Float[Tensor, " K"]:
    """The objective's scores.

    Raises:
        ValueError: there is not one for each candidate.
    """
    scores = objective(candidates)
    if scores.shape != candidates.shape[:1]:
        raise ValueError(f"the objective must return shape ({len(candidates)},), got {tuple(scores.shape)}")
    return scores


def no_finite_score(num_candidates: int, iteration: int, num_nonfinite: int) -> PlanningError:
    """The error of an iteration of which no candidate had a finite score."""
    return PlanningError(
        f"none of the {num_candidates} candidate action sequences had a finite score in iteration "
        f"{iteration} ({num_nonfinite} non-finite scores in this plan); the model or the reward diverges"
    )
