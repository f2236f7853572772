"""Stationary kernels with ARD as functions of the scaled squared distance r^2 = sum_d (x_d - z_d)^2 / lengthscale_d^2.

The lowest room of the Gaussian-process code: `layer.py` builds covariances from it, `features.py` its spectral
counterpart. Values and first derivatives are computed together, which is what training spends most of its time on.
"""

import math
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

Kernel = Literal["rbf", "matern52", "matern32", "matern12"]

KERNELS: tuple[Kernel, ...] = get_args(Kernel)

# Below this r^2 two points are one: rounding of r^2 would show in Matern-1/2, and its slope there is infinite.
_SQDIST_FLOOR = 1e-12

# Range of s^2 (or of r^2 / 2) in rollouts.
_NEAREST, _FARTHEST = 1e-36, 60.0

_ORDER = {"matern12": 0.5, "matern32": 1.5, "matern52": 2.5}


def smoothness(kernel: Kernel) -> float:
    """The Matern order nu of a kernel; infinite for the RBF."""
    return _ORDER.get(check_kernel(kernel), math.inf)


def check_kernel(kernel: str) -> Kernel:
    """Return ``kernel`` if it is one of `KERNELS`; otherwise raise a ValueError that names them."""
    if kernel not in KERNELS:
        raise ValueError(f"unknown kernel {kernel!r}: expected one of {', '.join(KERNELS)}")
    return kernel


def argument_scale(kernel: Kernel) -> float:
    """The factor c for which `correlation_` takes c r^2: -1/2 for the RBF, 2 nu for Matern-nu."""
    return -0.5 if kernel == "rbf" else 2 * _ORDER[kernel]


def correlation_(
    kernel: Kernel, argument: Float[Tensor, "*b"], scratch: Float[Tensor, "*b"] | None = None
) -> Float[Tensor, "*b"]:
    """k with unit variance from ``argument`` = `argument_scale` * r^2, overwriting it; no gradient.

    The in-place form for rollouts, which fold the factor into a matrix product. Rounding that makes r^2 negative is
    taken as zero. With s = sqrt(2 nu) r: RBF exp(-r^2/2); Matern-1/2 exp(-s); Matern-3/2 (1 + s) exp(-s);
    Matern-5/2 (1 + s + s^2/3) exp(-s) (Rasmussen and Williams 2006, eqs. 4.9 and 4.17). Values below exp(-60) are
    given as about exp(-60): single precision would make them subnormal, and products of those are a hundred times
    slower.

    Args:
        scratch: overwritten; spares an allocation to who calls often.
    """
    if kernel == "rbf":
        return argument.clamp_(-_FARTHEST, 0.0).exp_()
    # Exact zeros would take the vectorised square root's slow path.
    s = argument.clamp_(_NEAREST, _FARTHEST**2).sqrt_()
    if kernel == "matern12":
        return s.neg_().exp_()
    decay = torch.neg(s, out=scratch).exp_()
    if kernel == "matern32":
        return torch.addcmul(decay, s, decay, out=s)
    return s.addcmul_(s, s, value=1 / 3).add_(1.0).mul_(decay)


def correlation_and_slope(
    kernel: Kernel, sqdist: Float[Tensor, "*b"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """k(r^2) and dk/d(r^2) with unit variance; no gradient flows through."""
    if kernel == "rbf":
        value = torch.exp(-0.5 * sqdist.clamp_min(0.0))
        return value, -0.5 * value
    order = _ORDER[kernel]
    s = torch.sqrt(2 * order * torch.threshold(sqdist, _SQDIST_FLOOR, 0.0))
    decay = torch.exp(-s)
    if kernel == "matern12":
        return decay, -0.5 * decay / s.clamp_min(_SQDIST_FLOOR**0.5)
    if kernel == "matern32":
        return torch.addcmul(decay, s, decay), -1.5 * decay
    slope = torch.addcmul(decay, s, decay).mul_(-5 / 6)
    return torch.addcmul(s, s, s, value=1 / 3).add_(1.0).mul_(decay), slope


class _Correlation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sqdist: Tensor, kernel: Kernel) -> Tensor:
        value, slope = correlation_and_slope(kernel, sqdist)
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return grad_outputs[0] * slope, None


def correlation(kernel: Kernel, sqdist: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """k(r^2) with unit variance, differentiable once. Formulas as in `correlation_`."""
    return _Correlation.apply(sqdist, kernel)


def scaled_sqdist(
    x: Float[Tensor, "*b n D"], z: Float[Tensor, "m D"], lengthscale: Float[Tensor, "D"]
) -> Float[Tensor, "*b n m"]:
    """r^2 between the rows of ``x`` and ``z``; may be negative by rounding."""
    return sqdist(x / lengthscale, z / lengthscale)


def sqdist(x: Float[Tensor, "*b n D"], z: Float[Tensor, "m D"]) -> Float[Tensor, "*b n m"]:
    """|x_i - z_j|^2 between the rows of ``x`` and ``z``; may be negative by rounding.

    One matrix product of (x, |x|^2, 1) and (-2 z, 1, |z|^2), so that no other operation has the size of the result.
    """
    left = torch.cat([x, x.square().sum(-1, keepdim=True), torch.ones_like(x[..., :1])], dim=-1)
    right = torch.cat([-2.0 * z, torch.ones_like(z[..., :1]), z.square().sum(-1, keepdim=True)], dim=-1)
    return left @ right.mT


def pairwise_sqdist(x: Float[Tensor, "*b n D"]) -> Float[Tensor, "*b n n"]:
    """|x_i - x_j|^2 between the rows of ``x`` (already divided by the lengthscales); may be negative by rounding."""
    square = x.square().sum(-1)
    return square.unsqueeze(-1) + square.unsqueeze(-2) - 2.0 * (x @ x.mT)
