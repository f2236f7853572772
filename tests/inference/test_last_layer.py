"""The exact draw of the last layer against the closed-form posterior, and what it does to a chain."""

import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.errors import FactorisationError
from gym_dgpmpc.gp.deep_gp import DeepGP, factorise_all
from gym_dgpmpc.gp.exact import whitened_posterior
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import Layer, project
from gym_dgpmpc.gp.linalg import JITTER
from gym_dgpmpc.inference import mcem, sghmc
from gym_dgpmpc.inference.last_layer import last_layer_posterior
from gym_dgpmpc.inference.mcem import InferenceSettings

M, D, T, N = 7, 2, 3, 30


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def deep_gp(num_layers, generator, kernel="matern32"):
    def layer(log_variance):
        centres = torch.randn(M, D, generator=generator, dtype=torch.float64)
        return Layer(KERNELS[kernel], centres, torch.tensor([0.1, -0.2]).double(), torch.tensor(log_variance).double())

    layers = tuple(layer(-3.0) for _ in range(num_layers - 1))
    return DeepGP((*layers, layer(0.3)), torch.tensor([-2.0, -3.0, -1.0]).double())


def toy(generator):
    x = torch.randn(N, D, generator=generator, dtype=torch.float64)
    return x, torch.stack([x[:, 0].sin(), x[:, 1].cos(), x.sum(-1)], dim=1)


@pytest.mark.parametrize("kernel", ["rbf", "matern12"])
def test_one_layer_is_the_closed_form(kernel, generator):
    model, (x, y) = deep_gp(1, generator, kernel), toy(generator)
    factorised = factorise_all(model)
    exact = whitened_posterior(model.layers[0], factorised.factors[0], model.noise_variance, x, y)
    found = last_layer_posterior(factorised, torch.zeros(M * T).double(), x, y, generator)
    torch.testing.assert_close(found.mean.mT, exact.mean, rtol=0, atol=1e-10)
    torch.testing.assert_close(torch.cholesky_inverse(found.precision_factor), exact.covariance, rtol=0, atol=1e-10)


def test_samples_have_the_posterior_moments(generator):
    model, (x, y) = deep_gp(1, generator), toy(generator)
    posterior = last_layer_posterior(factorise_all(model), torch.zeros(M * T).double(), x, y, generator)
    num = 40_000
    samples = posterior.sample(num, generator)
    assert samples.shape == (num, M, T)
    covariance = torch.cholesky_inverse(posterior.precision_factor)
    std = covariance.diagonal(dim1=1, dim2=2).sqrt()  # "T M"
    # Five standard errors: of a mean std / sqrt(n), of a covariance at most sqrt(2 / n) std_i std_j.
    assert ((samples.mean(0).mT - posterior.mean).abs() <= 5 * std / num**0.5).all()
    for t in range(T):
        error = samples[:, :, t].mT.cov() - covariance[t]
        assert (error.abs() <= 5 * (2 / num) ** 0.5 * std[t].outer(std[t])).all()


def test_weight_counts_a_datum_as_often(generator):
    model, (x, y) = deep_gp(1, generator), toy(generator)
    factorised, start = factorise_all(model), torch.zeros(M * T).double()
    weighted = last_layer_posterior(factorised, start, x, y, generator, weight=2.0)
    twice = last_layer_posterior(factorised, start, x.repeat(2, 1), y.repeat(2, 1), generator)
    torch.testing.assert_close(weighted.mean, twice.mean)
    torch.testing.assert_close(weighted.precision_factor, twice.precision_factor)


def test_a_precision_that_rounding_spoils_is_an_error(generator):
    """Never a posterior under a prior that is stronger than the model's."""
    model, (x, y) = deep_gp(1, generator, "rbf"), toy(generator)
    factorised = factorise_all(model)
    with pytest.raises(FactorisationError):
        last_layer_posterior(factorised, torch.zeros(M * T).double(), x[:2], y[:2], generator, weight=1e19)


def test_gibbs_step_moves_the_last_layer_alone(generator):
    model, (x, y) = deep_gp(2, generator), toy(generator)
    start = sghmc.init(torch.randn(model.num_whitened(), generator=generator, dtype=torch.float64))
    start = start._replace(momentum=torch.ones_like(start.position))
    settings = InferenceSettings()
    after = mcem.gibbs_step(factorise_all(model), start, Data(x, y), generator, settings)
    inner = model.num_inner()
    assert inner == M * D
    torch.testing.assert_close(after.position[:inner], start.position[:inner], rtol=0, atol=0)
    assert not (after.position[inner:] == start.position[inner:]).any()
    assert (after.momentum[:inner] == 1).all()
    assert (after.momentum[inner:] == 0).all()


