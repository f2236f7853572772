"""How well predictive samples know what they do not know: coverage, likelihood, CRPS, error."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

LEVELS = (0.5, 0.9, 0.95)

FLOOR = 1e-4
"""The least standard deviation that a Gaussian score takes a forecast for, in the forecast's units."""


def scores(particles: Float[Tensor, "N K S"], truth: Float[Tensor, "K S"]) -> dict[str, float]:
    """Averages over points and dimensions.

    Returns:
        ``coverage_50``, ``coverage_90``, ``coverage_95``: how often the truth lies between the particles' order
        statistics that hold this share of a further particle; ``nll``: negative log density of the Gaussian with the
        particles' moments; ``crps``: continuous ranked probability score of the particles, E|x - y| - E|x - x'| / 2
        (Gneiting and Raftery 2007); ``rmse`` of the particles' mean; ``z2``: mean squared error over the variance.
        Particles that are not finite everywhere are left out; ``lost`` is their share.
    """
    finite = particles.isfinite().all(-1).all(-1)
    lost, particles = 1.0 - float(finite.double().mean()), particles[finite].double()
    truth, count = truth.double(), len(particles)
    if count < 2:
        return dict.fromkeys(("coverage_50", "coverage_90", "coverage_95", "nll", "crps", "rmse", "z2"), math.nan) | {
            "lost": lost
        }
    ordered = particles.sort(0).values
    result = {}
    for level in LEVELS:
        below = max(round((1.0 - level) / 2 * (count + 1)), 1)
        low, high = ordered[below - 1], ordered[count - below]
        result[f"coverage_{round(100 * level)}"] = float(((truth >= low) & (truth <= high)).double().mean())
    mean, std = particles.mean(0), particles.std(0).clamp_min(FLOOR)
    squared = ((truth - mean) / std).square()
    result["nll"] = float((0.5 * squared + std.log() + 0.5 * math.log(2 * math.pi)).mean())
    # E|x - x'| of a sorted sample: 2 / n^2 sum_i (2 i - n - 1) x_(i), here without the pairs of a particle with itself.
    weight = (2 * torch.arange(1, count + 1, dtype=torch.float64, device=truth.device) - count - 1).view(-1, 1, 1)
    apart = 2.0 / (count * (count - 1)) * (weight * ordered).sum(0)
    result["crps"] = float(((particles - truth).abs().mean(0) - 0.5 * apart).mean())
    result["rmse"] = float((truth - mean).square().mean().sqrt())
    result["z2"] = float(squared.mean())
    return result | {"lost": lost}
