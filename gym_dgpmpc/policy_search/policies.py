"""Policies of few parameters, linear or of radial basis functions, squashed into the action's bounds.

Deisenroth and Rasmussen (2011), "PILCO: A Model-Based and Data-Efficient Approach to Policy Search", section 3.1; the
second squashing is that of their later papers. They are fed what the dynamics model reads: angles as sine and cosine.
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.dynamics.sparse_gp.moment_matching import encoded_moments
from gym_dgpmpc.gp.moments import Predictor, predicted_moments
from gym_dgpmpc.imagination.features import encoding
from gym_dgpmpc.types import ObservationSpec

PolicyForm = Literal["rbf", "linear"]
SquashName = Literal["tanh", "sine"]

ROOM = 2.0
"""The unit of a number that is no angle, in standard deviations of the first data: a task goes beyond these."""


class ActionMoments(NamedTuple):
    """Moments of the actions that a policy takes at Gaussian states."""

    mean: Float[Tensor, "K A"]
    covariance: Float[Tensor, "K A A"]
    cross: Float[Tensor, "K S A"]  # Cov[state, action]


class Fed(NamedTuple):
    """What of an observation a policy is fed, and in what units.

    Attributes:
        encoder: of observations without actions.
        mean, std: of the features.
    """

    encoder: Encoder
    mean: Float[Tensor, " F"]
    std: Float[Tensor, " F"]

    @classmethod
    def of(cls, store: TransitionStore, spec: ObservationSpec, size: int) -> "Fed":
        """What `imagination.features.encoding` feeds, in wider units; sines and cosines as they are.

        Args:
            store: of at least one transition.
            spec: how to read an observation.
            size: numbers of a state, of which an observation's are the first; the others are not fed.
        """
        fed = encoding(store, spec)["features_extractor_kwargs"]
        plain, angles = fed["plain"], fed["angles"]
        unfed = tuple(index for index in range(size) if index not in (*plain, *angles))
        encoder = Encoder(size, 0, ObservationSpec(angles=tuple(angles), not_inputs=unfed))
        mean, std = (torch.tensor(fed[name], dtype=torch.float32, device="cpu") for name in ("mean", "std"))
        std *= ROOM
        mean[len(plain) :], std[len(plain) :] = 0.0, 1.0
        return cls(encoder, mean, std)


def sine_squashed(u: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """(9 sin u + sin 3u) / 8, in [-1, 1], flat to third order at its maximum."""
    return (9.0 * u.sin() + (3.0 * u).sin()) / 8.0


class SquashedPolicy(torch.nn.Module):
    """From observations to actions in [-1, 1]; what is squashed is that of a subclass.

    Args:
        fed: what of an observation is fed.
        action_size: A.
        squash: "tanh", or "sine", (9 sin u + sin 3u) / 8, whose moments are known.

    Attributes:
        num_centres: basis functions, C; zero of a linear policy.
    """

    num_centres = 0

    def __init__(self, fed: Fed, action_size: int, squash: SquashName):
        super().__init__()
        self.encoder, self.action_size, self.squash = fed.encoder, action_size, squash
        self.register_buffer("mean", fed.mean)
        self.register_buffer("std", fed.std)

    def unsquashed(self, x: Float[Tensor, "n F"], keep: Float[Tensor, "n C"] | None = None) -> Float[Tensor, "n A"]:
        """From features to what is squashed; ``keep`` is what each basis function is multiplied by."""
        raise NotImplementedError

    def unsquashed_moments(self, mean: Float[Tensor, "K F"], covariance: Float[Tensor, "K F F"]) -> ActionMoments:
        """Moments of `unsquashed` at Gaussian features x; in the place of the cross-covariance V, "K F A"."""
        raise NotImplementedError

    def forward(self, observation: Float[Tensor, "n S"], keep: Float[Tensor, "n C"] | None = None) -> Tensor:
        """Actions in [-1, 1], [n, A]."""
        x = (self.encoder.inputs(observation, observation[..., :0]) - self.get_buffer("mean")) / self.get_buffer("std")
        u = self.unsquashed(x, keep)
        return u.tanh() if self.squash == "tanh" else sine_squashed(u)

    def moments(self, mean: Float[Tensor, "K S"], covariance: Float[Tensor, "K S S"]) -> ActionMoments:
        """Moments of the actions in [-1, 1] at Gaussian states: each stage exact for a Gaussian input.

        By Stein's lemma, as PILCO has it, Cov[s, u] = Cov[s, x] V with Cov[x, u] = Cov[x, x] V, for x the features; and
        likewise through the squashing, whose sines are encoded as those of angles are.

        Raises:
            ValueError: the squashing is "tanh", whose moments have no closed form.
        """
        if self.squash != "sine":
            raise ValueError(f'the moments of a policy squashed by {self.squash!r} are not known: take "sine"')
        encoded = encoded_moments(self.encoder, mean, covariance)
        scale = self.get_buffer("std")
        centred = (encoded.mean - self.get_buffer("mean")) / scale
        u = self.unsquashed_moments(centred, encoded.covariance / (scale.unsqueeze(-1) * scale))
        to_state = (encoded.cross / scale) @ u.cross
        return self._squashed(u, mean, covariance, to_state)

    def _squashed(self, u: ActionMoments, mean: Tensor, covariance: Tensor, to_state: Tensor) -> ActionMoments:
        """Moments of the squashed values: (s, u, 3u) as one Gaussian whose last numbers are angles."""
        size, count = mean.shape[1], self.action_size
        joint_mean = torch.cat([mean, u.mean, 3.0 * u.mean], 1)
        rows = [
            torch.cat([covariance, to_state, 3.0 * to_state], 2),
            torch.cat([to_state.mT, u.covariance, 3.0 * u.covariance], 2),
            torch.cat([3.0 * to_state.mT, 3.0 * u.covariance, 9.0 * u.covariance], 2),
        ]
        angles = ObservationSpec(angles=tuple(range(size, size + 2 * count)))
        waves = encoded_moments(Encoder(size + 2 * count, 0, angles), joint_mean, torch.cat(rows, 1))
        eye = torch.eye(count, dtype=mean.dtype, device=mean.device)
        out = torch.cat([mean.new_zeros(size, count), 1.125 * eye, 0.125 * eye, mean.new_zeros(2 * count, count)])
        return ActionMoments(waves.mean @ out, out.mT @ waves.covariance @ out, (waves.cross @ out)[:, :size])


class LinearPolicy(SquashedPolicy):
    """u = W x + b, both zero at first.

    Args:
        fed, action_size, squash: see `SquashedPolicy`.
    """

    def __init__(self, fed: Fed, action_size: int, squash: SquashName):
        super().__init__(fed, action_size, squash)
        self.weight = torch.nn.Parameter(fed.mean.new_zeros(len(fed.mean), action_size))
        self.bias = torch.nn.Parameter(fed.mean.new_zeros(action_size))

    def unsquashed(self, x: Float[Tensor, "n F"], keep: Float[Tensor, "n C"] | None = None) -> Float[Tensor, "n A"]:
        return x @ self.weight + self.bias

    def unsquashed_moments(self, mean: Float[Tensor, "K F"], covariance: Float[Tensor, "K F F"]) -> ActionMoments:
        weight = self.weight
        gain = weight.expand(len(mean), -1, -1)
        return ActionMoments(mean @ weight + self.bias, weight.mT @ covariance @ weight, gain)


class RBFPolicy(SquashedPolicy):
    """u = sum_i w_i exp(-1/2 sum_d (x_d - c_id)^2 / l_d^2), of C basis functions with common lengthscales.

    Args:
        fed, action_size, squash: see `SquashedPolicy`.
        num_centres: C.
        generator: of the first centres, uniform in [-1, 1], and weights, uniform in [-1/2, 1/2].
    """

    def __init__(
        self,
        fed: Fed,
        action_size: int,
        squash: SquashName,
        num_centres: int,
        generator: torch.Generator,
    ):
        super().__init__(fed, action_size, squash)
        self.num_centres, size = num_centres, len(fed.mean)

        def uniform(*shape: int) -> Tensor:
            return 2.0 * torch.rand(shape, generator=generator, dtype=torch.float32, device=generator.device) - 1.0

        self.centres = torch.nn.Parameter(uniform(num_centres, size))
        self.weight = torch.nn.Parameter(0.5 * uniform(num_centres, action_size))
        self.log_lengthscale = torch.nn.Parameter(torch.zeros_like(self.centres[0]))

    def unsquashed(self, x: Float[Tensor, "n F"], keep: Float[Tensor, "n C"] | None = None) -> Float[Tensor, "n A"]:
        inverse = (-self.log_lengthscale).exp()
        x, centres = x * inverse, self.centres * inverse
        sqdist = x.square().sum(-1, keepdim=True) + centres.square().sum(-1) - 2.0 * x @ centres.mT
        basis = torch.exp(-0.5 * sqdist)
        return (basis if keep is None else basis * keep) @ self.weight

    def unsquashed_moments(self, mean: Float[Tensor, "K F"], covariance: Float[Tensor, "K F F"]) -> ActionMoments:
        count, outputs = self.weight.shape
        certain = self.weight.new_zeros(())  # a function that is known: a Gaussian process without variance
        nothing = self.weight.new_zeros(outputs, count, count)
        network = Predictor(self.centres, self.log_lengthscale.exp(), certain, self.weight, nothing)
        return ActionMoments(*predicted_moments(network, mean, covariance))
