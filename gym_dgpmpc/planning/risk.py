"""What a candidate is worth whose return is not the same in all worlds: P returns become one score.

With particles that are whole worlds (a function drawn once for a plan) their spread is what the model does not know.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import grad_if_asked
from gym_dgpmpc.checks import check_reals

RiskName = Literal["mean", "mean-std", "cvar", "worst", "best"]


def mean_minus_std(returns: Float[Tensor, "P K"], aversion: float) -> Float[Tensor, " K"]:
    """The mean less ``aversion`` standard deviations of the particles (the population's: none of a single one)."""
    return returns.mean(dim=0) - aversion * returns.std(dim=0, correction=0)


def cvar(returns: Float[Tensor, "P K"], share: float) -> Float[Tensor, " K"]:
    """Conditional value at risk: the mean of the worst ``share`` of the particles, in (0, 1].

    Where that is no whole number of particles the last one counts in part, so that the measure falls steadily from the
    mean, for all of them, to the minimum, for one or less (Rockafellar and Uryasev 2002).
    """
    num_worst = share * len(returns)
    places = torch.arange(len(returns), dtype=returns.dtype, device=returns.device)
    weight = (num_worst - places).clamp(0.0, 1.0) / num_worst
    return weight @ returns.sort(dim=0).values


@dataclass(frozen=True)
class RiskMeasure:
    """One score of P returns. A candidate with a return that is not finite has the score NaN, whatever the measure.

    Attributes:
        risk: "mean"; "mean-std", the mean less ``risk_aversion`` standard deviations; "cvar", the mean of the worst
            ``cvar_share`` of the particles; "worst" or "best", the return of one particle.
        risk_aversion: standard deviations; less than zero it is optimism.
        cvar_share: share of the particles, in (0, 1].

    Raises:
        TypeError, ValueError: naming the attribute and its value.
    """

    risk: RiskName = "mean"
    risk_aversion: float = 1.0
    cvar_share: float = 0.2

    def __post_init__(self) -> None:
        if self.risk not in get_args(RiskName):
            raise ValueError(f"risk must be one of {', '.join(get_args(RiskName))}, got {self.risk!r}")
        check_reals("(-inf, inf)", risk_aversion=self.risk_aversion)
        check_reals("(0, 1]", cvar_share=self.cvar_share)

    @grad_if_asked
    def __call__(self, returns: Float[Tensor, "P K"]) -> Float[Tensor, " K"]:
        """The scores of K candidates, differentiable where the returns require gradients."""
        measures: Mapping[str, Callable[[], Tensor]] = {
            "mean": lambda: returns.mean(dim=0),
            "mean-std": lambda: mean_minus_std(returns, self.risk_aversion),
            "cvar": lambda: cvar(returns, self.cvar_share),
            "worst": lambda: returns.amin(dim=0),
            "best": lambda: returns.amax(dim=0),
        }
        # A minimum or a maximum would leave out an infinity, and the best of a diverged model might win.
        return measures[self.risk]().masked_fill(~returns.isfinite().all(dim=0), torch.nan)
