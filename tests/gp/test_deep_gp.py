"""The composition of layers against quadrature, and the likelihood against scipy."""

import numpy as np
import pytest
import scipy.stats
import torch

from gym_dgpmpc.gp.deep_gp import (
    NOISE_FLOOR,
    factorise_all,
    log_likelihood,
    posterior_mean,
    propagate,
    propagate_means,
)
from gym_dgpmpc.gp.kernels import KERNELS
from tests.oracles import gaussian_process
from tests.oracles.models import chains, dense, make_model, normal, seeded


@pytest.mark.parametrize("num_layers", [1, 2, 3])
def test_the_flat_vector_is_split_by_layer_and_output(num_layers):
    model = make_model(num_layers, 3, 2, 5, seeded())
    assert model.output_sizes() == [3] * (num_layers - 1) + [2]
    assert model.num_whitened() == 5 * (3 * (num_layers - 1) + 2)
    flat = normal(seeded(1), 4, model.num_whitened())
    parts = model.split(flat)
    assert [tuple(part.shape) for part in parts] == [(4, 5, 3)] * (num_layers - 1) + [(4, 5, 2)]
    assert torch.equal(torch.cat([part.flatten(1) for part in parts], dim=1), flat)
    assert torch.equal(model.split(flat[2])[-1], parts[-1][2])


def test_parameters_are_the_models_own():
    model = make_model(2, 3, 2, 5, seeded(), "matern32")
    parameters = model.parameters()
    assert len(parameters) == 2 * 3 + 1
    assert parameters[-1] is model.log_noise and parameters[3] is model.layers[1].inducing_inputs


