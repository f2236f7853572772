"""How much a step of a draw may change: about as much as was ever seen.

Far from all data a Gaussian process falls back to its prior, whose standard deviation can be many times what was seen.
A particle that goes there is thrown further still, so that after some tens of steps a few of them would outweigh all
others in a forecast. `Coordinates` holds the bounds of a draw; the models of Gaussian processes keep what was seen.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.dynamics.state import take_tensors
from gym_dgpmpc.types import StateDict

MARGIN = 1.5
"""Of the range of what was seen, by which a step may leave it on either side. The range grows with the data, so the
first plans know little of it: four ranges in all leave them room for what random actions did not show, while a prior
that is many ranges wide is cut off. Where the truth lies beyond the bounds all particles stand on one of them, sure of
what is wrong, as happened with a margin of a half (docs/calibration.md)."""


class SeenTargets(NamedTuple):
    """The least and the greatest of each standardised target in the data, float64."""

    lowest: Float[Tensor, "T"]
    highest: Float[Tensor, "T"]

    @classmethod
    def of(cls, targets: Float[Tensor, "N T"]) -> "SeenTargets":
        """Of all rows, at least one."""
        return cls(*targets.aminmax(dim=0))

    @classmethod
    def unbounded(cls, size: int, device: torch.device) -> "SeenTargets":
        """Of what anything may have been seen."""
        highest = torch.full((size,), torch.inf, dtype=torch.float64, device=device)
        return cls(-highest, highest)

    def and_of(self, targets: Float[Tensor, "N T"]) -> "SeenTargets":
        """Of these rows too, if there are any."""
        return self.of(torch.cat([torch.stack(self), targets]))

    def bounds(self) -> tuple[Float[Tensor, "T"], Float[Tensor, "T"]]:
        """Between which a step's standardised targets stay, noise included."""
        margin = MARGIN * (self.highest - self.lowest)
        return self.lowest - margin, self.highest + margin

    def state(self) -> StateDict:
        """The entries "seen.lowest" and "seen.highest"."""
        return {f"seen.{name}": value for name, value in self._asdict().items()}


def take_seen(state: StateDict, size: int, device: torch.device) -> SeenTargets:
    """What `SeenTargets.state` gave; unbounded if there is nothing of it, as in older files.

    Raises:
        ValueError: only one of the entries is there, or one has another shape.
    """
    if not any(f"seen.{name}" in state for name in SeenTargets._fields):
        return SeenTargets.unbounded(size, device)
    return SeenTargets(**take_tensors(state, dict.fromkeys(SeenTargets._fields, (size,)), device, prefix="seen."))
