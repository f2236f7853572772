"""Standardisation of a model's inputs and targets: fitted when a model trains, frozen within an episode."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

SOLVER_NOISE = 1e-9
"""What varies by less than this in float64 is taken for what a simulator's solver leaves of a constant."""


class Normaliser(NamedTuple):
    """An affine map to zero mean and unit standard deviation, per dimension (float64)."""

    mean: Float[Tensor, "D"]
    std: Float[Tensor, "D"]

    @classmethod
    def fit(
        cls,
        data: Float[Tensor, "N D"],
        magnitude: Float[Tensor, "D"] | None = None,
        precision: torch.dtype = torch.float32,
    ) -> "Normaliser":
        """Mean and standard deviation of the data.

        A dimension that does not vary beyond the rounding of the observations gets unit scale, so that it maps to
        zero instead of to amplified rounding.

        Args:
            magnitude: of the observations that the data were computed from, where it is not the data's own: a change
                has the rounding of the two numbers that it is the difference of.
            precision: that the observations came in.
        """
        data = data.double()
        mean, std = data.mean(0), data.std(0, correction=0)
        magnitude = data.abs().amax(0) if magnitude is None else magnitude
        rounding = (4 * torch.finfo(torch.float32).eps * magnitude).clamp_min(1e-12)
        if precision == torch.float64:
            finer = (4 * torch.finfo(torch.float64).eps * magnitude).clamp_min(SOLVER_NOISE)
            rounding = torch.minimum(rounding, finer)
        return cls(mean, torch.where(std > rounding, std, 1.0))

    def __call__(self, raw: Float[Tensor, "*b D"]) -> Float[Tensor, "*b D"]:
        return (raw - self.mean) / self.std

    def inverse(self, standardised: Float[Tensor, "*b D"]) -> Float[Tensor, "*b D"]:
        return standardised * self.std + self.mean
