"""One sparse layer against dense conditioning of the joint Gaussian of function values and inducing outputs."""

import numpy as np
import pytest
import torch

from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import Layer, conditional, factorise, joint_conditional
from tests.oracles import gaussian_process
from tests.oracles.models import chains, dense, make_model, normal, seeded

TOLERANCE = 1e-8  # float64 rounding times the condition number of K_zz, at most M / jitter = 1e7


def case(kernel, *batch, num_points=4, linear=False):
    generator = seeded(1)
    layer = make_model(1, 3, 2, 7, generator, kernel, linear=linear).layers[0]
    return layer, normal(generator, *batch, 7, 2), normal(generator, *batch, num_points, 3)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_factor_is_that_of_the_inducing_covariance(kernel):
    layer, _, _ = case(kernel)
    factor = factorise(layer)
    exact = gaussian_process.inducing_covariance(kernel, dense(layer))
    np.testing.assert_allclose(factor @ factor.mT, exact, atol=1e-13)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("kernel", KERNELS)
def test_conditionals_are_those_of_the_joint_gaussian(kernel, batch, linear):
    layer, v, x = case(kernel, *batch, linear=linear)
    factor = factorise(layer)
    exact_mean, exact_covariance = gaussian_process.conditional(kernel, dense(layer), v.numpy(), x.numpy())
    mean, covariance = joint_conditional(layer, factor, v, x)
    np.testing.assert_allclose(mean, exact_mean, atol=TOLERANCE)
    np.testing.assert_allclose(covariance, exact_covariance, atol=TOLERANCE)
    mean, variance = conditional(layer, factor, v, x)
    np.testing.assert_allclose(mean, exact_mean, atol=TOLERANCE)
    np.testing.assert_allclose(variance, np.diagonal(exact_covariance, axis1=-2, axis2=-1), atol=TOLERANCE)


@pytest.mark.parametrize("kernel", KERNELS)
def test_at_the_inducing_inputs_the_function_is_the_inducing_outputs(kernel):
    layer, v, _ = case(kernel)
    factor = factorise(layer)
    mean, variance = conditional(layer, factor, v, layer.inducing_inputs)
    # What the jitter of 1e-6 leaves: j alpha in the mean, at most j sigma^2 in the variance.
    alpha = torch.linalg.solve_triangular(factor.mT, v, upper=True).abs().max()
    assert (mean - factor @ v).abs().max() < 2e-6 * float(layer.variance * alpha)
    assert variance.min() >= 0.0
    assert variance.max() < 2e-6 * float(layer.variance)


@pytest.mark.parametrize("kernel", KERNELS)
def test_far_from_the_inducing_inputs_the_prior_is_left(kernel):
    layer, v, x = case(kernel)
    mean, variance = conditional(layer, factorise(layer), v, x + 1e3)
    torch.testing.assert_close(mean, torch.zeros_like(mean), rtol=0, atol=1e-9)
    torch.testing.assert_close(variance, layer.variance.expand(4), rtol=1e-12, atol=0)


def test_with_a_linear_part_the_function_goes_on_along_a_line():
    """Far away the stationary part has gone: what is left of the mean is linear, and its slopes' variance grows."""
    layer, v, x = case("matern32", linear=True)
    factor, far = factorise(layer), torch.stack([x[0] + 1e3, x[0] + 2e3, x[0] + 3e3])
    mean, variance = conditional(layer, factor, v, far)
    torch.testing.assert_close(mean[2] - mean[1], mean[1] - mean[0], rtol=1e-9, atol=1e-6)
    assert (mean[1] - mean[0]).abs().min() > 1.0 and variance[2] > variance[1] > variance[0] > layer.variance


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("kernel", KERNELS)
def test_the_gradient_reaches_hyperparameters_and_inducing_points(kernel, linear):
    layer, v, x = case(kernel, num_points=2, linear=linear)
    tensors = [t.detach().clone().requires_grad_() for t in (*layer.parameters().values(), v)]

    def outputs(*tensors):
        *parameters, whitened = tensors
        moved = Layer(layer.kernel, *parameters)
        return conditional(moved, factorise(moved), whitened, x)

    assert torch.autograd.gradcheck(outputs, tensors)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("kernel", KERNELS)
def test_layers_of_chains_are_each_on_its_own(kernel, batch, linear):
    generator = seeded(1)
    models = [make_model(1, 3, 2, 7, generator, kernel, linear=linear) for _ in range(2)]
    layers = [models[0].layers[0], models[1].layers[0]._replace(log_variance=torch.tensor(-0.7).double())]
    together = chains(*(model._replace(layers=(layer,)) for model, layer in zip(models, layers, strict=True))).layers[0]
    v, x = normal(generator, *batch, 2, 7, 2), normal(generator, *batch, 2, 4, 3)
    factor = factorise(together)
    for each in (conditional, joint_conditional):
        mean, covariance = each(together, factor, v, x)
        alone = [each(layer, factorise(layer), v[..., c, :, :], x[..., c, :, :]) for c, layer in enumerate(layers)]
        torch.testing.assert_close(mean, torch.stack([m for m, _ in alone], dim=len(batch)), rtol=0, atol=TOLERANCE)
        expected = torch.stack([c for _, c in alone], dim=len(batch))
        torch.testing.assert_close(covariance, expected, rtol=0, atol=TOLERANCE)
    for c, layer in enumerate(layers):
        torch.testing.assert_close(factor[c], factorise(layer), rtol=1e-12, atol=1e-12)
