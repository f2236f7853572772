"""The gradients in closed form against automatic differentiation of the layers' own conditionals."""

import pytest
import torch

from gym_dgpmpc.gp import exact
from gym_dgpmpc.gp.deep_gp import Factorised, factorise_all, log_likelihood
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import conditional
from gym_dgpmpc.inference.gradients import LEAST_VARIANCE, forward, gradients, likelihood, pass_first, prepare
from gym_dgpmpc.inference.layers import choose, see
from tests.oracles.models import chains, make_model, normal, seeded


def problem(num_layers, kernel="matern32", num_points=17, *, linear=False):
    """Two chains, a batch, and latents."""
    generator = seeded(3)
    model = chains(*(make_model(num_layers, 3, 2, 6, generator, kernel, linear=linear) for _ in range(2)))
    whitened = normal(generator, 2, model.num_whitened())
    latents = [normal(generator, 2, num_points, 3) for _ in range(num_layers - 1)]
    return model, whitened, normal(generator, num_points, 3), normal(generator, num_points, 2), latents


@pytest.mark.parametrize(("compile", "linear"), [(True, False), (False, False), (True, True), (False, True)])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("num_layers", [1, 2, 3])
def test_automatic_differentiation_agrees(num_layers, kernel, compile, linear):
    model, whitened, x, y, latents = problem(num_layers, kernel, linear=linear)
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

    prepared, by_layer = prepare(model, compile=compile), model.split(whitened.detach())
    passed = forward(prepared, by_layer, x.expand(2, -1, -1), latents)
    torch.testing.assert_close(likelihood(prepared, passed, y), expected.detach(), rtol=1e-9, atol=1e-9)
    found = gradients(prepared, by_layer, passed, latents, y, of_parameters=True)
    for one, other in zip([found.whitened, *found.parameters], automatic, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-8 * float(other.abs().max() + 1))
    without = gradients(prepared, by_layer, passed, latents, y, of_parameters=False)
    assert torch.equal(without.whitened, found.whitened) and without.parameters is None


@pytest.mark.parametrize("compile", [True, False])
@pytest.mark.parametrize("kernel", KERNELS)
def test_one_layer_has_the_gradient_of_the_closed_form_posterior(kernel, compile):
    model, whitened, x, y, _ = problem(1, kernel)
    factors, prepared = factorise_all(model).factors, prepare(model, compile=compile)
    by_layer = model.split(whitened)
    passed = forward(prepared, by_layer, x.expand(2, -1, -1), [])
    found = gradients(prepared, by_layer, passed, [], y, of_parameters=False)
    for chain in range(2):
        one = model.with_parameters([parameter[chain] for parameter in model.parameters()])
        posterior = exact.whitened_posterior(one.layers[0], factors[0][chain], one.noise_variance, x, y)
        precision = torch.linalg.inv(posterior.covariance)
        away = (by_layer[0][chain] - posterior.mean).mT.unsqueeze(-1)
        # That of the likelihood alone: the prior's is -v.
        expected = -(precision @ away).squeeze(-1).mT + by_layer[0][chain]
        torch.testing.assert_close(found.whitened[chain].view(expected.shape), expected / len(y), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("num_layers", [1, 2])
def test_how_points_pass_the_first_layer_may_be_given(num_layers):
    model, whitened, x, _, latents = problem(num_layers)
    prepared, by_layer, points = prepare(model), model.split(whitened), x.expand(2, -1, -1)
    first = pass_first(prepared, by_layer[0], see(prepared.layers[0], points))
    passed, again = forward(prepared, by_layer, points, latents), forward(prepared, by_layer, points, latents, first)
    assert again[0] is first
    for one, other in zip(passed, again, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(numbers(one), numbers(other), strict=True))


@pytest.mark.parametrize("compile", [True, False])
def test_each_point_may_be_chosen_from_two_ways(compile):
    """As it passes with the latents of that way, of each chain its own."""
    model, whitened, x, _, latents = problem(3)
    others = [normal(seeded(8 + index), *latent.shape) for index, latent in enumerate(latents)]
    prepared, by_layer, points = prepare(model, compile=compile), model.split(whitened), x.expand(2, -1, -1)
    mask = torch.rand(2, 17, generator=seeded(5)) < 0.5
    mixed = [torch.where(mask.unsqueeze(-1), *pair) for pair in zip(latents, others, strict=True)]
    ways = [forward(prepared, by_layer, points, each) for each in (latents, others, mixed)]
    for layer, one, other, expected in zip(prepared.layers, *ways, strict=True):
        found = choose(layer, mask, one, other)
        # The same sums, whose order may depend on where a point stands.
        for a, b in zip(numbers(found), numbers(expected), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)


def numbers(passed):
    """All of a layer's, in one tuple."""
    return *passed.seen, passed.mean, passed.variance
