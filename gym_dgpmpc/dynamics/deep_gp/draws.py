"""Draws of a trained deep Gaussian process: the transition samplers that a plan is made through.

`DeepGPDynamics.draw` makes one of these per plan. All three draw from the posterior given one sample of the inducing
outputs per particle; they differ in what they keep of the covariance:

    joint      all candidate sequences of a step jointly, fresh noise at each step (the paper's scheme, exactly);
    marginal   each candidate and step on its own;
    pathwise   whole functions, by Matheron's rule: joint across candidates, and also over the steps of a plan if a
               particle keeps its function ("plan") or not ("step", equal in law to `joint` up to F^-1/2).
"""

import math
from functools import cached_property
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import is_asked
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.deep_gp.compiled_rollout import CompiledRollout, PathwiseLayer
from gym_dgpmpc.dynamics.deep_gp.derivatives import Derivatives, Step, Trajectories
from gym_dgpmpc.dynamics.gaussian_draws import root
from gym_dgpmpc.dynamics.noise import ObservationNoise, PathNoise
from gym_dgpmpc.gp.deep_gp import Factorised
from gym_dgpmpc.gp.features import draw_features
from gym_dgpmpc.gp.layer import Layer, conditional, joint_conditional
from gym_dgpmpc.gp.linalg import JITTER, cholesky

Draw = Literal["pathwise", "joint", "marginal"]
Refresh = Literal["step", "plan"]
DRAWS: tuple[Draw, ...] = get_args(Draw)
REFRESHES: tuple[Refresh, ...] = get_args(Refresh)


Noise = tuple[Float[Tensor, "P T"], ObservationNoise | None]
"""The standard deviation of the process noise, in standardised targets, and the observation noise, if any."""


class Posterior(NamedTuple):
    """What a draw is made from: for each particle the hyperparameters of its chain, factors L_z, a whitened sample."""

    factorised: Factorised  # of P models
    whitened: list[Float[Tensor, "P M O"]]


class ConditionalSampler:
    """The draws `joint` and `marginal`: values from p(f | u) at each step, with fresh noise.

    Factorises in the posterior's precision (float64) whatever the precision of the states. ``noise_std`` is that of the
    process noise, in standardised targets, if it is to be drawn. A point that is not finite
    is NaN after the step, and no other point feels it.
    """

    def __init__(
        self,
        posterior: Posterior,
        coordinates: Coordinates,
        generator: torch.Generator,
        *,
        joint: bool,
        noise_std: Float[Tensor, "P T"] | None = None,
    ):
        self._posterior, self._coordinates, self._generator, self._joint = posterior, coordinates, generator, joint
        self._noise_std = noise_std

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        (model, factors), whitened = self._posterior
        x = self._coordinates.encode(observation, action).to(factors[0].dtype)
        # Jointly drawn points share a covariance, which a single point that is not finite would spoil for all.
        lost = ~x.isfinite().all(-1, keepdim=True)
        x = x.masked_fill(lost, 0.0)
        last = len(factors) - 1
        for index, (layer, factor, v) in enumerate(zip(model.layers, factors, whitened, strict=True)):
            value = self._sample_layer(layer, factor, v, x)
            x = value if index == last else x + value
        if self._noise_std is not None:
            x = x + self._noise_std.unsqueeze(1) * torch.randn(
                x.shape, generator=self._generator, dtype=x.dtype, device=x.device
            )
        return self._coordinates.decode(observation, x).masked_fill(lost, math.nan)

    def _sample_layer(self, layer: Layer, factor: Tensor, v: Tensor, x: Tensor) -> Tensor:
        shape = (*x.shape[:-1], v.shape[-1])
        noise = torch.randn(shape, generator=self._generator, dtype=x.dtype, device=x.device)
        if not self._joint:
            mean, variance = conditional(layer, factor, v, x)
            return mean + root(variance).unsqueeze(-1) * noise
        mean, covariance = joint_conditional(layer, factor, v, x)
        return mean + cholesky(covariance, layer.variance[:, None, None]) @ noise


