"""The priors of hyperparameters: their gradient against that of the densities themselves, and what is plausible."""

import math

import pytest
import torch

from gym_dgpmpc.inference import priors
from tests.oracles.models import chains, make_model, seeded


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("num_layers", [1, 3])
def test_the_gradient_is_that_of_normal_densities(num_layers, linear):
    """About lengthscales of sqrt(D), variances of 1 (inner layers: 0.01), slopes of 0.5, noise variances of 0.05."""
    model = chains(*(make_model(num_layers, 3, 2, 4, seeded(seed), linear=linear) for seed in (0, 1)))
    leaves = [parameter.clone().requires_grad_() for parameter in model.parameters()]
    live, log_density = model.with_parameters(leaves), torch.zeros((), dtype=torch.float64)

    def normal(values, centre, width):
        return torch.distributions.Normal(values.new_tensor(centre), values.new_tensor(width)).log_prob(values).sum()

    for index, layer in enumerate(live.layers):
        log_density = log_density + normal(layer.inducing_inputs, 0.0, 10.0)
        variance = 1.0 if index == num_layers - 1 else 0.01
        for parameter, centre in ((layer.log_lengthscale, math.sqrt(3.0)), (layer.log_variance, variance)):
            log_density = log_density + normal(parameter, math.log(centre), 3.0)
        if layer.log_slope is not None:
            log_density = log_density + normal(layer.log_slope, math.log(0.5), 3.0)
    log_density = log_density + normal(live.log_noise, math.log(0.05), 3.0)
    found = priors.log_prior_gradient(model)
    for one, other in zip(found, torch.autograd.grad(log_density, leaves), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("which", ["log_variance", "log_noise"])
@pytest.mark.parametrize(
    ("value", "plausible"), [(14.9, True), (15.1, False), (-1e3, True), (float("nan"), False), (float("inf"), False)]
)
def test_variances_that_are_absurd_are_not_plausible(which, value, plausible):
    """In any chain; a variance that vanishes is no fault."""
    model = chains(*(make_model(2, 3, 2, 4, seeded(seed)) for seed in (0, 1)))
    assert priors.are_plausible(model)
    (model.log_noise if which == "log_noise" else model.layers[0].log_variance)[1] = value
    assert priors.are_plausible(model) is plausible
