"""Draws of a trained deep Gaussian process: the transition samplers that a plan is made through.

`DeepGPDynamics.draw` makes one of these per plan. All three draw from the posterior given one sample of the inducing
outputs per particle; they differ in what they keep of the covariance:

    joint      all candidate sequences of a step jointly, fresh noise at each step (the paper's scheme, exactly);
    marginal   each candidate and step on its own;
    pathwise   whole functions, by Matheron's rule: joint across candidates, and also over the steps of a plan if a
               particle keeps its function ("plan") or not ("step", equal in law to `joint` up to F^-1/2).
"""

from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.gp.features import Features, draw_features
from gym_dgpmpc.gp.kernels import Kernel, argument_scale, correlation_
from gym_dgpmpc.gp.layer import Layer, conditional, joint_conditional
from gym_dgpmpc.gp.linalg import JITTER, cholesky

Draw = Literal["pathwise", "joint", "marginal"]
Refresh = Literal["step", "plan"]
DRAWS: tuple[Draw, ...] = get_args(Draw)
REFRESHES: tuple[Refresh, ...] = get_args(Refresh)


class Posterior(NamedTuple):
    """What a draw is made from: hyperparameters, factors L_z, and one whitened sample per particle, per layer."""

    kernel: Kernel
    model: DeepGP
    factors: list[Float[Tensor, "M M"]]
    whitened: list[Float[Tensor, "P M O"]]


class ConditionalSampler:
    """The draws `joint` and `marginal`: values from p(f | u) at each step, with fresh noise.

    Factorises in the posterior's precision (float64) whatever the precision of the states.
    """

    def __init__(self, posterior: Posterior, coordinates: Coordinates, generator: torch.Generator, *, joint: bool):
        self._posterior, self._coordinates, self._generator, self._joint = posterior, coordinates, generator, joint

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        kernel, model, factors, whitened = self._posterior
        x = self._coordinates.encode(observation, action).to(factors[0].dtype)
        last = len(factors) - 1
        for index, (layer, factor, v) in enumerate(zip(model.layers, factors, whitened, strict=True)):
            value = self._sample_layer(kernel, layer, factor, v, x)
            x = value if index == last else x + value
        return self._coordinates.decode(observation, x.to(observation.dtype))

    def _sample_layer(self, kernel: Kernel, layer: Layer, factor: Tensor, v: Tensor, x: Tensor) -> Tensor:
        shape = (*x.shape[:-1], v.shape[-1])
        noise = torch.randn(shape, generator=self._generator, dtype=x.dtype, device=x.device)
        if not self._joint:
            mean, variance = conditional(kernel, layer, factor, v, x)
            return mean + variance.sqrt().unsqueeze(-1) * noise
        mean, covariance = joint_conditional(kernel, layer, factor, v, x)
        return mean + cholesky(covariance, layer.variance) @ noise


class _PathwiseLayer(NamedTuple):
    """One layer's functions, ready for a rollout: two matrices in, two out, in the rollout's precision."""

    inverse_lengthscale: Float[Tensor, "D"]
    distance_weights: Float[Tensor, "D+2 M"]  # from (x, |x|^2, 1) to the kernel's argument
    feature_weights: Float[Tensor, "D+2 F"]  # from (x, |x|^2, 1) to omega . x + b
    kernel_out: Float[Tensor, "T P M O"]  # sigma^2 alpha; T = H with refresh="step", else 1
    feature_out: Float[Tensor, "T P F O"]  # sigma sqrt(2 / F) w


def _draw_layer(
    kernel: Kernel,
    layer: Layer,
    factor: Tensor,
    whitened: Tensor,
    num_functions: int,
    num_features: int,
    dtype: torch.dtype,
    generator: torch.Generator,
) -> _PathwiseLayer:
    """Draw ``num_functions`` functions per particle from p(f | u), by Matheron's rule.

    f(x) = phi(x) . w + k(x, Z) alpha with alpha = L_z^-T (v - L_z^-1 (phi(Z) w + sqrt(jitter) e)), w, e ~ N(0, I)
    (Wilson et al. 2020, eq. 13). The term e makes the law exact for the jittered K_zz. All functions are
    right-hand sides of the same two triangular solves; frequencies, phases and phi(Z) are shared.
    """
    num_inducing, input_size = layer.inducing_inputs.shape
    num_particles, _, outputs = whitened.shape
    scaled = layer.inducing_inputs / layer.lengthscale
    features = draw_features(kernel, num_features, input_size, generator, dtype=scaled.dtype)
    columns = num_functions * num_particles * outputs
    normals = torch.randn(
        num_features + num_inducing, columns, generator=generator, dtype=scaled.dtype, device=scaled.device
    )
    w, e = normals.split([num_features, num_inducing])
    sigma = layer.variance.sqrt()
    prior = sigma * (features(scaled) @ w + JITTER**0.5 * e)
    v = whitened.movedim(0, 1).unsqueeze(1).expand(-1, num_functions, -1, -1).reshape(num_inducing, columns)
    residual = v - torch.linalg.solve_triangular(factor, prior, upper=False)
    alpha = torch.linalg.solve_triangular(factor.mT, residual, upper=True)

    def per_function(matrix: Tensor) -> Tensor:
        return matrix.unflatten(1, (num_functions, num_particles, outputs)).movedim(0, 2).contiguous().to(dtype)

    scale = argument_scale(kernel)
    ones = scaled.new_ones(1, num_inducing)
    distance = torch.cat([-2.0 * scaled.mT, ones, scaled.square().sum(-1).unsqueeze(0)]) * scale
    return _PathwiseLayer(
        (1.0 / layer.lengthscale).to(dtype),
        distance.to(dtype),
        _feature_weights(features).to(dtype),
        per_function(layer.variance * alpha),
        per_function(sigma * (2.0 / num_features) ** 0.5 * w),
    )


