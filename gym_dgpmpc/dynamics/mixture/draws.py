"""Draws of a mixture: particles are shared out over the members, and each moves as its member's draw moves it."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.types import TrajectorySampler, TransitionSampler


class Share(NamedTuple):
    """One member's draw, and how many of the particles are its."""

    sampler: TransitionSampler
    num_particles: int


class MixtureSampler:
    """Several draws as one `TrajectorySampler`: the first particles are the first member's, and so on.

    Args:
        shares: of the members that have particles.
    """

    def __init__(self, shares: Sequence[Share]):
        self._shares = shares

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        sizes = [share.num_particles for share in self._shares]
        # Actions may be the same for all particles, or each particle's own.
        own = action.split(sizes) if action.ndim == observation.ndim else [action] * len(sizes)
        parts = zip(self._shares, observation.split(sizes), own, strict=True)
        return torch.cat([share.sampler(states, actions, step) for share, states, actions in parts])

    def trajectories(
        self, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        """The states of every particle, from members that offer it all at once, from the others step by step."""
        return torch.cat([_trajectories(share, observation, actions) for share in self._shares], dim=1)


def share_out(num_particles: int, weights: Float[Tensor, "M"], generator: torch.Generator) -> list[int]:
    """How many of P particles each of M members has: P w in expectation, and less than one away from it.

    Systematic resampling: one uniform number places P equally spaced points on the members' intervals of length w.
    """
    offset = torch.rand((), generator=generator, dtype=torch.float64, device=weights.device)
    ends = num_particles * weights.double().cumsum(0)
    ends[-1] = num_particles  # whatever the rounding of the sum
    below = (ends - offset).ceil().clamp(0, num_particles).long()
    return below.diff(prepend=below.new_zeros(1)).tolist()


def _trajectories(
    share: Share, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
) -> Float[Tensor, "H_plus_1 P K S"]:
    """The states of one member's particles."""
    if isinstance(share.sampler, TrajectorySampler):
        return share.sampler.trajectories(observation, actions).to(observation)
    states = [observation.expand(share.num_particles, len(actions), -1)]
    for step, action in enumerate(actions.to(observation).unbind(1)):
        states.append(share.sampler(states[-1], action, step).to(observation))
    return torch.stack(states)
