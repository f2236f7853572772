"""Scores of probabilistic forecasts that are given as particles: log density, CRPS and coverage.

Each compares P particles, the first axis, with one observed number, over any batch of further axes. The scores are
proper and lower is better; coverage should be what it is named after.
"""

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

LEVELS = (0.5, 0.9, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""


def coverage_name(level: float) -> str:
    """The name of an interval's coverage among `SCORES`: "inside_90"."""
    return f"inside_{100 * level:g}"


SCORES = ("nlpd", "crps", *map(coverage_name, LEVELS))

SMALLEST_STD = 1e-6
"""In raw units: that of the rounding of what a model is trained on. Identical particles are not infinitely sure."""


def scores(particles: Float[ndarray, "P *b"], observed: Float[ndarray, "*b"]) -> Mapping[str, Float[ndarray, "*b"]]:
    """All of `SCORES`, the coverages as 0 or 1.

    Raises:
        ValueError: there are fewer than two particles, or a number is not finite.
    """
    if len(particles) < 2:
        raise ValueError(f"scores need at least 2 particles, received {len(particles)}")
    if not (np.isfinite(particles).all() and np.isfinite(observed).all()):
        raise ValueError("particles and observations must be finite")
    values = [gaussian_nlpd(particles, observed), crps(particles, observed)]
    values += [inside(particles, observed, level).astype(np.float64) for level in LEVELS]
    return dict(zip(SCORES, values, strict=True))


def gaussian_nlpd(particles: Float[ndarray, "P *b"], observed: Float[ndarray, "*b"]) -> Float[ndarray, "*b"]:
    """-log N(y | mean, variance) with the particles' moments: (y - mean)^2 / (2 variance) + log(2 pi variance) / 2.

    The particles' density is not known, and their moments are what they tell best. The score is proper for any
    distribution, as far as mean and variance go (Dawid and Sebastiani 1999). A kernel density estimate would see more
    of the shape, but beyond the outermost particle, where a bad forecast is decided, it would be its bandwidth's tail
    and nothing of the model's. The shape is left to CRPS and coverage.
    """
    std = np.maximum(particles.std(axis=0, ddof=1), SMALLEST_STD)
    error = (observed - particles.mean(axis=0)) / std
    return 0.5 * error**2 + np.log(std) + 0.5 * math.log(2 * math.pi)


def crps(particles: Float[ndarray, "P *b"], observed: Float[ndarray, "*b"]) -> Float[ndarray, "*b"]:
    """Continuous ranked probability score E|X - y| - E|X - X'| / 2, in the unit of y, without bias for any P.

    With sorted particles the mean of |x_i - x_j| over the P (P - 1) ordered pairs is
    2 sum_i (2 i - P - 1) x_i / (P (P - 1)), i = 1 ... P ("fair" CRPS, Ferro 2014).
    """
    count = len(particles)
    weights = (2.0 * np.arange(1, count + 1) - count - 1) / (count * (count - 1))
    spread = np.tensordot(weights, np.sort(particles, axis=0), axes=1)
    return np.abs(particles - observed).mean(axis=0) - spread


def inside(particles: Float[ndarray, "P *b"], observed: Float[ndarray, "*b"], level: float) -> Bool[ndarray, "*b"]:
    """Whether y lies in the central interval between two order statistics.

    An observation from the particles' own distribution has each of the P + 1 ranks among them with the same
    probability, and lies between the r-th lowest and the r-th highest with (P + 1 - 2 r) / (P + 1). With
    r = (1 - level) (P + 1) / 2 that is ``level``, exactly where r is whole: of all `LEVELS` with P = 199, for one.
    """
    rank = max(round((1 - level) * (len(particles) + 1) / 2), 1)
    ordered = np.sort(particles, axis=0)
    return (ordered[rank - 1] < observed) & (observed < ordered[-rank])
