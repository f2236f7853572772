"""The latents of the inner layers, e_n at datum n, and how they move given all else.

Part of the state of every chain of `sampler.py`; `following.py` moves those of new data.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.inference.gradients import Prepared, forward, likelihood, pass_first
from gym_dgpmpc.inference.layers import Passed, choose, see
from gym_dgpmpc.randomness import quick_normals

PROPOSALS = (0.0, 0.9, 0.99)
"""Correlations of a proposed latent with the present one: far, near and nearer, for data that say little or much."""


def with_latents(
    latents: Sequence[Float[Tensor, "C n D"]], num_data: int, generator: torch.Generator
) -> list[Float[Tensor, "C N D"]]:
    """Latents for grown data: those of new rows are drawn from the prior."""
    grown = []
    for latent in latents:
        shape = (latent.shape[0], num_data - latent.shape[1], latent.shape[2])
        new = torch.randn(shape, generator=generator, dtype=latent.dtype, device=latent.device)
        grown.append(torch.cat([latent, new], dim=1))
    return grown


def move_latents(
    prepared: Prepared,
    whitened: Sequence[Tensor],
    batch: Data,
    latents: Sequence[Float[Tensor, "C n D"]],
    generator: torch.Generator,
    first: Passed | None = None,
) -> tuple[list[Passed], list[Tensor]]:
    """One Metropolis step of every datum's latents, given all else; the points as they then pass through the layers.

    Proposed is r e + sqrt(1 - r^2) N(0, I), which leaves the prior as it is, so that the likelihoods alone decide
    (preconditioned Crank-Nicolson; Cotter et al. 2013). r is one of `PROPOSALS`.

    Args:
        first: the points as they pass the first layer, which no latent comes before, if that is known already.
    """
    x = batch.x.expand(len(whitened[0]), -1, -1)
    first = first or pass_first(prepared, whitened[0], see(prepared.layers[0], x))
    if not latents:
        return [first], []
    correlation = PROPOSALS[int(torch.randint(len(PROPOSALS), (1,), generator=generator, device=generator.device))]
    proposed = []
    for latent in latents:
        fresh = quick_normals(latent.shape, latent, generator)
        proposed.append(fresh.mul_(math.sqrt(1.0 - correlation**2)).add_(latent, alpha=correlation))
    ways = [forward(prepared, whitened, x, each, first) for each in (latents, proposed)]
    present, other = (likelihood(prepared, way, batch.y) for way in ways)
    uniform = torch.rand(present.shape, generator=generator, dtype=present.dtype, device=present.device)
    accepted = uniform.log() < other - present
    above = zip(prepared.layers[1:], *(way[1:] for way in ways), strict=True)
    passed = [first, *(choose(layer, accepted, new, old) for layer, old, new in above)]
    return passed, [torch.where(accepted.unsqueeze(-1), new, old) for old, new in zip(latents, proposed, strict=True)]
