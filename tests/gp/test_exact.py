"""The closed forms against each other, against plain numpy and against the model's own likelihood."""

import numpy as np
import pytest
import torch

from gym_dgpmpc.gp import exact
from gym_dgpmpc.gp.deep_gp import log_likelihood
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import conditional, factorise, joint_conditional
from tests.oracles import gaussian_process
from tests.oracles.models import dense, make_model, normal, seeded


def case(kernel):
    generator = seeded(2)
    model = make_model(1, 2, 2, 5, generator, kernel)
    return model, normal(generator, 9, 2), normal(generator, 9, 2), normal(generator, 4, 2)


@pytest.mark.parametrize("kernel", KERNELS)
def test_regression_is_the_joint_gaussian_conditioned_on_the_data(kernel):
    model, x, y, x_new = case(kernel)
    layer = dense(model.layers[0])
    found = exact.regression(model.layers[0], model.noise_variance, x, y, x_new)
    everything = np.concatenate([x.numpy(), x_new.numpy()])
    for target, noise in enumerate(model.noise_variance.numpy()):
        joint = gaussian_process.covariance(kernel, layer, everything, everything)
        joint[:9, :9] += noise * np.eye(9)
        precision = np.linalg.inv(joint)  # the conditional's, read off the block of x_new
        covariance = np.linalg.inv(precision[9:, 9:])
        np.testing.assert_allclose(found.covariance[target], covariance, atol=1e-9)
        mean = -covariance @ precision[9:, :9] @ y[:, target].numpy()
        np.testing.assert_allclose(found.mean[:, target], mean, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_posterior_of_v_has_the_gradient_and_curvature_of_the_log_joint(kernel):
    model, x, y, _ = case(kernel)
    layer = model.layers[0]
    factor = factorise(layer)

    def log_joint(v):
        mean, variance = conditional(layer, factor, v, x)
        return log_likelihood(model, mean, variance, y).sum() - 0.5 * v.square().sum()

    posterior = exact.whitened_posterior(layer, factor, model.noise_variance, x, y)
    gradient = torch.autograd.functional.jacobian(log_joint, posterior.mean)
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-9)
    hessian = torch.autograd.functional.hessian(log_joint, posterior.mean)  # "M T M T"
    for target in range(2):
        precision = torch.linalg.inv(posterior.covariance[target])
        torch.testing.assert_close(-hessian[:, target, :, target], precision, rtol=1e-8, atol=1e-8)
        assert hessian[:, target, :, 1 - target].abs().max() == 0.0


@pytest.mark.parametrize("kernel", KERNELS)
def test_with_the_data_as_inducing_inputs_both_forms_agree(kernel):
    """Then the sparse model is the exact one, up to the jitter."""
    model, x, y, x_new = case(kernel)
    layer = model.layers[0]._replace(inducing_inputs=x)
    factor = factorise(layer)
    posterior = exact.whitened_posterior(layer, factor, model.noise_variance, x, y)
    mean, prior = joint_conditional(layer, factor, posterior.mean, x_new)
    # The mean is linear in v: its slope carries the posterior's covariance to the new points.
    slope = joint_conditional(layer, factor, torch.eye(9, dtype=torch.float64), x_new)[0]
    regression = exact.regression(layer, model.noise_variance, x, y, x_new)
    torch.testing.assert_close(mean, regression.mean, rtol=0, atol=1e-4)
    torch.testing.assert_close(
        prior + slope @ posterior.covariance @ slope.mT, regression.covariance, rtol=0, atol=1e-4
    )
