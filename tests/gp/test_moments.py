"""Analytic moments against quadrature, against Monte Carlo, and where the input is known."""

import math

import numpy as np
import pytest
import scipy.integrate
import torch

from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import Layer
from gym_dgpmpc.gp.moments import Predictor, predicted_moments
from gym_dgpmpc.gp.sgpr import shrinkage, sparse_posterior, sparse_predict
from tests.oracles.models import normal, seeded


def trained(input_size, num_targets=2, seed=0):
    """A sparse Gaussian process of random data, as a layer, its posterior and the predictor."""
    generator = seeded(seed)
    x, y = 1.5 * normal(generator, 30, input_size), normal(generator, 30, num_targets)
    lengthscale = 0.8 + torch.rand(input_size, generator=generator, dtype=torch.float64)
    layer = Layer(
        KERNELS["rbf"], 1.5 * normal(generator, 8, input_size), lengthscale.log(), torch.tensor(1.3).double().log()
    )
    noise = 0.05 + 0.1 * torch.rand(num_targets, generator=generator, dtype=torch.float64)
    posterior = sparse_posterior(layer, noise, x, y)
    basis, removed = posterior.basis, shrinkage(posterior, noise).mT.unsqueeze(-1)
    predictor = Predictor(
        layer.inducing_inputs, lengthscale, layer.variance, basis.mT @ posterior.mean, basis.mT @ (removed * basis)
    )
    return lambda x: sparse_predict(layer, noise, posterior, x), predictor


def gaussian(input_size, count=3, seed=1):
    generator = seeded(seed)
    root = 0.6 * normal(generator, count, input_size, input_size)
    return normal(generator, count, input_size), root @ root.mT


@pytest.mark.parametrize("input_size", [1, 2])
def test_they_are_the_integrals(input_size):
    """Gauss and Hermite's rule of 40 nodes a dimension, exact for these smooth functions to about machine precision."""
    predict, predictor = trained(input_size)
    mean, covariance = gaussian(input_size)
    found = predicted_moments(predictor, mean, covariance)
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    grid = torch.tensor(np.stack(np.meshgrid(*[nodes] * input_size, indexing="ij"), -1).reshape(-1, input_size))
    weight = torch.tensor(outer_power(weights / weights.sum(), input_size))
    for k in range(len(mean)):
        x = mean[k] + grid @ torch.linalg.cholesky(covariance[k]).mT
        f, variance = predict(x)
        expected = weight @ f
        centred = f - expected
        torch.testing.assert_close(found.mean[k], expected, rtol=0, atol=1e-9)
        total = (weight.unsqueeze(-1) * centred).mT @ centred + torch.diag(weight @ variance)
        torch.testing.assert_close(found.covariance[k], total, rtol=0, atol=1e-8)
        cross = (weight.unsqueeze(-1) * (x - mean[k])).mT @ centred
        torch.testing.assert_close(covariance[k] @ found.gain[k], cross, rtol=0, atol=1e-9)


def outer_power(weights, times):
    product = np.ones(1)
    for _ in range(times):
        product = np.outer(product, weights).ravel()
    return product


def test_they_are_scipys_integrals_too():
    predict, predictor = trained(1, num_targets=1)
    mean, covariance = gaussian(1, count=1)
    centre, std = float(mean), float(covariance) ** 0.5

    def expectation(function):
        def integrand(x):
            f, variance = (float(value) for value in predict(torch.tensor([[x]], dtype=torch.float64)))
            density = math.exp(-0.5 * ((x - centre) / std) ** 2) / (std * math.sqrt(2 * math.pi))
            return function(x, f, variance) * density

        return scipy.integrate.quad(integrand, centre - 9 * std, centre + 9 * std, epsabs=1e-10)[0]

    found = predicted_moments(predictor, mean, covariance)
    first = expectation(lambda x, f, variance: f)
    assert float(found.mean) == pytest.approx(first, abs=1e-8)
    assert float(found.covariance) == pytest.approx(
        expectation(lambda x, f, variance: (f - first) ** 2 + variance), abs=1e-8
    )
    cross = expectation(lambda x, f, variance: (x - centre) * f)
    assert float(covariance) * float(found.gain) == pytest.approx(cross, abs=1e-8)


def test_they_agree_with_draws():
    """Within five standard errors, the draws' own, in five dimensions and with full covariances."""
    predict, predictor = trained(5, num_targets=3)
    mean, covariance = gaussian(5)
    found = predicted_moments(predictor, mean, covariance)
    generator, count = seeded(4), 200_000
    for k in range(len(mean)):
        x = mean[k] + normal(generator, count, 5) @ torch.linalg.cholesky(covariance[k]).mT
        f, variance = predict(x)
        f = f + variance.sqrt() * normal(generator, count, 3)

        def check(value, samples):
            error, standard_error = (value - samples.mean(0)).abs(), samples.std(0) / count**0.5
            assert bool((error <= 5 * standard_error).all())

        check(found.mean[k], f)
        centred = f - found.mean[k]
        check(found.covariance[k], centred.unsqueeze(-1) * centred.unsqueeze(-2))
        check(covariance[k] @ found.gain[k], (x - mean[k]).unsqueeze(-1) * centred.unsqueeze(-2))


def test_a_known_input_gives_the_plain_prediction():
    predict, predictor = trained(3)
    mean, _ = gaussian(3)
    found = predicted_moments(predictor, mean, torch.zeros(3, 3, 3, dtype=torch.float64))
    f, variance = predict(mean)
    torch.testing.assert_close(found.mean, f, rtol=0, atol=1e-10)
    torch.testing.assert_close(found.covariance, torch.diag_embed(variance), rtol=0, atol=1e-8)


def test_the_gain_at_a_known_input_is_the_slope():
    _, predictor = trained(3)
    mean = gaussian(3)[0].requires_grad_()
    found = predicted_moments(predictor, mean, torch.zeros(3, 3, 3, dtype=torch.float64))
    for target in range(2):
        (slope,) = torch.autograd.grad(found.mean[:, target].sum(), mean, retain_graph=True)
        torch.testing.assert_close(found.gain[..., target], slope)


def test_many_inputs_are_taken_in_parts(monkeypatch):
    _, predictor = trained(2)
    mean, covariance = gaussian(2, count=7)
    whole = predicted_moments(predictor, mean, covariance)
    monkeypatch.setattr("gym_dgpmpc.gp.moments._ELEMENTS_AT_ONCE", 3 * 8**2)
    for one, other in zip(whole, predicted_moments(predictor, mean, covariance), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
