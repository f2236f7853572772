"""One seed decides everything: how an agent's seed becomes the independent generators of its parts.

Each use of randomness has a `torch.Generator` of its own, so that one of them (an evaluation, say) can draw as much
as it likes without moving another. The split is numpy's `SeedSequence`: stream i of seed s is
`SeedSequence(s, spawn_key=(i,))`, with i the position of its name in `STREAMS`. New names go at the end, so that
old seeds keep their meaning.
"""

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class Generators(NamedTuple):
    """An agent's generators, one per use."""

    exploration: torch.Generator
    """The uniform actions before there is a model; other random ones have an `episode_generator`."""
    fit: torch.Generator
    """Training and re-sampling of the dynamics model."""
    planning: torch.Generator
    """The worlds and candidate sequences behind the actions taken while learning."""
    prediction: torch.Generator
    """The same for `predict(deterministic=False)`."""

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {name: generator.get_state() for name, generator in self._asdict().items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Continue from saved states.

        Raises:
            KeyError: a generator's state is missing.
            RuntimeError: a state is not one of a `torch.Generator` of this device.
        """
        for name, generator in self._asdict().items():
            generator.set_state(state[name])


STREAMS = (
    *Generators._fields,
    "deterministic_prediction",
    "environment",
    "forecast",
    "other_device",
    "imagination",
)


def derive_seed(seed: int, stream: str, *key: int) -> int:
    """The seed of one of the `STREAMS`, or of its substream ``key``: 32 bits, as environments take at most these."""
    sequence = np.random.SeedSequence(seed, spawn_key=(STREAMS.index(stream), *key))
    return int(sequence.generate_state(1)[0])


def split_seed(seed: int, device: torch.device | str = "cpu") -> Generators:
    """The generators of an agent with this seed."""
    return Generators(*(torch.Generator(device).manual_seed(derive_seed(seed, name)) for name in Generators._fields))


def observation_generator(seed: int, observation: np.ndarray, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator that depends on the seed and the observation alone.

    What is planned with it is a function of the observation, and yet successive steps of an episode draw different
    worlds, as they do while learning.
    """
    digest = hashlib.blake2b(np.ascontiguousarray(observation).tobytes(), digest_size=4).digest()
    key = int.from_bytes(digest, "little")
    return torch.Generator(device).manual_seed(derive_seed(seed, "deterministic_prediction", key))


def quick_normals(shape: Sequence[int], like: Tensor, generator: torch.Generator) -> Tensor:
    """Standard normals of the dtype and device of ``like``, drawn in float32.

    On a CPU that is several times faster than float64. They are rounded to 24 bits, and none is beyond 5.8, where one
    of 150 million would be: for noise, whose size nobody knows to seven digits.
    """
    return torch.randn(shape, generator=generator, dtype=torch.float32, device=like.device).to(like.dtype)


def episode_generator(seed: int, episode: int, part: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator for the actions of a part of a random episode, by the numbers of episode and part alone."""
    return torch.Generator(device).manual_seed(derive_seed(seed, "exploration", episode, part))


def fresh_seed() -> int:
    """A seed from the operating system, for an agent that was given none; 32 bits."""
    return int(np.random.SeedSequence().generate_state(1)[0])