def test_last_layer_is_laid_out_as_the_model_reads_it(generator):
    """A draw explains the data: through the model its mean prediction beats the prior's by far."""
    model, (x, y) = deep_gp(2, generator), toy(generator)
    factorised = factorise_all(model)
    chain = sghmc.init(torch.zeros(model.num_whitened()).double())
    settings = InferenceSettings()
    before = mcem.negative_log_joint(factorised, chain.position, Data(x, y), N, generator)
    position = mcem.gibbs_step(factorised, chain, Data(x, y), generator, settings).position
    after = mcem.negative_log_joint(factorised, position, Data(x, y), N, generator)
    assert after < before - 1.0


def test_repeated_draws_share_the_inner_layers(generator):
    model, (x, y) = deep_gp(2, generator), toy(generator)
    chain = sghmc.init(torch.randn(model.num_whitened(), generator=generator, dtype=torch.float64))
    positions = mcem.gibbs_positions(factorise_all(model), chain, Data(x, y), 4, generator, InferenceSettings())
    assert positions.shape == (4, model.num_whitened())
    inner = model.num_inner()
    assert (positions[:, :inner] == chain.position[:inner]).all()
    assert positions[:, inner:].std(0).min() > 0


def test_draws_from_some_rows_count_for_all_data(generator):
    """Where all rows are the same, any n of them with the weight N / n say what the N say."""
    model, (x, y) = deep_gp(1, generator), toy(generator)
    num_data, num_rows, num_samples = 64, 4, 20_000
    data = Data(x[:1].repeat(num_data, 1), y[:1].repeat(num_data, 1))
    factorised = factorise_all(model)
    exact = whitened_posterior(model.layers[0], factorised.factors[0], model.noise_variance, *data)
    settings = InferenceSettings(gibbs_rows=num_rows)
    chain = sghmc.init(torch.zeros(M * T).double())
    positions = mcem.gibbs_positions(factorised, chain, data, num_samples, generator, settings)
    # What the data determine: the function's value at the only input, a . v for each target.
    layer = model.layers[0]
    a = (layer.variance.sqrt() * project(layer, factorised.factors[0], x[:1])).squeeze()
    values = torch.einsum("m,nmt->nt", a, positions.unflatten(1, (M, T)))
    variance = torch.einsum("m,tmk,k->t", a, exact.covariance, a)
    # Five standard errors, of a mean and of a variance. Without the weight the variance is more than ten times this.
    assert ((values.mean(0) - a @ exact.mean).abs() <= 5 * (variance / num_samples).sqrt()).all()
    assert ((values.var(0) / variance - 1).abs() <= 5 * (2 / num_samples) ** 0.5).all()


def test_the_last_layer_is_fed_what_the_inner_layers_give(generator):
    """At its own inducing inputs an inner layer is its inducing outputs, so the last one's posterior is closed too."""
    model = deep_gp(2, generator)
    factorised = factorise_all(model)
    inner, last = model.layers
    x = inner.inducing_inputs
    y = torch.stack([x[:, 0].sin(), x[:, 1].cos(), x.sum(-1)], dim=1)
    whitened = 2.0 * torch.randn(model.num_whitened(), generator=generator, dtype=torch.float64)
    outputs = factorised.factors[0] @ model.split(whitened)[0]
    exact = whitened_posterior(last, factorised.factors[1], model.noise_variance, x + outputs, y)
    found = last_layer_posterior(factorised, whitened, x, y, generator)
    # The jitter leaves the inner layer's values a standard deviation of this; the posterior mean moves in proportion,
    # by |y| / noise variance at most.
    spread = float((JITTER * inner.variance).sqrt())
    tolerance = 5 * spread * float(y.abs().max() / model.noise_variance.min())
    torch.testing.assert_close(found.mean.mT, exact.mean, rtol=0, atol=tolerance)
    unfed = whitened_posterior(last, factorised.factors[1], model.noise_variance, x, y)
    assert (unfed.mean - exact.mean).abs().max() > 3 * tolerance
