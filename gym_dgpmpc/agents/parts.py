"""What the named compositions build alike: the planner, from the arguments that they have in common."""

import torch
from gymnasium import spaces

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.planning.cem import CEM


def cem_planner(
    action_space: spaces.Box,
    device: torch.device,
    *,
    horizon: int,
    num_candidates: int,
    num_elites: int | None,
    num_iterations: int,
) -> CEM:
    """A `CEM` for these actions; ``num_elites=None`` is a tenth of the candidates, and at least one.

    Raises:
        ValueError: a number is out of its range.
    """
    check_counts(num_candidates=num_candidates)
    low, high = (
        torch.as_tensor(bound, dtype=torch.float32, device=device).flatten()
        for bound in (action_space.low, action_space.high)
    )
    return CEM(
        action_low=low,
        action_high=high,
        horizon=horizon,
        num_candidates=num_candidates,
        num_elites=max(1, num_candidates // 10) if num_elites is None else num_elites,
        num_iterations=num_iterations,
    )
