"""What a dynamics model reads and predicts: the map between raw observations and model inputs and targets.

Sits between the transition store and every dynamics model. An `ObservationSpec` decides it: angles become sine and
cosine (a stationary kernel then sees that 0 and 2 pi are one place), vectors are turned into the body's frame, changes
are predicted rather than values unless a dimension is absolute, and constant dimensions are not modelled at all.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.types import ObservationSpec


class VectorColumns(NamedTuple):
    """Where the k vectors of `ObservationSpec.body_frame` stand: headings in an observation, x and y in any tensor."""

    headings: list[int]
    x: list[int]
    y: list[int]

    @classmethod
    def of(cls, body_frame: Iterable[tuple[int, int, int]]) -> "VectorColumns":
        """The columns of the observation itself."""
        frames = list(body_frame)
        return cls(*([frame[i] for frame in frames] for i in range(3)))

    def turned(
        self, values: Float[Tensor, "*b n"], observation: Float[Tensor, "*b S"], sense: float
    ) -> Float[Tensor, "*b n"]:
        """The values, each vector turned by ``sense`` times its heading: 1 from the body to fixed axes, -1 back."""
        if not self.headings:
            return values
        angle = observation[..., self.headings]
        cosine, sine = angle.cos(), sense * angle.sin()
        x, y = values[..., self.x], values[..., self.y]
        out = values.clone()
        out[..., self.x] = cosine * x - sine * y
        out[..., self.y] = sine * x + cosine * y
        return out


class Encoder:
    """Maps (observation, action) to a model's inputs and (observation, next observation) to its targets.

    The way back from a target is in `dynamics/coordinates.py`.

    Inputs are ordered: the plain dimensions in the order of the observation, then sines, then cosines of the angles,
    then the action. Targets are the non-constant dimensions in the order of the observation. In both, the x
    and y of a vector in ``body_frame`` point forwards and to the left of the body, under the heading before the step.

    Args:
        observation_size: S.
        action_size: A.
        spec: how to read the observation; indices must lie in [0, S).

    Attributes:
        plain, angles: which numbers of an observation are fed as they are, and which as sine and cosine.
        predicted: which numbers have a target.
        input_size, target_size: D and T.
        carried: [S], 1 where the next observation is the present one and what is added to it, 0 where it is absolute.
        vectors: `ObservationSpec.body_frame` in columns.

    Raises:
        ValueError: an index is out of range or repeated, a vector's two numbers are not of one kind, or nothing is left
            to feed or to predict.
    """

    def __init__(self, observation_size: int, action_size: int, spec: ObservationSpec | None = None):
        spec = spec or ObservationSpec()
        _check_indices(observation_size, spec)
        _check_body_frame(observation_size, spec)
        fed = [i for i in range(observation_size) if i not in spec.not_inputs]
        self.observation_size, self.action_size, self.spec = observation_size, action_size, spec
        self.plain = [i for i in fed if i not in spec.angles]
        self.angles = [i for i in fed if i in spec.angles]
        self.predicted = [i for i in range(observation_size) if i not in spec.constant]
        if not self.predicted:
            raise ValueError(f"nothing is left to predict: all {observation_size} dimensions are constant, got {spec}")
        self.input_size = len(self.plain) + 2 * len(self.angles) + action_size
        self.target_size = len(self.predicted)
        if not self.input_size:
            raise ValueError(f"nothing is left to feed: there is no action, and not_inputs is everything, got {spec}")
        self.carried = torch.tensor(
            [float(i in spec.constant or i not in spec.absolute) for i in range(observation_size)],
            dtype=torch.float32,
            device="cpu",
        )
        is_change = [i not in spec.absolute for i in self.predicted]
        self._is_change = torch.tensor(is_change, dtype=torch.bool, device="cpu")
        wraps = [i in spec.angles and i not in spec.absolute for i in self.predicted]
        self._wraps = torch.tensor(wraps, dtype=torch.bool, device="cpu")
        self.vectors = VectorColumns.of(spec.body_frame)
        place = {index: column for column, index in enumerate(self.predicted)}
        moving = [(heading, place[x], place[y]) for heading, x, y in spec.body_frame if x in place]
        self._predicted_vectors = VectorColumns.of(moving)

    def inputs(self, observation: Float[Tensor, "*b S"], action: Float[Tensor, "*b A"]) -> Float[Tensor, "*b D"]:
        """The model's input, size D = plain dimensions + 2 x angles + A."""
        columns = [self.vectors.turned(observation, observation, -1.0)[..., self.plain]]
        if self.angles:
            angle = observation[..., self.angles]
            columns += [angle.sin(), angle.cos()]
        return torch.cat([*columns, action], dim=-1)

    def input_names(self, observation: Sequence[str], action: Sequence[str]) -> list[str]:
        """What each of the D inputs is, by the names of the S numbers of an observation and the A of an action."""
        angles = [observation[i] for i in self.angles]
        plain = [observation[i] for i in self.plain]
        return [*plain, *(f"sin {name}" for name in angles), *(f"cos {name}" for name in angles), *action]

    def targets(
        self, observation: Float[Tensor, "*b S"], next_observation: Float[Tensor, "*b S"]
    ) -> Float[Tensor, "*b T"]:
        """What the model predicts: the change (for an angle, the smaller way round), or the value if absolute."""
        before, after = observation[..., self.predicted], next_observation[..., self.predicted]
        target = torch.where(self._is_change.to(after.device), after - before, after)
        if bool(self._wraps.any()):
            turn = 2 * math.pi
            target = torch.where(self._wraps.to(after.device), target - turn * torch.round(target / turn), target)
        return self._predicted_vectors.turned(target, observation, -1.0)

    def target_magnitudes(
        self, observation: Float[Tensor, "N S"], next_observation: Float[Tensor, "N S"]
    ) -> Float[Tensor, "T"]:
        """The largest number that each target was computed from: it says how much of a target may be rounding."""
        before, after = (states[:, self.predicted].abs().amax(0) for states in (observation, next_observation))
        largest = torch.where(self._is_change.to(after.device), torch.maximum(before, after), after)
        x, y = self._predicted_vectors.x, self._predicted_vectors.y
        largest[x] = largest[y] = torch.maximum(largest[x], largest[y])
        return largest


