"""L^-1 k(Z, x), the one large product that every sparse-GP formula needs, with its gradient in closed form.

`layer.py` builds means and variances from it. Automatic differentiation through the covariance, its Cholesky
factorisation and the triangular solve costs several times the forward pass; the closed form shares one factorisation
between all uses of an iteration and needs two solves of the forward's size.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import Kernel, sqdist


class _Projection(torch.autograd.Function):
    """A = L^-1 r(Z, x) with L L^T = r(Z, Z) + jitter, as a function of x and Z (both over the lengthscales).

    With a bar for the gradient of the loss: r_bar = L^-T A_bar, and through the factor (Murray 2016, eq. 8, where
    L^T L_bar = -A_bar A^T in its lower triangle) K_bar = -sym(L^-T Phi(A_bar A^T) L^-1), Phi taking the lower triangle
    with half the diagonal. A linear part x S z^T of the kernel, S diagonal, is a matrix product of its own in either.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, z: Tensor, factor: Tensor, kernel: Kernel, linear: Tensor | None) -> Tensor:
        value, slope = kernel.correlation_and_slope(sqdist(x, z))
        if linear is not None:
            value = value + linear_covariance(x, z, linear)
        projected = torch.linalg.solve_triangular(factor, value.mT, upper=False)
        ctx.save_for_backward(x, z, factor, slope, projected, linear)
        ctx.kernel = kernel
        return projected

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, Tensor | None]:
        (gradient,) = grad_outputs
        x, z, factor, slope, projected, linear = ctx.saved_tensors
        value_bar = torch.linalg.solve_triangular(factor.mT, gradient, upper=True).mT  # "*p n M"
        # The gradient of every squared distance |x_i - z_j|^2: that of the kernel, times its slope.
        by_distance = value_bar * slope
        x_bar = z_bar = linear_bar = None
        if ctx.needs_input_grad[0]:
            # d |x_i - z_j|^2 / d x_i = 2 (x_i - z_j), summed over the j.
            x_bar = 2.0 * (by_distance.sum(-1, keepdim=True) * x - by_distance @ z)
            if linear is not None:
                x_bar = x_bar + (value_bar @ z) * linear.unsqueeze(-2)
        if ctx.needs_input_grad[1] or ctx.needs_input_grad[4]:
            # First z_j in its distances to the points: d |x_i - z_j|^2 / d z_j = 2 (z_j - x_i), summed over the i.
            points = by_distance.sum(-2).unsqueeze(-1) * z - by_distance.mT @ x
            seen_from = value_bar.mT @ x  # "*p M D", of the linear part
            outer = gradient @ projected.mT  # A_bar A^T, through which the factor's gradient comes
            leading = tuple(range(gradient.ndim - z.ndim))
            if leading:  # one factor serves all particles, so their gradients add up
                points, seen_from, outer = points.sum(leading), seen_from.sum(leading), outer.sum(leading)
            # Then in K_zz: Phi, L^-T from the left and L^-1 from the right, and the symmetric part of it.
            lower = outer.tril()
            lower.diagonal(dim1=-2, dim2=-1).mul_(0.5)
            inner = torch.linalg.solve_triangular(factor.mT, lower, upper=True)
            covariance_bar = -torch.linalg.solve_triangular(factor, inner, upper=False, left=False)
            symmetric = 0.5 * (covariance_bar + covariance_bar.mT)
            by_own_distance = symmetric * ctx.kernel.correlation_and_slope(sqdist(z, z))[1]
            # Each inducing input is on both sides of its own distances, hence twice.
            own = by_own_distance.sum(-1, keepdim=True) * z - by_own_distance @ z
            z_bar = 2.0 * points + 4.0 * own
            if linear is not None:
                z_bar = z_bar + (seen_from + 2.0 * symmetric @ z) * linear.unsqueeze(-2)
                linear_bar = (z * (seen_from + symmetric @ z)).sum(-2)
        return x_bar, z_bar, None, None, linear_bar


def linear_covariance(
    x: Float[Tensor, "*p n D"], z: Float[Tensor, "*c m D"], slope_variance: Float[Tensor, "*s D"]
) -> Float[Tensor, "*p n m"]:
    """x S z^T of linear functions whose slopes have the variances S."""
    return (x * slope_variance.unsqueeze(-2)) @ z.mT


def projection(
    kernel: Kernel,
    x: Float[Tensor, "*p n D"],
    z: Float[Tensor, "*c M D"],
    factor: Float[Tensor, "*c M M"],
    slope_variance: Float[Tensor, "*c D"] | None = None,
) -> Float[Tensor, "*p M n"]:
    """L^-1 r(Z, x), differentiable once in ``x``, ``z`` and ``slope_variance``.

    Args:
        x, z: points and inducing inputs, divided by the lengthscales.
        factor: L, the Cholesky factor of r(Z, Z) + jitter *for this z*. No gradient flows into it: its dependence on
            ``z`` is part of the gradient of ``z``.
        slope_variance: of the linear part that the kernel has beside ``kernel``, if any.
    """
    return _Projection.apply(x, z, factor, kernel, slope_variance)
