"""Forecasts of a model along recorded actions, for `gym_dgpmpc.dynamics.scores` to compare with what happened.

Both may be in units of each dimension's spread, so that tasks can stand side by side.
"""

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
