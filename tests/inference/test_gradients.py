"""The gradients in closed form against automatic differentiation of the layers' own conditionals."""

import pytest
import torch

from gym_dgpmpc.gp import exact
from gym_dgpmpc.gp.deep_gp import Factorised, factorise_all, log_likelihood
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import conditional
from gym_dgpmpc.inference.gradients import (
    LEAST_VARIANCE,
    forward,
    gradients,
    layer_terms,
    likelihood,
    take,
    take_passed,
)
from tests.oracles.models import chains, make_model, normal, seeded


def problem(num_layers, kernel="matern32", num_points=17):
    """Two chains, a batch, and latents."""
    generator = seeded(3)
    model = chains(*(make_model(num_layers, 3, 2, 6, generator, kernel) for _ in range(2)))
    whitened = normal(generator, 2, model.num_whitened())
    latents = [normal(generator, 2, num_points, 3) for _ in range(num_layers - 1)]
    return model, whitened, normal(generator, num_points, 3), normal(generator, num_points, 2), latents


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("num_layers", [1, 2, 3])
def test_automatic_differentiation_agrees(num_layers, kernel):
    model, whitened, x, y, latents = problem(num_layers, kernel)
    factors = factorise_all(model).factors
    parameters = [parameter.requires_grad_() for parameter in model.parameters()]
    live, whitened = Factorised(model.with_parameters(parameters), factors), whitened.requires_grad_()
    hidden = x.expand(2, -1, -1)
    for layer, factor, v, latent in zip(
        live.model.layers, factors, model.split(whitened), [*latents, None], strict=True
    ):
        mean, variance = conditional(layer, factor, v, hidden)
        if latent is not None:
            hidden = hidden + mean + variance.clamp_min(LEAST_VARIANCE).sqrt().unsqueeze(-1) * latent
    expected = log_likelihood(live.model, mean, variance, y)
    automatic = torch.autograd.grad(expected.mean(-1).sum(), [whitened, *parameters])

    factorised = live.detach()
    terms, by_layer = layer_terms(factorised), model.split(whitened.detach())
    passed = forward(terms, by_layer, x.expand(2, -1, -1), latents)
    torch.testing.assert_close(likelihood(factorised, passed, y), expected.detach(), rtol=1e-9, atol=1e-9)
    found = gradients(factorised, terms, by_layer, passed, latents, y, of_parameters=True)
    for one, other in zip([found.whitened, *found.parameters], automatic, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-8 * float(other.abs().max() + 1))
    without = gradients(factorised, terms, by_layer, passed, latents, y, of_parameters=False)
    assert torch.equal(without.whitened, found.whitened) and without.parameters is None


@pytest.mark.parametrize("kernel", KERNELS)
def test_one_layer_has_the_gradient_of_the_closed_form_posterior(kernel):
    model, whitened, x, y, _ = problem(1, kernel)
    factorised, terms = factorise_all(model), None
    terms = layer_terms(factorised)
    by_layer = model.split(whitened)
    passed = forward(terms, by_layer, x.expand(2, -1, -1), [])
    found = gradients(factorised, terms, by_layer, passed, [], y, of_parameters=False)
    for chain in range(2):
        one = model.with_parameters([parameter[chain] for parameter in model.parameters()])
        posterior = exact.whitened_posterior(one.layers[0], factorised.factors[0][chain], one.noise_variance, x, y)
        precision = torch.linalg.inv(posterior.covariance)
        away = (by_layer[0][chain] - posterior.mean).mT.unsqueeze(-1)
        # That of the likelihood alone: the prior's is -v.
        expected = -(precision @ away).squeeze(-1).mT + by_layer[0][chain]
        torch.testing.assert_close(found.whitened[chain].view(expected.shape), expected / len(y), rtol=1e-7, atol=1e-9)


def test_what_the_first_layer_saw_may_be_given():
    model, whitened, x, _, latents = problem(2)
    terms, by_layer = layer_terms(factorise_all(model)), model.split(whitened)
    passed = forward(terms, by_layer, x.expand(2, -1, -1), latents)
    again = forward(terms, by_layer, x.expand(2, -1, -1), latents, passed[0].seen)
    assert all(
        torch.equal(a.mean, b.mean) and torch.equal(a.variance, b.variance) for a, b in zip(passed, again, strict=True)
    )


def test_points_may_be_taken():
    """Some points pass as they do among others, of each chain its own."""
    model, whitened, x, _, latents = problem(3)
    factorised, by_layer = factorise_all(model), model.split(whitened)
    terms = layer_terms(factorised)
    passed = forward(terms, by_layer, x.expand(2, -1, -1), latents)
    rows = torch.tensor([[0, 3, 3, 16], [5, 2, 1, 0]])
    some = [take_passed(layer, rows) for layer in passed]
    chosen = torch.stack([x[each] for each in rows])
    again = forward(terms, by_layer, chosen, [take(latent, rows) for latent in latents])
    for one, other in zip(some, again, strict=True):
        for a, b in zip((*one.seen, one.mean, one.variance), (*other.seen, other.mean, other.variance), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)