def _feature_weights(features: Features) -> Tensor:
    zeros = features.phase.new_zeros(1, features.phase.numel())
    return torch.cat([features.frequency.mT, zeros, features.phase.unsqueeze(0)])


class PathwiseSampler:
    """The draw `pathwise`: P functions (or P per step), evaluated with matrix products and elementwise maps only.

    Args:
        posterior: one whitened sample per particle.
        coordinates: raw states to standardised coordinates and back.
        horizon: number of functions per particle with ``refresh="step"``.
        num_features: F.
        refresh: "step" or "plan".
        dtype: precision of the rollout; the functions themselves are solved for in the posterior's precision.
        generator: of the posterior's device.
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
    ):
        kernel, model, factors, whitened = posterior
        num_functions = horizon if refresh == "step" else 1
        self._kernel, self._coordinates, self._by_step = kernel, coordinates, refresh == "step"
        self._layers = [
            _draw_layer(kernel, layer, factor, v, num_functions, num_features, dtype, generator)
            for layer, factor, v in zip(model.layers, factors, whitened, strict=True)
        ]
        self._buffers: _Buffers | None = None

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        x = self._coordinates.encode(observation, action)
        if self._buffers is None or self._buffers.augmented.shape[:2] != x.shape[:2]:
            self._buffers = _Buffers.allocate(x, self._layers[0])
        function = step if self._by_step else 0
        for layer in self._layers[:-1]:
            x = x + self._evaluate(layer, x, function, self._buffers)
        return self._coordinates.decode(observation, self._evaluate(self._layers[-1], x, function, self._buffers))

    def _evaluate(self, layer: _PathwiseLayer, x: Tensor, function: int, buffers: "_Buffers") -> Tensor:
        """f(x) - m(x) "P K O" of every particle's function."""
        augmented, correlations, decay, waves = buffers
        size, group = x.shape[-1], correlations.shape[0]
        scaled = augmented[..., :size]
        torch.mul(x, layer.inverse_lengthscale, out=scaled)
        torch.linalg.vecdot(scaled, scaled, out=augmented[..., size])
        kernel_out, feature_out = layer.kernel_out[function], layer.feature_out[function]
        out = x.new_empty(*x.shape[:2], kernel_out.shape[-1])
        for first in range(0, len(x), group):
            own = slice(first, first + group)
            points = augmented[own].flatten(0, 1)
            torch.mm(points, layer.distance_weights, out=correlations.view(len(points), -1))
            torch.mm(points, layer.feature_weights, out=waves.view(len(points), -1))
            correlation_(self._kernel, correlations, decay)
            torch.bmm(waves.cos_(), feature_out[own], out=out[own])
            out[own].baddbmm_(correlations, kernel_out[own])
        return out


class _Buffers(NamedTuple):
    """Scratch of a rollout step, allocated once per sampler."""

    augmented: Float[Tensor, "P K D+2"]  # (x, |x|^2, 1)
    correlations: Float[Tensor, "G K M"]
    decay: Float[Tensor, "G K M"]
    waves: Float[Tensor, "G K F"]

    @classmethod
    def allocate(cls, x: Float[Tensor, "P K D"], layer: _PathwiseLayer) -> "_Buffers":
        """Room for G particles at a time: one on a CPU, so that its values stay in the cache; all on a GPU."""
        num_particles, num_points, size = x.shape
        group = 1 if x.device.type == "cpu" else num_particles
        num_inducing, num_features = layer.distance_weights.shape[1], layer.feature_weights.shape[1]
        return cls(
            x.new_ones(num_particles, num_points, size + 2),
            x.new_empty(group, num_points, num_inducing),
            x.new_empty(group, num_points, num_inducing),
            x.new_empty(group, num_points, num_features),
        )
