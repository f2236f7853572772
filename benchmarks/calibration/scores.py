"""How well predictive samples know what they do not know: coverage, likelihood, CRPS, error.

`forecast` takes particles of a model along recorded actions; `scores` compares them with what happened. Both may be in
units of each dimension's spread, so that tasks can stand side by side.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.types import DynamicsModel, Transitions

NUM_DRAWS, NUM_PARTICLES = 40, 5
"""Worlds are drawn as for plans: five at a time, and forty times over, as an episode's plans do."""

STRIDE = 5
"""Steps between two starts of a forecast within an episode."""

LEVELS = (0.5, 0.9, 0.95)

FLOOR = 1e-4
"""The least standard deviation that a Gaussian score takes a forecast for, in the forecast's units."""


class Forecast(NamedTuple):
    """Of K points, in raw units."""

    particles: Float[Tensor, "N K S"]
    truth: Float[Tensor, "K S"]


def forecast(
    model: DynamicsModel, episodes: Sequence[Transitions], horizons: Sequence[int], generator: torch.Generator
) -> dict[int, Forecast]:
    """Particles some steps ahead from every `STRIDE`-th step of each episode, and what was observed there.

    Only steps that have the longest horizon before them; all horizons are seen from the same ones.
    """
    longest = max(horizons)
    particles: dict[int, list[Tensor]] = {horizon: [] for horizon in horizons}
    truth: dict[int, list[Tensor]] = {horizon: [] for horizon in horizons}
    for episode in episodes:
        start = torch.arange(0, len(episode.action) - longest + 1, STRIDE)
        drawn: dict[int, list[Tensor]] = {horizon: [] for horizon in horizons}
        for _ in range(NUM_DRAWS):
            sampler = model.draw(NUM_PARTICLES, longest, generator)
            state = episode.observation[start].expand(NUM_PARTICLES, -1, -1).contiguous()
            for step in range(longest):
                state = sampler(state, episode.action[start + step], step)
                if step + 1 in drawn:
                    drawn[step + 1].append(state)
        for horizon in horizons:
            particles[horizon].append(torch.cat(drawn[horizon]))
            truth[horizon].append(episode.next_observation[start + horizon - 1])
    return {horizon: Forecast(torch.cat(particles[horizon], dim=1), torch.cat(truth[horizon])) for horizon in horizons}


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
    weight = (2 * torch.arange(1, count + 1, dtype=torch.float64) - count - 1).view(-1, 1, 1)
    apart = 2.0 / (count * (count - 1)) * (weight * ordered).sum(0)
    result["crps"] = float(((particles - truth).abs().mean(0) - 0.5 * apart).mean())
    result["rmse"] = float((truth - mean).square().mean().sqrt())
    result["z2"] = float(squared.mean())
    return result | {"lost": lost}
