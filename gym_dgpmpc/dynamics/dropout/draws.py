"""A draw of a network with dropout: each particle has masks, and so a function, of its own for the whole plan."""

from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import grad_if_asked
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.dropout.network import DropoutNetwork, Kept, predict
from gym_dgpmpc.dynamics.noise import PathNoise


class DropoutSampler:
    """P functions, with a sequence of noise each, the same for all candidates.

    Args:
        network: in the rollout's precision.
        kept: one mask per particle, "P 1 U" for each hidden layer.
        coordinates: raw states to standardised coordinates and back.
        noise: along the plan.
    """

    def __init__(self, network: DropoutNetwork, kept: Kept, coordinates: Coordinates, noise: PathNoise):
        self._network, self._kept, self._coordinates, self._noise = network, kept, coordinates, noise

    @grad_if_asked
    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        observation = self._noise.fed(observation, step)
        target = predict(self._network, self._kept, self._coordinates.encode(observation, action))
        after = self._coordinates.decode(observation, target + self._noise.process[step].unsqueeze(1))
        return self._noise.observed(after, step)