def test_other_parameters_come_in_the_same_order():
    """Each layer keeps its kernel, also where they differ."""
    first, second = (make_model(1, 3, 3, 5, seeded(), kernel).layers[0] for kernel in ("rbf", "matern12"))
    model = make_model(2, 3, 3, 5, seeded())._replace(layers=(first, second))
    others = [parameter + 1.0 for parameter in model.parameters()]
    moved = model.with_parameters(others)
    assert all(a is b for a, b in zip(moved.parameters(), others, strict=True))
    assert [layer.kernel.name for layer in moved.layers] == ["rbf", "matern12"]


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_single_layer_is_its_conditional(kernel):
    generator = seeded(1)
    model = make_model(1, 3, 2, 6, generator, kernel)
    v, x = normal(generator, 6, 2), normal(generator, 4, 3)
    mean, variance = propagate(factorise_all(model), [v], x, generator)
    exact_mean, exact_covariance = gaussian_process.conditional(kernel, dense(model.layers[0]), v.numpy(), x.numpy())
    np.testing.assert_allclose(mean, exact_mean, atol=1e-8)
    np.testing.assert_allclose(variance, np.diagonal(exact_covariance), atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
def test_two_layers_against_quadrature_over_the_hidden_value(kernel):
    """x -> h ~ N(x + m_1(x), v_1(x) I) -> m_2(h), v_2(h): the moments of m_2 and the mean of v_2, in two dimensions."""
    generator = seeded(4)
    model = make_model(2, 2, 2, 6, generator, kernel)
    whitened = [normal(generator, 6, 2), normal(generator, 6, 2)]
    x = normal(generator, 3, 2)
    inner, outer = (dense(layer) for layer in model.layers)

    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    weights = weights / weights.sum()
    grid = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    weight = np.outer(weights, weights).ravel()
    hidden_mean, hidden_covariance = gaussian_process.conditional(kernel, inner, whitened[0].numpy(), x.numpy())
    spread = np.sqrt(np.diagonal(hidden_covariance))
    hidden = (x.numpy() + hidden_mean)[:, None] + spread[:, None, None] * grid  # [points, nodes, 2]

    draws = 20_000
    expanded = [v.expand(draws, -1, -1) for v in whitened]
    mean, variance = propagate(factorise_all(model), expanded, x.expand(draws, -1, -1), generator)
    for point in range(3):
        # One node at a time: the marginals of each hidden value are all that propagation uses.
        m, v = gaussian_process.conditional(kernel, outer, whitened[1].numpy(), hidden[point][:, None])
        m, v = m[:, 0], v[:, 0, 0]
        exact_mean = weight @ m
        exact_covariance = (m - exact_mean).T @ (weight[:, None] * (m - exact_mean))
        standard_error = np.sqrt(np.diagonal(exact_covariance) / draws)
        found = mean[:, point].numpy()
        assert (abs(found.mean(0) - exact_mean) < 5 * standard_error + 1e-5).all()
        fourth = weight @ (m - exact_mean) ** 4
        error = 5 * np.sqrt((fourth - np.diagonal(exact_covariance) ** 2) / draws) + 1e-5
        assert (abs(found.var(0) - np.diagonal(exact_covariance)) < error).all()
        spread_of_variance = np.sqrt(weight @ (v - weight @ v) ** 2 / draws)
        assert abs(variance[:, point].mean().item() - weight @ v) < 5 * spread_of_variance + 1e-5


def test_points_and_particles_have_noise_of_their_own():
    generator = seeded(4)
    model = make_model(2, 2, 1, 6, generator)
    whitened = [v.expand(5000, -1, -1) for v in model.split(normal(generator, model.num_whitened()))]
    x = normal(generator, 1, 2).expand(5000, 2, 2)  # the same point twice
    mean, _ = propagate(factorise_all(model), whitened, x, generator)
    correlation = np.corrcoef(mean[..., 0].numpy().T)[0, 1]
    assert abs(correlation) < 5 / np.sqrt(5000)
    assert len(mean.unique()) == mean.numel()


def test_the_likelihood_is_that_of_scipy():
    generator = seeded()
    model = make_model(1, 3, 2, 5, generator)
    mean, variance, target = normal(generator, 4, 6, 2), normal(generator, 4, 6).square(), normal(generator, 6, 2)
    scale = (variance.unsqueeze(-1) + model.noise_variance).sqrt()
    exact = scipy.stats.norm(mean.numpy(), scale.numpy()).logpdf(target.numpy()).sum(-1)
    np.testing.assert_allclose(log_likelihood(model, mean, variance, target), exact, rtol=1e-12)


def test_the_noise_has_a_floor():
    model = make_model(1, 3, 2, 5, seeded())
    vanishing = model._replace(log_noise=torch.full((2,), -1e3, dtype=torch.float64))
    assert vanishing.noise_variance.tolist() == [NOISE_FLOOR] * 2


def two_chains(num_layers):
    """Two models, also side by side, and a whitened sample of each."""
    generator = seeded(6)
    models = [make_model(num_layers, 3, 2, 5, generator, "matern52") for _ in range(2)]
    return models, chains(*models), normal(generator, 2, models[0].num_whitened()), normal(generator, 4, 3)


@pytest.mark.parametrize("num_layers", [1, 2, 3])
def test_the_models_of_chains_are_each_on_its_own(num_layers, monkeypatch):
    models, together, whitened, x = two_chains(num_layers)
    assert together.output_sizes() == models[0].output_sizes()
    assert (together.num_whitened(), together.num_inner()) == (models[0].num_whitened(), models[0].num_inner())
    noise, target = normal(seeded(8), 4, 3), normal(seeded(9), 4, 2)
    # The same noise for all chains, so that each can be asked alone.
    monkeypatch.setattr(torch, "randn", lambda shape, **_: noise.expand(shape))
    factorised = factorise_all(together)
    mean, variance = propagate(factorised, together.split(whitened), x.expand(2, -1, -1), seeded())
    means = propagate_means(factorised, together.split(whitened), x.expand(2, -1, -1))
    density = log_likelihood(together, mean, variance, target)
    for c, model in enumerate(models):
        alone = factorise_all(model)
        own_mean, own_variance = propagate(alone, model.split(whitened[c]), x, seeded())
        torch.testing.assert_close(mean[c], own_mean, rtol=0, atol=1e-8)
        torch.testing.assert_close(variance[c], own_variance, rtol=0, atol=1e-8)
        own_means = propagate_means(alone, model.split(whitened[c]), x)
        torch.testing.assert_close(means[c], own_means, rtol=0, atol=1e-8)
        own_density = log_likelihood(model, mean[c], variance[c], target)
        torch.testing.assert_close(density[c], own_density, rtol=1e-12, atol=1e-12)


def test_chains_may_be_picked():
    models, together, _, _ = two_chains(2)
    picked = together.at(torch.tensor([1, 0, 1]))
    expected = chains(models[1], models[0], models[1])
    assert all(torch.equal(a, b) for a, b in zip(picked.parameters(), expected.parameters(), strict=True))


@pytest.mark.parametrize(("num_samples", "rows"), [(1, [0]), (2, [0, 1]), (5, [0, 3])])
def test_the_posterior_mean_is_that_of_two_samples_of_each_chain(num_samples, rows):
    models, together, _, x = two_chains(2)
    pool = normal(seeded(1), num_samples, 2, together.num_whitened())
    each = [
        propagate_means(factorise_all(model), model.split(pool[row, c]), x)
        for row in rows
        for c, model in enumerate(models)
    ]
    found = posterior_mean(factorise_all(together), pool)(x)
    torch.testing.assert_close(found, torch.stack(each).mean(0), rtol=0, atol=1e-8)
