"""The draw `AMM`: a candidate's belief is a Gaussian, moved through the Gaussian process by its exact moments.

The propagation of PILCO (Deisenroth and Rasmussen 2011), with full covariances, and with the sines and cosines of
angles matched exactly too. Between two steps the particles of a candidate stand for its Gaussian: they are placed so
that their mean and their (population) covariance are exactly its own, and the next step reads those off again. So a
`TransitionSampler` needs no memory, and the reward is averaged over points spread like the belief. With a planner
that climbs by gradients this is GP-MPC (Kamthe and Deisenroth 2018, "Data-Efficient Reinforcement Learning with
Probabilistic Model Predictive Control").
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import refuse_if_asked
from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.noise import ObservationNoise
from gym_dgpmpc.gp.linalg import cholesky
from gym_dgpmpc.gp.moments import Predictor, predicted_moments

ROOT_JITTER = 1e-12
"""Of a variance: what rounding leaves of correlations that are one."""


class Encoded(NamedTuple):
    """Moments of the encoded inputs x of a Gaussian state s and action a."""

    mean: Float[Tensor, "K D"]
    covariance: Float[Tensor, "K D D"]
    cross: Float[Tensor, "K S D"]  # Cov[s, x]


def encoded_moments(encoder: Encoder, mean: Float[Tensor, "K n"], covariance: Float[Tensor, "K n n"]) -> Encoded:
    """Exact moments of the plain dimensions, the sines and cosines of angles, and the action, in the encoder's order.

    Mean and covariance are those of (s, a) together, n = S + A; an action that is known does not vary.

    For theta ~ N(m, v): E[sin theta] = exp(-v/2) sin m, E[cos theta] = exp(-v/2) cos m, products by the addition
    theorems, and by Stein's lemma Cov[s, sin theta] = Cov[s, theta] E[cos theta] (for the cosine: -E[sin theta]).
    """
    plain, angles, num_states = encoder.plain, encoder.angles, encoder.observation_size
    centre, own = mean[:, angles], covariance[:, angles][:, :, angles]
    spread = own.diagonal(dim1=-2, dim2=-1)
    damping = torch.exp(-0.5 * spread)
    sine, cosine = damping * centre.sin(), damping * centre.cos()

    # E[exp(i (a - b))] and E[exp(i (a + b))] give the second moments of sines and cosines.
    together = -0.5 * (spread.unsqueeze(-1) + spread.unsqueeze(-2))
    apart, joined = torch.exp(together + own), torch.exp(together - own)
    minus, plus = centre.unsqueeze(-1) - centre.unsqueeze(-2), centre.unsqueeze(-1) + centre.unsqueeze(-2)
    cos_minus, cos_plus = apart * minus.cos(), joined * plus.cos()
    sin_minus, sin_plus = apart * minus.sin(), joined * plus.sin()
    mixed = 0.5 * (sin_plus + sin_minus)  # E[sin a cos b]
    second = torch.cat(
        [
            torch.cat([0.5 * (cos_minus - cos_plus), mixed], -1),
            torch.cat([mixed.mT, 0.5 * (cos_minus + cos_plus)], -1),
        ],
        -2,
    )
    waves = torch.cat([sine, cosine], -1)
    to_angles = covariance[:, :, angles]
    cross_waves = torch.cat([to_angles * cosine.unsqueeze(1), -to_angles * sine.unsqueeze(1)], -1)

    cross = torch.cat([covariance[:, :, plain], cross_waves, covariance[:, :, num_states:]], -1)
    size, first, last = encoder.input_size, len(plain), len(plain) + waves.shape[1]
    joint = mean.new_zeros(len(mean), size, size)
    for place, of in ((slice(first), plain), (slice(last, size), slice(num_states, None))):
        joint[:, place] = cross[:, of]
        joint[:, :, place] = cross[:, of].mT
    joint[:, first:last, first:last] = second - waves.unsqueeze(-1) * waves.unsqueeze(-2)
    return Encoded(torch.cat([mean[:, plain], waves, mean[:, num_states:]], -1), joint, cross[:, :num_states])


class MomentMatchingSampler:
    """Moves each candidate's Gaussian one step, and spreads the particles by it.

    Actions that differ between the particles are Gaussian together with the state, as the particles say.
    A candidate with a particle or an action that is not finite is NaN after the step, and affects no other.

    Args:
        predictor: the trained functions, from standardised inputs to standardised targets.
        encoder: what is fed and predicted.
        inputs, targets: standardisation of both.
        noise_variance: added to the (standardised) targets' variance.
        num_particles: P, at least S + 1: fewer points cannot have a covariance of full rank.
        generator: for the directions in which the particles are spread, drawn once.
        blur: the noise that states are observed with, if any. The particles' covariance is then that of what is
            observed, from which the noise's is taken off before a step; at the first step, where nothing is spread yet,
            it is added.

    It has gradients but for those through a blur, and refuses these (`NotDifferentiableError`).

    Raises:
        ValueError: there are too few particles.
    """

    def __init__(
        self,
        predictor: Predictor,
        encoder: Encoder,
        inputs: Normaliser,
        targets: Normaliser,
        noise_variance: Float[Tensor, "T"],
        num_particles: int,
        generator: torch.Generator,
        blur: ObservationNoise | None = None,
    ):
        size = encoder.observation_size
        if num_particles <= size:
            raise ValueError(
                f"the draw AMM needs at least {size + 1} particles for an observation of {size} numbers, received "
                f"{num_particles}"
            )
        self._predictor, self._encoder, self._inputs, self._targets = predictor, encoder, inputs, targets
        self._noise = noise_variance
        self._frame = orthonormal_frame(num_particles, size, generator).to(inputs.mean)
        self._blur = blur
        self._carried = encoder.carried.to(inputs.mean)

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        if self._blur is not None:
            refuse_if_asked(self, observation, action)  # factors of equal eigenvalues have no derivative
        # Factorisations are batched over the candidates, and fail for all if one of them is not finite.
        actions = action.expand(len(observation), -1, -1)
        points = torch.cat([part.to(self._frame.dtype) for part in (observation, actions)], -1)
        lost = ~points.isfinite().all(-1).all(0).unsqueeze(-1)
        points = points.masked_fill(lost, 0.0)
        mean = points.mean(0)
        deviation = (points - mean).transpose(0, 1)
        covariance = deviation.mT @ deviation / len(points)
        if self._blur is not None:
            mean, covariance = self._fed(self._blur, mean, covariance, is_start=step == 0)
        mean, covariance = self.propagate(mean, covariance)
        if self._blur is not None:
            covariance = covariance + torch.diag(self._blur.std.square())
        spread = torch.einsum("ps,kts->pkt", self._frame, root_of(covariance))
        return (mean + spread).masked_fill(lost, math.nan).to(observation.dtype)

    def _fed(
        self, blur: ObservationNoise, mean: Float[Tensor, "K n"], covariance: Float[Tensor, "K n n"], *, is_start: bool
    ) -> tuple[Float[Tensor, "K n"], Float[Tensor, "K n n"]]:
        """Moments of what the model is fed, and of the action, from those of what is observed, and of the action.

        An action that was decided by what is observed, o = x + e, depends on x by Cov[x, o] Cov[o, o]^-1 Cov[o, a].
        """
        size, mean, covariance = self._encoder.observation_size, mean.clone(), covariance.clone()
        own, across = covariance[:, :size, :size], covariance[:, :size, size:]
        if is_start:
            covariance[:, :size, :size] += torch.diag(blur.start_std.square())
            return mean, covariance
        stretch, state = 1.0 + blur.stretch, _without(own, torch.diag(blur.std.square()))
        across = stretch.unsqueeze(-1) * (state @ torch.linalg.pinv(own, hermitian=True) @ across)
        mean[:, :size] = blur.fed(mean[:, :size])
        covariance[:, :size, :size] = state * stretch.unsqueeze(-1) * stretch
        covariance[:, :size, size:], covariance[:, size:, :size] = across, across.mT
        return mean, covariance

    def propagate(
        self, mean: Float[Tensor, "K n"], covariance: Float[Tensor, "K n n"]
    ) -> tuple[Float[Tensor, "K S"], Float[Tensor, "K S S"]]:
        """Mean and covariance of the next state: of c s + E f, with c the dimensions that f only changes.

        Given are those of (s, a) together, n = S + A.
        """
        encoded = encoded_moments(self._encoder, mean, covariance)
        size = self._encoder.observation_size
        mean, covariance = mean[:, :size], covariance[:, :size, :size]
        scale, predicted = self._inputs.std, self._encoder.predicted
        output = predicted_moments(
            self._predictor, self._inputs(encoded.mean), encoded.covariance / (scale.unsqueeze(-1) * scale)
        )
        cross = (encoded.cross / scale) @ output.gain * self._targets.std  # Cov[s, f], "K S T"
        spread = self._targets.std.unsqueeze(-1) * self._targets.std
        change = spread * (output.covariance + torch.diag(self._noise))

        next_mean, next_covariance = self._carried * mean, covariance * self._carried.unsqueeze(-1) * self._carried
        next_mean[:, predicted] += self._targets.inverse(output.mean)
        across = torch.zeros_like(covariance)
        across[:, :, predicted] = self._carried.unsqueeze(-1) * cross
        next_covariance = next_covariance + across + across.mT
        rows = torch.tensor(predicted, dtype=torch.int64, device=mean.device)
        next_covariance[:, rows.unsqueeze(-1), rows] += change
        return next_mean, 0.5 * (next_covariance + next_covariance.mT)


def root_of(covariance: Float[Tensor, "K S S"]) -> Float[Tensor, "K S S"]:
    """Lower factors of positive semi-definite matrices, differentiable; rows of zeros where nothing varies.

    The correlations are factorised, so that what varies little keeps its digits beside what varies much.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    varies = variance > 0
    std = torch.where(varies, variance, 1.0).sqrt()
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    correlation = covariance / (std.unsqueeze(-1) * std.unsqueeze(-2))
    correlation = torch.where(varies.unsqueeze(-1) & varies.unsqueeze(-2), correlation, eye)
    return cholesky(correlation, jitter=ROOT_JITTER) * torch.where(varies, std, 0.0).unsqueeze(-1)


def _without(covariance: Float[Tensor, "K S S"], part: Float[Tensor, "S S"]) -> Float[Tensor, "K S S"]:
    """The difference of two covariances, without the negative values that rounding leaves of zero."""
    values, vectors = torch.linalg.eigh(covariance - part)
    return (vectors * values.clamp_min(0.0).unsqueeze(-2)) @ vectors.mT


def orthonormal_frame(num_particles: int, size: int, generator: torch.Generator) -> Float[Tensor, "P S"]:
    """P points with mean zero and population covariance I exactly, in directions drawn uniformly; P > S."""
    normals = torch.randn(num_particles, size, generator=generator, dtype=torch.float64, device=generator.device)
    columns = torch.cat([torch.ones_like(normals[:, :1]), normals], 1)
    basis, _ = torch.linalg.qr(columns)
    return num_particles**0.5 * basis[:, 1:]
