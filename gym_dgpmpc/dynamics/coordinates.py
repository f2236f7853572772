"""Between raw observations and a model's standardised coordinates, as used inside rollouts.

`Encoder` and `Normaliser` are joined here into what a rollout step needs: standardised inputs from (state, action),
and the next state from a standardised target, each in a few operations of the rollout's precision.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser


class Coordinates:
    """The frozen map of one draw between raw states and standardised model coordinates.

    Args:
        encoder: what is fed and predicted.
        inputs: standardisation of the encoded inputs, size D.
        targets: standardisation of the targets, size T.
        dtype: precision of the rollout.
    """

    def __init__(self, encoder: Encoder, inputs: Normaliser, targets: Normaliser, dtype: torch.dtype):
        self._encoder = encoder
        self._mean, self._scale = inputs.mean.to(dtype), (1.0 / inputs.std).to(dtype)
        size = encoder.observation_size
        carried = torch.ones(size, dtype=dtype, device=self._mean.device)
        carried[list(encoder.spec.absolute)] = 0.0
        carried[list(encoder.spec.constant)] = 1.0
        self._carried = None if bool((carried == 1).all()) else carried
        # One affine map from standardised targets to the observation's dimensions.
        self._spread = torch.zeros(encoder.target_size, size, dtype=dtype, device=self._mean.device)
        self._spread[range(encoder.target_size), encoder.predicted] = targets.std.to(dtype)
        self._shift = torch.zeros(size, dtype=dtype, device=self._mean.device)
        self._shift[encoder.predicted] = targets.mean.to(dtype)

    def encode(self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "K A"]) -> Float[Tensor, "P K D"]:
        """Standardised model inputs."""
        raw = self._encoder.inputs(observation, action.expand(observation.shape[0], -1, -1))
        return raw.sub_(self._mean).mul_(self._scale)

    def decode(self, observation: Float[Tensor, "P K S"], target: Float[Tensor, "P K T"]) -> Float[Tensor, "P K S"]:
        """The next observation from a standardised target."""
        kept = observation if self._carried is None else observation * self._carried
        return (target @ self._spread).add_(self._shift).add_(kept)
