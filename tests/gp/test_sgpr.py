"""The collapsed bound and its posterior against dense numpy formulas, and against the exact Gaussian process."""

import math

import numpy as np
import pytest
import torch

from gym_dgpmpc.gp import exact
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import Layer
from gym_dgpmpc.gp.linalg import JITTER
from gym_dgpmpc.gp.sgpr import collapsed_bound, sparse_posterior, sparse_predict
from tests.oracles import gaussian_process
from tests.oracles.models import dense, make_model, normal, seeded


def case(kernel):
    generator = seeded(2)
    model = make_model(1, 2, 3, 5, generator, kernel)
    return model, normal(generator, 12, 2), normal(generator, 12, 3), normal(generator, 4, 2)


def log_normal(y, covariance):
    """log N(y | 0, covariance)."""
    _, log_determinant = np.linalg.slogdet(covariance)
    return -0.5 * (len(y) * math.log(2 * math.pi) + log_determinant + y @ np.linalg.solve(covariance, y))


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_bound_is_titsias(kernel):
    """log N(y | 0, Q + s I) - tr(K - Q) / 2 s with Q = K_xz (K_zz + jitter)^-1 K_zx, summed over the outputs."""
    model, x, y, _ = case(kernel)
    layer, points = dense(model.layers[0]), x.numpy()
    K_xz = gaussian_process.covariance(kernel, layer, points, layer.inducing_inputs)
    Q = K_xz @ np.linalg.solve(gaussian_process.inducing_covariance(kernel, layer), K_xz.T)
    lost = 12 * layer.variance - np.trace(Q)
    expected = sum(
        log_normal(y[:, t].numpy(), Q + noise * np.eye(12)) - lost / (2 * noise)
        for t, noise in enumerate(model.noise_variance.numpy())
    )
    found = collapsed_bound(model.layers[0], model.noise_variance, x, y)
    assert float(found) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
def test_it_is_a_lower_bound_and_tight_where_the_data_are_the_inducing_inputs(kernel):
    model, x, y, _ = case(kernel)
    layer = dense(model.layers[0])
    K = gaussian_process.covariance(kernel, layer, x.numpy(), x.numpy())
    noises = model.noise_variance.numpy()
    evidence = sum(log_normal(y[:, t].numpy(), K + noise * np.eye(12)) for t, noise in enumerate(noises))
    assert float(collapsed_bound(model.layers[0], model.noise_variance, x, y)) < evidence
    tight = collapsed_bound(model.layers[0]._replace(inducing_inputs=x), model.noise_variance, x, y)
    # To first order in the jitter j, K - Q is j I: it costs j / 2s (1 + 1 + |y|^2 / s) a datum at the most.
    jitter = JITTER * layer.variance
    slack = sum(
        jitter / (2 * noise) * (2 * 12 + (y[:, t].numpy() ** 2).sum() / noise) for t, noise in enumerate(noises)
    )
    assert evidence - slack < float(tight) < evidence + slack


@pytest.mark.parametrize("kernel", KERNELS)
def test_its_gradient_is_complete(kernel):
    """Finite differences see the factorisation of K_zz; the gradient must, although none flows through the factor."""
    model, x, y, _ = case(kernel)

    def bound(*parameters):
        *layer, log_noise = parameters
        return collapsed_bound(Layer(model.layers[0].kernel, *layer), log_noise.exp(), x, y)

    parameters = [tensor.clone().requires_grad_() for tensor in model.parameters()]
    assert torch.autograd.gradcheck(bound, parameters, eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kernel", KERNELS)
def test_predictions_are_titsias(kernel):
    """mean k_*z S K_zx y / s, variance k_** - k_*z (K_zz^-1 - S) k_z* with S = (K_zz + K_zx K_xz / s)^-1."""
    model, x, y, x_new = case(kernel)
    layer = dense(model.layers[0])
    posterior = sparse_posterior(model.layers[0], model.noise_variance, x, y)
    mean, variance = sparse_predict(model.layers[0], model.noise_variance, posterior, x_new)
    K_zz = gaussian_process.inducing_covariance(kernel, layer)
    K_zx = gaussian_process.covariance(kernel, layer, layer.inducing_inputs, x.numpy())
    K_nz = gaussian_process.covariance(kernel, layer, x_new.numpy(), layer.inducing_inputs)
    for t, noise in enumerate(model.noise_variance.numpy()):
        S = np.linalg.inv(K_zz + K_zx @ K_zx.T / noise)
        np.testing.assert_allclose(mean[:, t], K_nz @ S @ K_zx @ y[:, t].numpy() / noise, atol=1e-8)
        reduction = np.einsum("nz,zy,ny->n", K_nz, np.linalg.inv(K_zz) - S, K_nz)
        np.testing.assert_allclose(variance[:, t], layer.variance - reduction, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
def test_with_the_data_as_inducing_inputs_it_is_exact(kernel):
    model, x, y, x_new = case(kernel)
    layer = model.layers[0]._replace(inducing_inputs=x)
    posterior = sparse_posterior(layer, model.noise_variance, x, y)
    mean, variance = sparse_predict(layer, model.noise_variance, posterior, x_new)
    regression = exact.regression(layer, model.noise_variance, x, y, x_new)
    torch.testing.assert_close(mean, regression.mean, rtol=0, atol=1e-4)
    torch.testing.assert_close(variance, regression.covariance.diagonal(dim1=-2, dim2=-1).mT, rtol=0, atol=1e-4)
