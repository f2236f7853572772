"""The closed-form gradient of L^-1 k(Z, x) against finite differences and against automatic differentiation."""

import pytest
import torch

from gym_dgpmpc.gp.kernels import KERNELS, sqdist
from gym_dgpmpc.gp.linalg import cholesky
from gym_dgpmpc.gp.projection import projection

M, D, N, P = 5, 2, 4, 3


def factor_of(kernel, z):
    return cholesky(KERNELS[kernel].correlation(sqdist(z, z)), torch.ones((), dtype=z.dtype))


def points(*shape):
    """Another set for every shape: at coincident points Matern-1/2 has no derivative."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (P,)])
@pytest.mark.parametrize("kernel", KERNELS)
def test_the_gradient_is_that_of_finite_differences(kernel, batch):
    x, z = points(*batch, N, D).requires_grad_(), points(M, D).requires_grad_()
    # The factor depends on z, but no gradient is to flow through it.
    assert torch.autograd.gradcheck(
        lambda x, z: projection(KERNELS[kernel], x, z, factor_of(kernel, z.detach())), (x, z)
    )


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_gradient_is_that_of_automatic_differentiation(kernel):
    """Also where gradcheck's small steps could hide an error: at many points, to rounding."""
    z, x = points(40, D).requires_grad_(), points(60, D).requires_grad_()
    weights = points(40, 60)
    plain = torch.linalg.solve_triangular(
        factor_of(kernel, z), KERNELS[kernel].correlation(sqdist(x, z)).mT, upper=False
    )
    expected = torch.autograd.grad((weights * plain).sum(), (x, z))
    found = torch.autograd.grad(
        (weights * projection(KERNELS[kernel], x, z, factor_of(kernel, z.detach()))).sum(), (x, z)
    )
    for a, b in zip(found, expected, strict=True):
        # The solves amplify rounding by the condition number, at most M / jitter.
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6 * float(b.detach().abs().max()))


@pytest.mark.parametrize("batch", [(), (P,)])
@pytest.mark.parametrize("kernel", KERNELS)
def test_chains_side_by_side_are_each_on_its_own(kernel, batch):
    """A leading axis of inducing inputs is one of the points too, after those of their own; gradients included."""
    x, z = points(*batch, 2, N, D).requires_grad_(), points(2, M, D).requires_grad_()
    factor = torch.stack([factor_of(kernel, each) for each in z.detach()])
    weights = points(*batch, 2, M, N)
    together = projection(KERNELS[kernel], x, z, factor)
    found = torch.autograd.grad((weights * together).sum(), (x, z))
    alone = [projection(KERNELS[kernel], x[..., c, :, :], z[c], factor[c]) for c in range(2)]
    torch.testing.assert_close(together, torch.stack(alone, dim=-3))
    one_by_one = sum((weights[..., c, :, :] * alone[c]).sum() for c in range(2))
    for a, b in zip(found, torch.autograd.grad(one_by_one, (x, z)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_only_what_is_asked_for_is_computed():
    z, x = points(M, D), points(N, D).requires_grad_()
    projection(KERNELS["matern32"], x, z, factor_of("matern32", z)).sum().backward()
    assert x.grad is not None and z.grad is None
