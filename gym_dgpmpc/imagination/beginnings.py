"""Where imagined episodes begin, and where they must not lead: both are read from what was observed.

A model knows nothing of places that no data come from, so an episode begins at an observation of the real environment,
and ends where a state leaves the observed range by far.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.types import ObservationSpec

StartName = Literal["mixed", "starts", "states"]
StartFunction = Callable[[int, np.random.Generator], Float[np.ndarray, "n S"]]
"""(n, generator) -> n observations that episodes may begin at."""
Beginnings = Callable[[int, torch.Generator], Float[Tensor, "n S"]]
"""(n, generator) -> the observations at which n episodes begin, on the generator's device."""

MARGIN = 0.5
"""How far beyond the observed range a state is still plausible, in widths of the range, to either side."""


def recorded_beginnings(store: TransitionStore, name: StartName | StartFunction) -> Beginnings:
    """Beginnings from the transitions of a store, float64 where they are kept in it.

    Args:
        store: of at least one transition.
        name: "starts", the first observations of recorded episodes; "states", any recorded observation; "mixed", one
            or the other with equal chances; or the user's own function.

    Raises:
        ValueError: there is no such name.
    """
    if callable(name):
        return _of_function(name, store.observation_size)
    if name not in get_args(StartName):
        known = ", ".join(get_args(StartName))
        raise ValueError(f"starts must be one of {known}, or a function (n, generator) -> observations, got {name!r}")
    states = store.exact_transitions().observation
    episodes = store.episodes.numpy()
    first = torch.from_numpy(np.unique(episodes, return_index=True)[1])
    share_of_starts = {"starts": 1.0, "states": 0.0, "mixed": 0.5}[name]

    def draw(count: int, generator: torch.Generator) -> Float[Tensor, "n S"]:
        uniform = torch.rand(2, count, generator=generator, dtype=torch.float64, device=generator.device).cpu()
        start = first[(uniform[0] * len(first)).long()]
        state = (uniform[0] * len(states)).long()
        return states[torch.where(uniform[1] < share_of_starts, start, state)].to(generator.device)

    return draw


def _of_function(function: StartFunction, size: int) -> Beginnings:
    def draw(count: int, generator: torch.Generator) -> Float[Tensor, "n S"]:
        seed = torch.randint(2**32, (), generator=generator, device=generator.device).item()
        returned = np.asarray(function(count, np.random.default_rng(int(seed))))
        if returned.shape != (count, size) or returned.dtype.kind != "f" or not np.isfinite(returned).all():
            raise ValueError(
                f"the function of starts must return finite floating-point observations of shape ({count}, {size}), "
                f"got {returned.dtype} of shape {returned.shape}"
            )
        return torch.from_numpy(returned).to(generator.device)

    return draw


class Plausible(NamedTuple):
    """The range in which states are plausible; infinite where nothing limits it.

    Only what the model is fed is limited: of the rest, such as a place on an endless floor, nothing in the next state
    depends on it. Angles may turn as they like, since the model sees sine and cosine of them.
    """

    low: Float[Tensor, " S"]
    high: Float[Tensor, " S"]

    @classmethod
    def of(cls, store: TransitionStore, spec: ObservationSpec, margin: float = MARGIN) -> "Plausible":
        """The observed range, and ``margin`` times its width beyond it to either side."""
        observation, _, after = store.exact_transitions()
        seen = torch.cat([observation, after])
        low, high = seen.amin(0), seen.amax(0)
        slack = margin * (high - low)
        free = [*spec.angles, *spec.not_inputs, *spec.constant, *(heading for heading, _, _ in spec.body_frame)]
        low, high = low - slack, high + slack
        low[free], high[free] = -torch.inf, torch.inf
        never_moved = slack == 0  # a range of no width would make any rounding implausible
        low[never_moved], high[never_moved] = -torch.inf, torch.inf
        return cls(low, high)

    def left(self, observation: Float[Tensor, "*b S"]) -> Bool[Tensor, "*b"]:
        """Whether a state is beyond the range, or not finite."""
        inside = (observation >= self.low) & (observation <= self.high) & observation.isfinite()
        return ~inside.all(-1)

    def to(self, like: Tensor) -> "Plausible":
        """On the device and in the precision of ``like``."""
        return Plausible(self.low.to(like), self.high.to(like))
