"""Gradients of a pathwise draw in closed form: by actions and states, of one step or of whole rollouts.

The functions of a draw are sums of kernels and waves, so their slopes are matrix products of what their values are made
of. Once the states of a rollout are known the slopes at all its steps are independent of each other and are computed at
once, in a few large operations; what is left to do in turn is the adjoint recursion of the state's gradient,

    lambda_t = g_t + (ds_{t+1} / ds_t)^T lambda_{t+1},        dR / da_t = sum_p (ds_{t+1} / da_t)^T lambda_{t+1},

one product of small matrices a step, with g_t the gradient by s_t alone. The values may come from anywhere: from
PyTorch or from compiled code.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.deep_gp.compiled_rollout import PathwiseLayer
from gym_dgpmpc.dynamics.noise import PathNoise


class _Slopes:
    """Value and slopes of one layer's functions.

    With r^2 = |x - z|^2 and x over the lengthscales, and the waves' angles a = W x,

        df_o / dx = sum_m alpha_om k'(r_m^2) 2 (x - z_m) + sum_i (c_oi (-sin a_i) + s_oi cos a_i) w_i + linear_o.

    All that does not depend on x is one matrix from (k', -sin, cos) to the slopes and to the factor of 2 x.
    """

    def __init__(self, layer: PathwiseLayer):
        self._layer, scale = layer, layer.kernel.argument_scale
        self._inverse = layer.inverse_lengthscale.unsqueeze(1)
        self._to_sqdist, self._offsets = layer.centres / scale, (layer.offsets / scale).unsqueeze(1)
        self._to_angles = 2 * math.pi * layer.frequencies
        self._value_out = torch.cat([layer.kernel_out, layer.feature_out], -1).mT  # "T P M+F O"
        waves = self._to_angles.repeat(1, 1, 2).mT.unsqueeze(2)  # "P F 1 D"
        of_kernel = self._to_sqdist.mT.unsqueeze(2) * layer.kernel_out.mT.unsqueeze(-1)  # "T P M O D"
        of_waves = waves * layer.feature_out.mT.unsqueeze(-1)
        along = torch.cat([of_kernel, of_waves], 2).flatten(3)
        twice = torch.cat([2.0 * layer.kernel_out.mT, torch.zeros_like(layer.feature_out.mT)], 2)
        self._slope_out = torch.cat([along, twice], -1)  # "T P M+F O(D+1)"

    def __call__(
        self, x: Float[Tensor, "t P n D"], functions: slice
    ) -> tuple[Float[Tensor, "t P n O"], Float[Tensor, "t P n O D"]]:
        """At points of their own for each of these functions."""
        layer, scaled = self._layer, x * self._inverse
        outputs, size = layer.kernel_out.shape[2], x.shape[-1]
        sqdist = scaled @ self._to_sqdist + (scaled.square().sum(-1, keepdim=True) + self._offsets)
        value, slope = layer.kernel.correlation_and_slope(sqdist)
        angles = scaled @ self._to_angles
        cosine, sine = angles.cos(), angles.sin()
        out = torch.cat([value, cosine, sine], -1) @ self._value_out[functions]
        slopes = torch.cat([slope, -sine, cosine], -1) @ self._slope_out[functions]
        along, twice = slopes.split([outputs * size, outputs], -1)
        by_scaled = along.unflatten(-1, (outputs, size)) + twice.unsqueeze(-1) * scaled.unsqueeze(-2)
        if layer.linear_out is not None:
            out = out + scaled @ layer.linear_out[functions].mT
            by_scaled = by_scaled + layer.linear_out[functions].unsqueeze(2)
        return out, by_scaled * self._inverse.unsqueeze(-2)


class Derivatives:
    """What the steps of a pathwise draw depend on, and how.

    Args:
        layers: the functions of the draw.
        coordinates: raw states to standardised coordinates and back.
        noise: what the worlds have of it, if any.
        by_step: whether each step of a plan has functions of its own.
    """

    def __init__(
        self, layers: Sequence[PathwiseLayer], coordinates: Coordinates, noise: PathNoise | None, *, by_step: bool
    ):
        self._layers, self._coordinates, self._noise, self._by_step = layers, coordinates, noise, by_step
        self._slopes: list[_Slopes] | None = None

    def pulled_back(
        self,
        states: Float[Tensor, "t P K S"],
        actions: Float[Tensor, "t P K A"],
        first: int,
        gradient: Float[Tensor, "c t P K S"],
    ) -> tuple[Float[Tensor, "c t P K S"], Float[Tensor, "c t P K A"]]:
        """From c gradients by the next states to those by states and actions, for steps ``first``, ``first + 1``, ...

        Encoding and decoding are a few elementwise maps, of which PyTorch keeps track; they are repeated for each c.
        """
        copies, num_steps = len(gradient), len(states)
        fed = states if self._noise is None else self._noise.all_fed(states, first)
        # What follows knows particles and candidates alone: all copies and steps of a particle are particles to it.
        repeated = [each.repeat(copies, 1, 1, 1, 1).flatten(0, 2) for each in (fed, actions)]
        with torch.enable_grad():
            state, action = (each.requires_grad_() for each in repeated)
            x = self._coordinates.encode(state, action)
            of_one = x.detach()[: num_steps * states.shape[1]].unflatten(0, (num_steps, -1))
            target, slopes = self._targets(of_one, first)
            target = target.repeat(copies, 1, 1, 1, 1).flatten(0, 2).requires_grad_()
            after = self._coordinates.decode(state, target)
            by_state, by_target = torch.autograd.grad(after, (state, target), gradient.flatten(0, 2))
            by_x = (by_target.view(*gradient.shape[:4], -1).movedim(0, 3) @ slopes).movedim(3, 0).reshape(x.shape)
            # Where no number of the state is fed, or there is no action, x does not depend on it.
            through = torch.autograd.grad(x, (state, action), by_x, allow_unused=True, materialize_grads=True)
        by_state = (by_state + through[0]).view(gradient.shape)
        if self._noise is not None and self._noise.observation is not None:
            stretch = 1.0 + self._noise.observation.stretch.to(by_state)
            later = 1 if first == 0 else 0
            by_state = torch.cat([by_state[:, :later], by_state[:, later:] * stretch], 1)
        return by_state, through[1].view(*gradient.shape[:4], -1)

    def _targets(
        self, x: Float[Tensor, "t P K D"], first: int
    ) -> tuple[Float[Tensor, "t P K T"], Float[Tensor, "t P K T D"]]:
        """Standardised targets, noise included, and their slopes by the inputs."""
        if self._slopes is None:
            self._slopes = [_Slopes(layer) for layer in self._layers]
        num_steps, num_points = len(x), x.shape[2]
        functions = slice(first, first + num_steps) if self._by_step else slice(0, 1)
        if not self._by_step:  # one function for all steps, so that they are points of it
            x = x.transpose(0, 1).flatten(1, 2).unsqueeze(0)
        through: Tensor | None = None
        for slopes in self._slopes[:-1]:
            change, by_x = slopes(x, functions)
            x = x + change
            by_x.diagonal(dim1=-2, dim2=-1).add_(1.0)
            through = by_x if through is None else by_x @ through
        target, by_x = self._slopes[-1](x, functions)
        by_x = by_x if through is None else by_x @ through
        if not self._by_step:
            target, by_x = (
                each.squeeze(0).unflatten(1, (num_steps, num_points)).transpose(0, 1) for each in (target, by_x)
            )
        if self._noise is not None:
            target = target + self._noise.process[first : first + num_steps].unsqueeze(2)
        return target, by_x


class Step(torch.autograd.Function):
    """One step, differentiable by states and actions; the value is that of ``evaluate``."""

    @staticmethod
    def forward(
        ctx: Any,
        evaluate: Callable[[Tensor, Tensor, int], Tensor],
        derivatives: Derivatives,
        observation: Float[Tensor, "P K S"],
        action: Float[Tensor, "*p K A"],
        step: int,
    ) -> Float[Tensor, "P K S"]:
        ctx.save_for_backward(observation, action)
        ctx.derivatives, ctx.step = derivatives, step
        return evaluate(observation, action, step)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[None, None, Tensor, Tensor, None]:
        observation, action = ctx.saved_tensors
        actions = action.expand(len(observation), -1, -1).unsqueeze(0)
        gradient = grad_outputs[0][None, None].contiguous()
        by_state, by_action = ctx.derivatives.pulled_back(observation.unsqueeze(0), actions, ctx.step, gradient)
        by_action = by_action[0, 0]
        return None, None, by_state[0, 0], by_action.sum(0) if action.ndim == 2 else by_action, None


class Trajectories(torch.autograd.Function):
    """Whole rollouts, differentiable by the first state and the actions; the values are those of ``evaluate``."""

    @staticmethod
    def forward(
        ctx: Any,
        evaluate: Callable[[Tensor, Tensor], Tensor],
        derivatives: Derivatives,
        observation: Float[Tensor, "S"],
        actions: Float[Tensor, "K H A"],
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        states = evaluate(observation, actions)
        ctx.save_for_backward(states, actions)
        ctx.derivatives = derivatives
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[None, None, Tensor, Tensor]:
        (gradient,), (states, actions) = grad_outputs, ctx.saved_tensors
        horizon, size = len(states) - 1, states.shape[-1]
        by_step = actions.to(states).transpose(0, 1).unsqueeze(1).expand(-1, states.shape[1], -1, -1)
        rows = torch.eye(size, dtype=states.dtype, device=states.device)
        rows = rows[:, None, None, None].expand(-1, *states[1:].shape)
        by_state, by_action = ctx.derivatives.pulled_back(states[:-1], by_step, 0, rows)
        points = states[0].numel() // size
        # To [t, points, next state, state or action].
        by_state, by_action = (
            each.permute(1, 2, 3, 0, 4).reshape(horizon, points, size, -1) for each in (by_state, by_action)
        )
        *own, last = gradient.reshape(horizon + 1, points, 1, size).unbind()
        adjoints = [last]
        for at_state, through in zip(reversed(own), reversed(by_state.unbind()), strict=True):
            adjoints.append(torch.baddbmm(at_state, adjoints[-1], through))
        start = adjoints.pop()
        by_action = torch.stack(adjoints[::-1]) @ by_action  # [H, points, 1, A]
        by_action = by_action.view(horizon, *states.shape[1:3], -1).sum(1).transpose(0, 1)
        return None, None, start.sum((0, 1)), by_action.to(actions.dtype)