def _check_indices(observation_size: int, spec: ObservationSpec) -> None:
    for name in ("angles", "absolute", "not_inputs", "constant"):
        indices = getattr(spec, name)
        bad = [i for i in indices if not 0 <= i < observation_size]
        if bad or len(set(indices)) != len(indices):
            raise ValueError(
                f"ObservationSpec.{name} must hold distinct indices from 0 to {observation_size - 1} "
                f"(the observation has {observation_size} numbers), received {indices}"
            )


def _check_body_frame(observation_size: int, spec: ObservationSpec) -> None:
    what = "ObservationSpec.body_frame must hold triples (heading, x, y) of"
    for frame in spec.body_frame:
        if len(frame) != 3 or len(set(frame)) != 3 or not all(0 <= i < observation_size for i in frame):
            raise ValueError(f"{what} distinct indices from 0 to {observation_size - 1}, received {frame}")
    headings = {heading for heading, _, _ in spec.body_frame}
    components = [i for _, *vector in spec.body_frame for i in vector]
    if len(set(components)) != len(components) or headings.intersection(components):
        raise ValueError(
            f"{what} vectors that share no index with each other or with a heading, received {spec.body_frame}"
        )
    for _, x, y in spec.body_frame:
        for name in ("absolute", "not_inputs", "constant"):
            if (x in getattr(spec, name)) != (y in getattr(spec, name)):
                raise ValueError(
                    f"ObservationSpec.{name} must hold both or neither of {x} and {y}, a vector of body_frame, "
                    f"received {getattr(spec, name)}"
                )
        if x in spec.angles or y in spec.angles:
            raise ValueError(
                f"ObservationSpec.angles must not hold {x} or {y}, a vector of body_frame, received {spec.angles}"
            )