def _draw_layer(
    layer: Layer,
    factor: Tensor,
    whitened: Tensor,
    num_functions: int,
    num_features: int,
    dtype: torch.dtype,
    generator: torch.Generator,
) -> PathwiseLayer:
    """Draw ``num_functions`` functions per particle from p(f | u), by Matheron's rule.

    f(x) = phi(x) . w + k(x, Z) alpha with alpha = L_z^-T (v - L_z^-1 (phi(Z) w + sqrt(jitter) e)), w, e ~ N(0, I)
    (Wilson et al. 2020, eq. 13). The features of a linear part are x times its slopes' standard deviations, exactly.
    The term e makes the law exact for the jittered K_zz. Every particle has features of its own, so that over the
    particles of one plan the law is right, and not only over plans; its functions share them, so all alpha of many
    functions are one product of their normals (w, e) with K_zz^-1 (phi(Z), sqrt(jitter) I); for few, two solves with a
    column for each output cost less.
    """
    num_particles, num_inducing, outputs = whitened.shape
    lengthscale = layer.lengthscale.unsqueeze(-2)
    scaled = layer.inducing_inputs / lengthscale
    features = draw_features(layer.kernel, num_particles, num_features, scaled.shape[-1], generator, scaled.dtype)
    columns = num_functions * outputs
    # Normals are drawn in single precision, which is six times faster and ample for random numbers.
    values, root = features(scaled), None
    if layer.log_slope is not None:
        root = layer.log_slope.exp()
        values = torch.cat([values, scaled * root.unsqueeze(-2)], dim=2)
    shape = (num_particles, values.shape[-1] + num_inducing, columns)
    normals = torch.randn(shape, generator=generator, dtype=torch.float32, device=scaled.device)
    variance = layer.variance[:, None, None]
    sigma = variance.sqrt()
    drawn, rest = normals.to(scaled.dtype), whitened.repeat(1, 1, num_functions)
    if columns < normals.shape[1]:
        prior = sigma * torch.baddbmm(drawn[:, -num_inducing:], values, drawn[:, :-num_inducing], beta=JITTER**0.5)
        rest -= torch.linalg.solve_triangular(factor, prior, upper=False)
        alpha = torch.linalg.solve_triangular(factor.mT, rest, upper=True)
    else:
        eye = torch.eye(num_inducing, dtype=values.dtype, device=values.device).expand(num_particles, -1, -1)
        shared = torch.cholesky_solve(sigma * torch.cat([values, JITTER**0.5 * eye], dim=2), factor)
        known = torch.linalg.solve_triangular(factor.mT, whitened, upper=True)
        alpha = known.repeat(1, 1, num_functions) - shared @ drawn

    def per_function(matrix: Float[Tensor, "P n columns"]) -> Float[Tensor, "T P O n"]:
        return matrix.to(dtype).mT.unflatten(1, (num_functions, outputs)).transpose(0, 1).contiguous()

    linear_out = None
    if root is not None:
        along = root.square().unsqueeze(-1) * (scaled.mT @ alpha)
        own = root.unsqueeze(-1) * drawn[:, num_features:-num_inducing]
        linear_out = per_function(variance * along + sigma * own)
    scale = layer.kernel.argument_scale
    return PathwiseLayer(
        layer.kernel,
        (1.0 / layer.lengthscale).to(dtype),
        (-2.0 * scale * scaled.mT).to(dtype).contiguous(),
        (scale * scaled.square().sum(-1)).to(dtype),
        (features.frequency.mT / (2 * math.pi)).to(dtype).contiguous(),
        per_function(variance * alpha),
        per_function(sigma * (2.0 / num_features) ** 0.5 * normals[:, :num_features]),
        linear_out,
    )


