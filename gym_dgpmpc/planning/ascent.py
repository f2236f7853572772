"""Climbing K functions at once within the unit box: Adam, or L-BFGS, each as a pure `init` and `step`.

A position is a row of numbers in [0, 1]. `init` says what to evaluate first; `step` takes the values and gradients
there and says what to evaluate next, so that every evaluation is one call for all rows. Rows do not meet. Both project:
a number that would leave the box stays on its border, from which it comes back once its gradient points inwards.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gym_dgpmpc.inference import adam

MEMORY = 10
"""Steps whose curvature L-BFGS remembers; 3 to 20 are usual (Nocedal and Wright 2006, sec. 7.2)."""

SUFFICIENT = 1e-4
"""Of the increase that the gradient promises, what a step of L-BFGS must bring (Armijo's condition)."""

LEAST_CURVATURE = 1e-10
"""Of |y|^2, which s . y must exceed for a step s with the change y of the gradient to count."""


class AdamAscent(NamedTuple):
    """Kingma and Ba (2015), with steps that shorten linearly to nothing over the ``num_steps`` that were announced.

    A row whose value or gradient is not finite goes back to its best place, and keeps its momentum.
    """

    position: Float[Tensor, "K n"]
    """What to evaluate next."""
    best: Float[Tensor, "K n"]
    best_value: Float[Tensor, " K"]
    moments: adam.AdamState
    step_length: float
    num_steps: int

    @classmethod
    def init(cls, start: Float[Tensor, "K n"], step_length: float, num_steps: int) -> "AdamAscent":
        """Before the first evaluation, which is at ``start``; a step moves a number by about ``step_length``."""
        nothing = start.new_full((len(start),), -torch.inf)
        return cls(start, start, nothing, adam.init(start), step_length, num_steps)

    def step(self, value: Float[Tensor, " K"], gradient: Float[Tensor, "K n"]) -> "AdamAscent":
        """Given what was found at `position`, which may not be finite."""
        finite = is_finite(value, gradient)
        better = finite & (value > self.best_value)
        best = torch.where(better.unsqueeze(-1), self.position, self.best)
        position = torch.where(finite.unsqueeze(-1), self.position, best)
        length = self.step_length * max(0.0, 1.0 - self.moments.num_steps / self.num_steps)
        downhill = -gradient.masked_fill(~finite.unsqueeze(-1), 0.0)
        moments, moved = adam.step(self.moments, position, downhill, length)
        best_value = torch.where(better, value, self.best_value)
        return self._replace(position=moved.clamp(0.0, 1.0), best=best, best_value=best_value, moments=moments)


class LBFGSAscent(NamedTuple):
    """Projected limited-memory BFGS, with a step that is halved until it brings enough.

    Numbers on a border whose gradients point outwards are held there, and the curvature is that of the others
    (Bertsekas 1982, "Projected Newton methods for optimization problems with simple constraints"). Each evaluation is
    a trial: where it brings enough, or is the row's first one, the row moves there and takes a new direction; elsewhere
    it tries half the step.
    """

    position: Float[Tensor, "K n"]
    """What to evaluate next."""
    place: Float[Tensor, "K n"]
    value: Float[Tensor, " K"]
    gradient: Float[Tensor, "K n"]
    direction: Float[Tensor, "K n"]
    share: Float[Tensor, " K"]
    """Of the direction, that is tried."""
    steps: Float[Tensor, "m K n"]
    changes: Float[Tensor, "m K n"]
    """How much the gradient fell over each of the steps."""
    step_length: float

    @classmethod
    def init(cls, start: Float[Tensor, "K n"], step_length: float, num_steps: int) -> "LBFGSAscent":
        """Before the first evaluation; until curvature is known a step moves no number by more than ``step_length``."""
        nothing, zero = start.new_full((len(start),), -torch.inf), torch.zeros_like(start)
        share, past = start.new_ones(len(start)), start.new_empty(0, *start.shape)
        return cls(start, start, nothing, zero, zero, share, past, past, step_length)

    def step(self, value: Float[Tensor, " K"], gradient: Float[Tensor, "K n"]) -> "LBFGSAscent":
        """Given what was found at `position`, which may not be finite."""
        moved = self.position - self.place
        enough = self.value + SUFFICIENT * (self.gradient * moved).sum(-1)
        accepted = is_finite(value, gradient) & (value >= enough)
        rows, known = accepted.unsqueeze(-1), self.value.isfinite().unsqueeze(-1)
        place, climbed = torch.where(rows, self.position, self.place), torch.where(rows, gradient, self.gradient)
        kept = (rows & known).to(moved)
        steps = torch.cat([self.steps, (moved * kept).unsqueeze(0)])[-MEMORY:]
        fallen = torch.where(rows & known, self.gradient - gradient, 0.0)
        changes = torch.cat([self.changes, fallen.unsqueeze(0)])[-MEMORY:]
        held = ((place <= 0.0) & (climbed < 0.0)) | ((place >= 1.0) & (climbed > 0.0))
        direction = uphill(climbed, steps, changes, ~held, self.step_length)
        direction = torch.where(rows, direction, self.direction)
        share = torch.where(accepted, 1.0, 0.5 * self.share)
        position = (place + share.unsqueeze(-1) * direction).clamp(0.0, 1.0)
        value = torch.where(accepted, value, self.value)
        return LBFGSAscent(position, place, value, climbed, direction, share, steps, changes, self.step_length)


def uphill(
    gradient: Float[Tensor, "K n"],
    steps: Float[Tensor, "m K n"],
    changes: Float[Tensor, "m K n"],
    free: Bool[Tensor, "K n"],
    step_length: float,
) -> Float[Tensor, "K n"]:
    """L-BFGS's direction among the free numbers, by the two loops of Nocedal and Wright (2006), algorithm 7.4.

    A step that is zero, or along which the gradient does not fall, does not count; if none does the direction is the
    gradient's, with ``step_length`` as its largest number.
    """
    steps, changes, rest = steps * free, changes * free, gradient * free
    curvature, size = (steps * changes).sum(-1), changes.square().sum(-1)
    counts = curvature > LEAST_CURVATURE * size
    weight = torch.where(counts, 1.0 / curvature, 0.0)
    scale = step_length / rest.abs().amax(-1).clamp_min(torch.finfo(rest.dtype).tiny)
    shares = []
    for i in reversed(range(len(steps))):
        shares.append(weight[i] * (steps[i] * rest).sum(-1))
        rest = rest - shares[-1].unsqueeze(-1) * changes[i]
    for i in range(len(steps)):  # the newest that counts has the last word
        scale = torch.where(counts[i], curvature[i] / size[i], scale)
    rest = scale.unsqueeze(-1) * rest
    for i, share in enumerate(reversed(shares)):
        rest = rest + (share - weight[i] * (changes[i] * rest).sum(-1)).unsqueeze(-1) * steps[i]
    return rest


def is_finite(value: Float[Tensor, " K"], gradient: Float[Tensor, "K n"]) -> Bool[Tensor, " K"]:
    """Rows of which value and gradient are finite."""
    return value.isfinite() & gradient.isfinite().all(-1)
