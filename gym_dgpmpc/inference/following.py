"""The posterior follows new data within an episode: the last layer exactly, at a cost that does not grow with the data.

Between two trainings the hyperparameters and inner layers of every chain stay as they are. What a datum says of the
last layer then is a term of a sum (`last_layer.py`), so only the terms of new data are to be found. Their latents are
part of the chain's state, as in training, and are moved given the last draw.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.standardised import Data, DataSource
from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.inference.gradients import forward, prepare
from gym_dgpmpc.inference.last_layer import LastLayerEvidence, last_layer_evidence
from gym_dgpmpc.inference.latents import move_latents, with_latents

BLOCK = 32
"""Rows whose terms are added together, once and for all as soon as there are so many. Sums over whole blocks, in their
order, are the same numbers whether they were made one by one or all at once after loading."""


class Followed(NamedTuple):
    """Samples of the chains under the grown data."""

    positions: Float[Tensor, "n C V"]
    latents: list[Float[Tensor, "C N D"]]
    """Of every row, float32."""
    targets: Float[Tensor, "r T"]
    """Of the new rows, and some others at the first call."""


class Follower:
    """Keeps the sum over all whole blocks of rows.

    Args:
        model: of C chains, which stays.
        inner: inducing outputs of the inner layers, which stay.
        compile: see `gradients.prepare`.
    """

    def __init__(self, model: DeepGP, inner: Float[Tensor, "C I"], *, compile: bool = True):
        self._prepared, self._inner = prepare(model, compile=compile), inner
        # What the last layer is fed does not depend on where it is itself.
        rest = inner.new_zeros(len(inner), model.num_whitened() - inner.shape[1])
        self._whitened = model.split(torch.cat([inner, rest], dim=1))
        chains, targets = model.log_noise.shape
        size = model.layers[-1].inducing_inputs.shape[-2]
        self._sum = LastLayerEvidence(
            inner.new_zeros(chains, targets, size, size), inner.new_zeros(chains, targets, size)
        )
        self._num_summed = 0

    def follow(
        self,
        position: Float[Tensor, "C V"],
        data: DataSource,
        latents: Sequence[Float[Tensor, "C N D"]],
        num_samples: int,
        generator: torch.Generator,
    ) -> Followed:
        """Draw from the posterior given all rows.

        Args:
            position: where the chains are.
            data: the rows of the call before, and behind them new ones.
            latents: those of the call before, float32.
            num_samples: of each chain; they share its inner layers.

        Raises:
            FactorisationError: the data's terms are not finite; nothing has changed.
        """
        # Depends on what is given alone, so that chains that were saved and loaded go the same way.
        unsettled = _whole(latents[0].shape[1]) if latents else data.num_rows
        grown = with_latents(latents, data.num_rows, generator)
        begin, whole = self._num_summed, _whole(data.num_rows)
        rows = data.rows(torch.arange(begin, data.num_rows, dtype=torch.int64, device=position.device))
        # Of what the sum does not hold yet.
        recent = [latent[:, begin:] for latent in grown]
        if unsettled < data.num_rows:
            self._move(position, _part(rows, unsettled - begin), [e[:, unsettled - begin :] for e in recent], generator)
        total = self._sum
        for first in range(0, whole - begin, BLOCK):
            total = total.plus(self._evidence(rows, recent, first, first + BLOCK))
        evidence = total
        if whole < data.num_rows:
            evidence = total.plus(self._evidence(rows, recent, whole - begin, data.num_rows - begin))
        positions = evidence.posterior(self._prepared.factorise).positions(self._inner, num_samples, generator)
        self._sum, self._num_summed = total, whole
        return Followed(positions, grown, rows.y)

    def _move(
        self,
        position: Float[Tensor, "C V"],
        batch: Data,
        latents: Sequence[Float[Tensor, "C n D"]],
        generator: torch.Generator,
    ) -> None:
        """One Metropolis step of the latents of these rows, in place."""
        whitened, present = self._prepared.model.split(position), [latent.to(position) for latent in latents]
        _, moved = move_latents(self._prepared, whitened, batch, present, generator)
        for latent, new in zip(latents, moved, strict=True):
            latent.copy_(new)

    def _evidence(
        self, rows: Data, latents: Sequence[Float[Tensor, "C n D"]], first: int, end: int
    ) -> LastLayerEvidence:
        """Of the rows from ``first`` to ``end``."""
        batch = _part(rows, first, end)
        x = batch.x.expand(len(self._inner), -1, -1)
        passed = forward(self._prepared, self._whitened, x, [latent[:, first:end].to(x) for latent in latents])
        return last_layer_evidence(self._prepared, passed[-1], batch.y)


def _whole(num_rows: int) -> int:
    """The rows in whole blocks."""
    return num_rows - num_rows % BLOCK


def _part(rows: Data, first: int, end: int | None = None) -> Data:
    return Data(rows.x[first:end], rows.y[first:end])
