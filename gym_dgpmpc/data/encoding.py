"""What a dynamics model reads and predicts: the map between raw observations and model inputs and targets.

Sits between the transition store and every dynamics model. An `ObservationSpec` decides it: angles become sine and
cosine (a stationary kernel then sees that 0 and 2 pi are one place), changes are predicted rather than values
unless a dimension is absolute, constant dimensions are not modelled at all.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.types import ObservationSpec


class Encoder:
    """Maps (observation, action) to a model's inputs, (observation, next observation) to its targets, and back.

    Inputs are ordered: the plain dimensions in the order of the observation, then sines, then cosines of the angles,
    then the action. Targets are the non-constant dimensions in the order of the observation.

    Args:
        observation_size: S.
        action_size: A.
        spec: how to read the observation; indices must lie in [0, S).

    Raises:
        ValueError: an index is out of range or repeated, or nothing is left to feed or to predict.
    """

    def __init__(self, observation_size: int, action_size: int, spec: ObservationSpec | None = None):
        spec = spec or ObservationSpec()
        _check_indices(observation_size, spec)
        fed = [i for i in range(observation_size) if i not in spec.not_inputs]
        self.observation_size, self.action_size, self.spec = observation_size, action_size, spec
        self.plain = [i for i in fed if i not in spec.angles]
        self.angles = [i for i in fed if i in spec.angles]
        self.predicted = [i for i in range(observation_size) if i not in spec.constant]
        if not self.predicted:
            raise ValueError(f"nothing is left to predict: all {observation_size} dimensions are constant in {spec}")
        self.input_size = len(self.plain) + 2 * len(self.angles) + action_size
        self.target_size = len(self.predicted)
        if not self.input_size:
            raise ValueError(f"nothing is left to feed: there is no action, and not_inputs is everything in {spec}")
        self._is_change = torch.tensor([i not in spec.absolute for i in self.predicted])
        self._wraps = torch.tensor([i in spec.angles and i not in spec.absolute for i in self.predicted])

    def inputs(self, observation: Float[Tensor, "*b S"], action: Float[Tensor, "*b A"]) -> Float[Tensor, "*b D"]:
        """The model's input, size D = plain dimensions + 2 x angles + A."""
        parts = [observation[..., self.plain]]
        if self.angles:
            angle = observation[..., self.angles]
            parts += [angle.sin(), angle.cos()]
        return torch.cat([*parts, action], dim=-1)

    def targets(
        self, observation: Float[Tensor, "*b S"], next_observation: Float[Tensor, "*b S"]
    ) -> Float[Tensor, "*b T"]:
        """What the model predicts: the change (of an angle: the smaller way round), or the value if absolute."""
        before, after = observation[..., self.predicted], next_observation[..., self.predicted]
        target = torch.where(self._is_change.to(after.device), after - before, after)
        if bool(self._wraps.any()):
            turn = 2 * math.pi
            target = torch.where(self._wraps.to(after.device), target - turn * torch.round(target / turn), target)
        return target

    def next_observation(
        self, observation: Float[Tensor, "*b S"], target: Float[Tensor, "*b T"]
    ) -> Float[Tensor, "*b S"]:
        """Inverse of `targets` in its second argument, up to whole turns of an angle."""
        out = observation.clone()
        is_change = self._is_change.to(observation.device)
        out[..., self.predicted] = target + torch.where(is_change, observation[..., self.predicted], 0.0)
        return out


def _check_indices(observation_size: int, spec: ObservationSpec) -> None:
    for name in ("angles", "absolute", "not_inputs", "constant"):
        indices = getattr(spec, name)
        bad = [i for i in indices if not 0 <= i < observation_size]
        if bad or len(set(indices)) != len(indices):
            raise ValueError(
                f"ObservationSpec.{name} must hold distinct indices from 0 to {observation_size - 1} "
                f"(the observation has {observation_size} numbers), received {indices}"
            )