class PathwiseSampler:
    """The draw `pathwise`: P functions (or P per step), evaluated with matrix products and elementwise maps only.

    Steps and trajectories are differentiable; the values are the same whether or not a gradient is recorded.

    Args:
        posterior: one whitened sample per particle.
        coordinates: raw states to standardised coordinates and back.
        horizon: number of functions per particle with ``refresh="step"``.
        num_features: F.
        refresh: "step" or "plan".
        dtype: precision of the rollout; the functions themselves are solved for in the posterior's precision.
        generator: of the posterior's device.
        noise: what to draw of it, if any.

    Attributes:
        noise: what was drawn of it.
    """

    def __init__(
        self,
        posterior: Posterior,
        coordinates: Coordinates,
        horizon: int,
        num_features: int,
        refresh: Refresh,
        dtype: torch.dtype,
        generator: torch.Generator,
        noise: Noise | None = None,
    ):
        (model, factors), whitened = posterior
        num_functions = horizon if refresh == "step" else 1
        self.coordinates, self._by_step = coordinates, refresh == "step"
        self.layers = [
            _draw_layer(layer, factor, v, num_functions, num_features, dtype, generator)
            for layer, factor, v in zip(model.layers, factors, whitened, strict=True)
        ]
        self.noise: PathNoise | None = None
        if noise is not None:
            self.noise = PathNoise.draw(*noise, horizon, len(whitened[0]), dtype, generator)
        self._derivatives = Derivatives(self.layers, coordinates, self.noise, by_step=self._by_step)
        self._buffers: _Buffers | None = None

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        if not is_asked(observation, action):
            return self._step(observation, action, step)
        return Step.apply(self._step, self._derivatives, observation, action, step)

    def trajectories(
        self, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        """The states of every particle under every candidate; what repeated calls give, up to rounding."""
        if not is_asked(observation, actions):
            return self._states(observation, actions)
        return Trajectories.apply(self._states, self._derivatives, observation, actions)

    def _states(
        self, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        num_particles = self.layers[0].kernel_out.shape[1]
        states = observation.new_empty(actions.shape[1] + 1, num_particles, len(actions), len(observation))
        states[0] = observation
        for step, action in enumerate(actions.to(observation).transpose(0, 1).contiguous()):
            states[step + 1] = self._step(states[step], action, step)
        return states

    def _step(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        if self.noise is not None:
            observation = self.noise.fed(observation, step)
        x = self.coordinates.encode(observation, action)
        if self._buffers is None or self._buffers.augmented.shape[:2] != x.shape[:2]:
            self._buffers = _Buffers.allocate(x, self.layers[0])
        function = step if self._by_step else 0
        for layer, weights in zip(self.layers[:-1], self._in_weights, strict=False):
            x = x + self._evaluate(layer, weights, x, function, self._buffers)
        target = self._evaluate(self.layers[-1], self._in_weights[-1], x, function, self._buffers)
        if self.noise is not None:
            target = target + self.noise.process[step].unsqueeze(1)
        after = self.coordinates.decode(observation, target)
        return after if self.noise is None else self.noise.observed(after, step)

    @cached_property
    def _in_weights(self) -> list[tuple[Tensor, Tensor]]:
        """Each layer's maps from (x, |x|^2, 1) to the kernel's argument "P D+2 M", and from x to angles "P D F/2"."""
        weights = []
        for layer in self.layers:
            square = torch.full_like(layer.offsets, layer.kernel.argument_scale)
            distance = torch.cat([layer.centres, torch.stack([square, layer.offsets], dim=1)], dim=1)
            weights.append((distance, 2 * math.pi * layer.frequencies))
        return weights

    def _evaluate(
        self, layer: PathwiseLayer, weights: tuple[Tensor, Tensor], x: Tensor, function: int, buffers: "_Buffers"
    ) -> Tensor:
        """f(x) - m(x) "P K O" of every particle's function."""
        augmented, correlations, decay, angles, waves = buffers
        size, group, half = x.shape[-1], correlations.shape[0], angles.shape[-1]
        scaled = augmented[..., :size]
        torch.mul(x, layer.inverse_lengthscale.unsqueeze(1), out=scaled)
        torch.linalg.vecdot(scaled, scaled, out=augmented[..., size])
        kernel_out, feature_out = layer.kernel_out[function].mT, layer.feature_out[function].mT
        out = x.new_empty(*x.shape[:2], kernel_out.shape[-1])
        for first in range(0, len(x), group):
            own = slice(first, first + group)
            torch.bmm(augmented[own], weights[0][own], out=correlations)
            torch.bmm(scaled[own], weights[1][own], out=angles)
            layer.kernel.correlation_(correlations, decay)
            torch.cos(angles, out=waves[..., :half])
            torch.sin(angles, out=waves[..., half:])
            torch.bmm(waves, feature_out[own], out=out[own])
            out[own].baddbmm_(correlations, kernel_out[own])
        if layer.linear_out is not None:
            out.baddbmm_(scaled, layer.linear_out[function].mT)
        return out


class CompiledPathwiseSampler(PathwiseSampler):
    """A `PathwiseSampler` whose trajectories are those of compiled code; float32 on the CPU.

    Raises:
        RuntimeError: this machine has no compiled code; see `compiled_rollout.is_available`.
    """

    def __init__(
        self,
        posterior: Posterior,
        coordinates: Coordinates,
        horizon: int,
        num_features: int,
        refresh: Refresh,
        generator: torch.Generator,
        noise: Noise | None = None,
    ):
        super().__init__(posterior, coordinates, horizon, num_features, refresh, torch.float32, generator, noise)
        self._rollout = CompiledRollout(self.layers, coordinates, self.noise)

    def _states(
        self, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        if observation.dtype == torch.float64 and self.coordinates.encoder.spec.body_frame:
            return super()._states(observation, actions)  # a vector far from zero cannot be turned in float32
        return self._rollout(observation, actions)


class _Buffers(NamedTuple):
    """Scratch of a rollout step, allocated once per sampler."""

    augmented: Float[Tensor, "P K D+2"]  # (x, |x|^2, 1)
    correlations: Float[Tensor, "G K M"]
    decay: Float[Tensor, "G K M"]
    angles: Float[Tensor, "G K half_F"]
    waves: Float[Tensor, "G K F"]

    @classmethod
    def allocate(cls, x: Float[Tensor, "P K D"], layer: PathwiseLayer) -> "_Buffers":
        """Room for G particles at a time: one on a CPU, so that its values stay in the cache; all on a GPU."""
        num_particles, num_points, size = x.shape
        group = 1 if x.device.type == "cpu" else num_particles
        num_inducing, half = layer.offsets.shape[1], layer.frequencies.shape[-1]
        return cls(
            x.new_ones(num_particles, num_points, size + 2),
            x.new_empty(group, num_points, num_inducing),
            x.new_empty(group, num_points, num_inducing),
            x.new_empty(group, num_points, half),
            x.new_empty(group, num_points, 2 * half),
        )
