"""What a fitted model expects of the next observation: mean, variance and log density, noise included.

For looking at a model, and for comparing models as regressions are compared; plans are made through draws instead.
Every model's predictive density is a mixture of Gaussians: over posterior samples, over networks, or of just one.
"""

import math
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Predictive(NamedTuple):
    """Of the N transitions that were asked about, in raw units, for the T numbers of an observation that are predicted.

    The numbers are those of `Encoder.predicted`, which are all but the constant ones.
    """

    mean: Float[Tensor, "N T"]
    """Of the targets: of the change, or of the next value of what is ``absolute``."""
    variance: Float[Tensor, "N T"]
    log_density: Float[Tensor, "N"]
    """Of the targets that were observed, all numbers together."""


class Mixture(NamedTuple):
    """K Gaussians, alike in weight, over T independent targets at each of N points."""

    mean: Float[Tensor, "K N T"]
    variance: Float[Tensor, "K N T"]

    def predictive(self, target: Float[Tensor, "N T"]) -> Predictive:
        """Moments of the mixture (law of total variance), and its log density at the targets."""
        variance = self.variance.mean(0) + self.mean.var(0, correction=0)
        by_target = (target - self.mean).square() / self.variance + self.variance.log() + math.log(2 * math.pi)
        log_density = (-0.5 * by_target.sum(-1)).logsumexp(0) - math.log(len(self.mean))
        return Predictive(self.mean.mean(0), variance, log_density)
