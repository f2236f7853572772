"""Between raw observations and a model's standardised coordinates, as used inside rollouts.

`Encoder` and `Normaliser` are joined here into what a rollout step needs: standardised inputs from (state, action),
and the next state from a standardised target, each in a few operations of the rollout's precision.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.bounds import SeenTargets


class Coordinates:
    """The frozen map of one draw between raw states and standardised model coordinates.

    Args:
        encoder: what is fed and predicted.
        inputs: standardisation of the encoded inputs, size D.
        targets: standardisation of the targets, size T.
        dtype: precision of the rollout; states come in and go out in any other. Float64 states keep their precision:
            what is added to them, and what they are standardised by, is then not rounded to that of the rollout.
        seen: what bounds the targets of a step, if anything does; see `bounds.py`. What is NaN stays so.

    Attributes:
        input_mean, input_scale: of the encoded inputs, [D].
        inputs: the standardisation of the inputs, float64.
        exact_shift: ``shift`` in float64.
        carried, shift: the next state is carried * state + shift + what the targets add to it, [S] each. The latter two
            are along the body's axes for a vector in ``body_frame``.
        spread: what one unit of each standardised target adds to its dimension of the state, [T].
        lowest, highest: the bounds of each standardised target, [T].
    """

    def __init__(
        self,
        encoder: Encoder,
        inputs: Normaliser,
        targets: Normaliser,
        dtype: torch.dtype,
        seen: SeenTargets | None = None,
    ):
        self.encoder, self.dtype, self.inputs = encoder, dtype, inputs
        self.input_mean, self.input_scale = inputs.mean.to(dtype), (1.0 / inputs.std).to(dtype)
        size = encoder.observation_size
        self.carried = encoder.carried.to(self.input_mean)
        self._all_carried = not encoder.spec.absolute
        self.spread = targets.std.to(dtype)
        # One affine map from standardised targets to the observation's dimensions.
        self._spread = torch.zeros(encoder.target_size, size, dtype=dtype, device=self.input_mean.device)
        self._spread[range(encoder.target_size), encoder.predicted] = self.spread
        self.shift = torch.zeros(size, dtype=dtype, device=self.input_mean.device)
        self.shift[encoder.predicted] = targets.mean.to(dtype)
        self.exact_shift = torch.zeros(size, dtype=torch.float64, device=self.input_mean.device)
        self.exact_shift[encoder.predicted] = targets.mean.double()
        self._is_bounded = seen is not None
        seen = seen or SeenTargets.unbounded(encoder.target_size, self.input_mean.device)
        self.lowest, self.highest = (bound.to(dtype) for bound in seen.bounds())

    def encode(self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"]) -> Float[Tensor, "P K D"]:
        """Standardised model inputs; the actions are those of all particles, or each one's own."""
        if self._is_finer(observation):
            raw = self.encoder.inputs(observation, action.to(observation).expand(observation.shape[0], -1, -1))
            return self.inputs(raw).to(self.dtype)
        observation, action = observation.to(self.dtype), action.to(self.dtype)
        raw = self.encoder.inputs(observation, action.expand(observation.shape[0], -1, -1))
        return raw.sub_(self.input_mean).mul_(self.input_scale)

    def decode(self, observation: Float[Tensor, "*b S"], target: Float[Tensor, "*b T"]) -> Float[Tensor, "*b S"]:
        """The next observation from a standardised target within its bounds, in the precision of ``observation``."""
        target = target.to(self.dtype)
        if self._is_bounded:
            target = target.clamp(self.lowest, self.highest)
        if self._is_finer(observation):
            finely = (target @ self._spread).to(observation) + self.exact_shift
            return self.encoder.vectors.turned(finely, observation, 1.0) + observation * self.carried
        before = observation.to(self.dtype)
        kept = before if self._all_carried else before * self.carried
        added = (target @ self._spread).add_(self.shift)
        return self.encoder.vectors.turned(added, before, 1.0).add_(kept).to(observation.dtype)

    def _is_finer(self, observation: Tensor) -> bool:
        """Whether states have a precision that the rollout's own would lose."""
        return observation.dtype == torch.float64 != self.dtype
