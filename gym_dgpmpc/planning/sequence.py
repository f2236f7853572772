"""The plan of planners that carry nothing from step to step but one sequence of actions: `MPPI`, `GradientAscent`."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.planning.search import check_plan, midpoints, shifted


class Sequence(NamedTuple):
    """A sequence of actions, and nothing else."""

    actions: Float[Tensor, "H A"]


class CarriesSequence:
    """How such a planner begins, and moves on.

    Attributes:
        action_low: lower bounds of the action, [A].
        action_high: upper bounds, [A].
        horizon: actions in a plan, H.
    """

    action_low: Tensor
    action_high: Tensor
    horizon: int

    def initial_plan(self) -> Sequence:
        """The middle of the action range at every step."""
        return Sequence(midpoints(self.action_low, self.action_high, self.horizon))

    def shift(self, plan: Sequence, num_actions: int) -> Sequence:
        """Drop the first ``num_actions`` and fill the end with the midpoint.

        Raises:
            ValueError: the plan is not of this planner's shape, or has fewer than ``num_actions`` actions.
        """
        check_plan(plan, self.initial_plan())
        return Sequence(shifted(plan.actions, num_actions, midpoints(self.action_low, self.action_high, 1)))
