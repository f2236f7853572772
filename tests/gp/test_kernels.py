"""Kernels against their definitions, and their hand-written derivative against finite differences."""

import math
from typing import get_args

import numpy as np
import pytest
import torch

from gym_dgpmpc.gp.kernels import KERNELS, KernelName, find_kernel, pairwise_sqdist, scaled_sqdist
from tests.oracles import gaussian_process
from tests.oracles.gaussian_process import MATERN_ORDER
from tests.oracles.models import normal, seeded

DISTANCES = torch.cat([torch.logspace(-4, 1.3, 60, dtype=torch.float64), torch.tensor([1.0], dtype=torch.float64)])


@pytest.mark.parametrize("kernel", KERNELS)
def test_values_are_those_of_the_definition(kernel):
    value = KERNELS[kernel].correlation(DISTANCES.square())
    exact = gaussian_process.correlation(kernel, DISTANCES.numpy())
    # The Bessel function of scipy loses digits of its own where k is tiny or r is.
    np.testing.assert_allclose(value, exact, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kernel", KERNELS)
def test_the_in_place_form_agrees(kernel, dtype):
    sqdist = DISTANCES.square().to(dtype)
    kernel = KERNELS[kernel]
    scratch = torch.empty_like(sqdist)
    argument, again = kernel.argument_scale * sqdist, kernel.argument_scale * sqdist
    out = kernel.correlation_(argument)
    assert out.data_ptr() == argument.data_ptr(), "it must not allocate a result"
    assert torch.equal(kernel.correlation_(again, scratch), out)
    rounding = 100 * torch.finfo(dtype).eps  # |d k| <= s e^-s |d s / s| and a few elementwise roundings
    torch.testing.assert_close(out, kernel.correlation(sqdist), rtol=0, atol=rounding)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_in_place_form_ends_at_exp_of_minus_60(kernel):
    """Where s^2 (of the RBF r^2 / 2) is larger the value stays there, so that single precision has no subnormals."""
    kernel = KERNELS[kernel]
    scale = abs(kernel.argument_scale)
    ends = torch.tensor([60.0**2 / scale if scale >= 1 else 60.0 / scale], dtype=torch.float32)
    exact = float(kernel.correlation(ends.double()))
    for sqdist in (ends, 4 * ends, 1e6 * ends):
        found = float(kernel.correlation_(kernel.argument_scale * sqdist))
        assert found == pytest.approx(exact, rel=60 * 2**-23)  # rounding of s, which is 60


@pytest.mark.parametrize("kernel", KERNELS)
def test_coincident_points_have_unit_correlation_even_if_rounding_makes_them_negative(kernel):
    sqdist = torch.tensor([0.0, -1e-16, -1e-7], dtype=torch.float64, requires_grad=True)
    kernel = KERNELS[kernel]
    value = kernel.correlation(sqdist)
    assert torch.equal(value, torch.ones(3, dtype=torch.float64))
    (gradient,) = torch.autograd.grad(value.sum(), sqdist)
    assert gradient.isfinite().all()
    in_place = kernel.correlation_(kernel.argument_scale * sqdist.detach())
    assert torch.equal(in_place, torch.ones(3, dtype=torch.float64))


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_gradient_is_that_of_finite_differences(kernel):
    sqdist = torch.tensor([1e-2, 0.3, 1.0, 4.0, 20.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(KERNELS[kernel].correlation, sqdist, eps=1e-7, atol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_gradient_reaches_points_and_lengthscales(kernel):
    generator = seeded()
    x, z = normal(generator, 4, 3), normal(generator, 2, 3)
    lengthscale = 0.5 + torch.rand(3, generator=generator, dtype=torch.float64)
    inputs = tuple(t.requires_grad_() for t in (x, z, lengthscale))
    assert torch.autograd.gradcheck(lambda x, z, ls: KERNELS[kernel].correlation(scaled_sqdist(x, z, ls)), inputs)


@pytest.mark.parametrize("kernel", KERNELS)
def test_covariances_are_positive_definite(kernel):
    x = normal(seeded(), 40, 3)
    eigenvalues = torch.linalg.eigvalsh(KERNELS[kernel].correlation(pairwise_sqdist(x)))
    assert eigenvalues.min() > -1e-12
    assert eigenvalues.sum().item() == pytest.approx(40, abs=1e-4)


def test_squared_distances_are_those_of_the_differences():
    generator = seeded()
    x, z = normal(generator, 2, 5, 3), normal(generator, 4, 3)
    lengthscale = torch.tensor([0.5, 1.0, 3.0], dtype=torch.float64)
    exact = ((x.unsqueeze(-2) - z) / lengthscale).square().sum(-1)
    torch.testing.assert_close(scaled_sqdist(x, z, lengthscale), exact, rtol=0, atol=1e-13)
    exact = (x.unsqueeze(-2) - x.unsqueeze(-3)).square().sum(-1)
    torch.testing.assert_close(pairwise_sqdist(x), exact, rtol=0, atol=1e-13)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_slope_is_bounded_where_the_functions_have_one(kernel):
    """-dk/d(r^2) at zero is nu / (2 nu - 2) for nu > 1, 1/2 in the limit; without a derivative there is no bound."""
    slope = -KERNELS[kernel].correlation_and_slope(torch.tensor([1e-10], dtype=torch.float64))[1]
    if kernel == "matern12":
        assert slope > 1e4
    else:
        order = MATERN_ORDER.get(kernel, math.inf)
        assert float(slope) == pytest.approx(0.5 / (1 - 1 / order), rel=1e-4)  # s = 1e-5 sqrt(2 nu)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_kernel_is_found_by_its_name_and_given_back(kernel):
    assert find_kernel(kernel).name == kernel
    assert find_kernel(KERNELS[kernel]) is KERNELS[kernel]


@pytest.mark.parametrize("kernel", ["RBF", "matern", "", "matern92"])
def test_an_unknown_kernel_is_named_with_the_known_ones(kernel):
    with pytest.raises(ValueError) as error:
        find_kernel(kernel)
    assert all(name in str(error.value) for name in (repr(kernel), *KERNELS))


def test_type_checkers_and_the_command_line_know_every_kernel():
    assert get_args(KernelName) == tuple(KERNELS)
