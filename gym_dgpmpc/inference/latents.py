"""The latents of the inner layers, e_n at datum n, and how they move given all else.

Part of the state of every chain of `sampler.py`; `following.py` moves those of new data.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp.deep_gp import Factorised
from gym_dgpmpc.inference.gradients import LayerTerms, Passed, choose, forward, likelihood, pass_first, see

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
    factorised: Factorised,
    terms: Sequence[LayerTerms],
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
        latents: as they are kept; what is proposed is rounded to their precision.
        first: the points as they pass the first layer, which no latent comes before, if that is known already.
    """
    x = batch.x.expand(len(whitened[0]), -1, -1)
    first = first or pass_first(terms, whitened[0], see(terms[0], x))
    if not latents:
        return [first], []
    correlation = PROPOSALS[int(torch.randint(len(PROPOSALS), (1,), generator=generator, device=generator.device))]
    proposed = []
    for latent in latents:
        fresh = torch.randn(latent.shape, generator=generator, dtype=x.dtype, device=latent.device)
        proposed.append((correlation * latent + math.sqrt(1.0 - correlation**2) * fresh).to(latent.dtype))
    ways = [forward(terms, whitened, x, [e.to(x.dtype) for e in each], first) for each in (latents, proposed)]
    present, other = (likelihood(factorised, way, batch.y) for way in ways)
    uniform = torch.rand(present.shape, generator=generator, dtype=present.dtype, device=present.device)
    accepted = uniform.log() < other - present
    passed = [first, *(choose(accepted, new, old) for old, new in zip(*(way[1:] for way in ways), strict=True))]
    return passed, [torch.where(accepted.unsqueeze(-1), new, old) for old, new in zip(latents, proposed, strict=True)]
