"""The sampler against the joint posterior by importance sampling: inducing outputs of two layers, and hyperparameters.

Both problems are so small that draws from the prior, weighted by the likelihood with the last layer integrated out, give
the exact moments. Hundreds of chains go side by side, so that the standard error of what they give is that of
independent draws.
"""

import math

import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp.deep_gp import DeepGP, factorise_all
from gym_dgpmpc.gp.kernels import find_kernel
from gym_dgpmpc.gp.layer import Layer, conditional, project
from gym_dgpmpc.inference import priors
from gym_dgpmpc.inference.sampler import Chains, InferenceSettings, initial_state, with_flat
from tests.oracles.models import normal, seeded

X = torch.tensor([[-1.0], [0.2], [0.9]], dtype=torch.float64)
Y = torch.tensor([[1.3], [-0.4], [0.6]], dtype=torch.float64)
KERNEL = find_kernel("matern32")


def weighted_moments(values, log_weight):
    """Mean and standard deviation of each column, and how many independent draws the weights are worth."""
    weight = (log_weight - log_weight.logsumexp(0)).exp()
    mean = weight @ values
    return mean, (weight @ (values - mean).square()).sqrt(), float(1.0 / weight.square().sum())


def last_layer(layer, factor, noise, hidden):
    """log p(y) with v_L integrated out, and the moments of v_L, at hidden values "S N D" (or "N D" and S layers)."""
    a = layer.variance.sqrt()[..., None, None] * project(layer, factor, hidden)  # "S M N"
    spread = layer.variance[..., None] - a.square().sum(-2) + noise
    marginal = torch.distributions.MultivariateNormal(Y[:, 0] * 0, a.mT @ a + torch.diag_embed(spread))
    covariance = torch.linalg.inv(torch.eye(a.shape[-2]).double() + (a / spread.unsqueeze(-2)) @ a.mT)
    mean = (covariance @ (a / spread.unsqueeze(-2)) @ Y).squeeze(-1)
    return marginal.log_prob(Y[:, 0]), mean, covariance.diagonal(dim1=-2, dim2=-1)


@pytest.mark.parametrize("gibbs_every", [0, 2])
def test_two_layers(gibbs_every):
    """Where inducing inputs are few, what lies between them is unknown, and the data say what it was there."""
    centres = torch.tensor([[-0.6], [0.7]], dtype=torch.float64)

    def layer(variance, lengthscale):
        logs = (torch.tensor(value, dtype=torch.float64).log() for value in ([lengthscale], variance))
        return Layer(KERNEL, centres, *logs)

    inner, last = layer(1.0, 0.5), layer(1.5, 0.8)
    noise = torch.tensor([0.02], dtype=torch.float64)
    factorised = factorise_all(DeepGP((inner, last), noise.log()))

    count, generator = 400_000, seeded(1)
    v, latent = normal(generator, count, 2, 1), normal(generator, count, 3, 1)
    mean, variance = conditional(inner, factorised.factors[0], v, X.expand(count, -1, -1))
    hidden = X + mean + variance.sqrt().unsqueeze(-1) * latent
    evidence, last_mean, last_variance = last_layer(last, factorised.factors[1], noise, hidden)
    exact, std, worth = weighted_moments(torch.cat([v[..., 0], last_mean], dim=1), evidence)
    weight = (evidence - evidence.logsumexp(0)).exp()
    std[2:] = (std[2:].square() + weight @ last_variance).sqrt()
    assert worth > 2000

    chains = 400
    model = DeepGP((inner, last), noise.log()).at_all(chains)
    settings = InferenceSettings(
        step_size=0.05, decay=0.1, gibbs_every=gibbs_every, hyperparameters_every=10**9, batch_size=3
    )
    run = Chains(model, initial_state(model, normal(generator, chains, 4), 3, generator), Data(X, Y), settings, 0)
    for _ in range(1500):
        run.step(generator)
    kept = []
    for _ in range(500):
        run.step(generator, burn_in=False)
        kept.append(run.state.whitened.position)
    positions = torch.stack(kept)
    by_chain = positions.mean(0)
    error = by_chain.std(0) / chains**0.5 + std / worth**0.5
    print(exact, std, worth, positions.mean((0, 1)), positions.flatten(0, 1).std(0), error)
    assert ((positions.mean((0, 1)) - exact).abs() < 5 * error + 0.03 * std).all()
    ratio = positions.flatten(0, 1).std(0) / std
    print(ratio)
    assert ((ratio - 1.0).abs() < 0.15).all()
