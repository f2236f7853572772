"""What a policy's networks are fed: observations as the dynamics model reads them, angles as sine and cosine, in scale.

Raw observations have units of their own, and an angle that has turned once is another number for the same place. It is
a features extractor of Stable-Baselines3's, and so a part of the policy: `predict` takes raw observations.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import torch
from jaxtyping import Float
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.types import ObservationSpec


class EncodedObservation(BaseFeaturesExtractor):
    """Chosen numbers of an observation, and sines and cosines of its angles, standardised by fixed constants.

    Args:
        observation_space: a Box of vectors.
        plain, angles: which numbers are fed as they are, and which as sine and cosine.
        mean, std: of the features, [len(plain) + 2 len(angles)].
    """

    def __init__(
        self,
        observation_space: gymnasium.Space,
        plain: Sequence[int],
        angles: Sequence[int],
        mean: Sequence[float],
        std: Sequence[float],
    ):
        super().__init__(observation_space, features_dim=len(mean))
        self._plain, self._angles = list(plain), list(angles)
        for name, values in (("mean", mean), ("std", std)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32, device="cpu"))

    def forward(self, observation: Float[Tensor, "n S"]) -> Float[Tensor, "n F"]:
        features = features_of(observation, self._plain, self._angles)
        return (features - self.get_buffer("mean")) / self.get_buffer("std")


def features_of(observation: Float[Tensor, "n S"], plain: list[int], angles: list[int]) -> Float[Tensor, "n F"]:
    """The plain numbers, then the sines, then the cosines of the angles."""
    turned = observation[..., angles]
    return torch.cat([observation[..., plain], turned.sin(), turned.cos()], dim=-1)


def encoding(store: TransitionStore, spec: ObservationSpec) -> dict[str, Any]:
    """The arguments of a policy by which it is fed what was observed in units of its own spread.

    What the model is not fed the policy is not either, unless it is constant, as a goal is, or the heading of a vector.
    A number that has never changed keeps its unit.
    """
    headings = {heading for heading, _, _ in spec.body_frame}
    fed = [
        index
        for index in range(store.observation_size)
        if index not in spec.not_inputs or index in spec.constant or index in headings
    ]
    angles = [index for index in fed if index in spec.angles]
    plain = [index for index in fed if index not in spec.angles]
    features = features_of(store.transitions().observation, plain, angles)
    std = features.std(0, correction=0)
    std = torch.where(std > 0, std, torch.ones_like(std))
    return {
        "features_extractor_class": EncodedObservation,
        "features_extractor_kwargs": {
            "plain": plain, "angles": angles, "mean": features.mean(0).tolist(), "std": std.tolist()
        },
    }  # fmt: skip
