"""The sampler against the joint posterior of two layers: chains that start in it stay in it.

The problem is so small that draws from the prior, weighted by the likelihood with the last layer integrated out, are
the exact posterior. A thousand chains start at such draws. Whatever moves them must leave their law as it is; latents
that are drawn from their prior, or an exact draw of the last layer given such, do not.
"""

import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp.deep_gp import DeepGP, factorise_all
from gym_dgpmpc.gp.kernels import find_kernel
from gym_dgpmpc.gp.layer import Layer, conditional, project
from gym_dgpmpc.inference import sghmc
from gym_dgpmpc.inference.sampler import Chains, ChainState, flatten
from gym_dgpmpc.inference.settings import InferenceSettings
from tests.oracles.models import normal, seeded

X = torch.tensor([[-1.2], [-0.8], [-0.3], [0.1], [0.5], [1.1]], dtype=torch.float64)
Y = torch.tensor([[-1.2], [-1.0], [-0.9], [1.0], [1.1], [0.8]], dtype=torch.float64)
NUM_CHAINS, NUM_PRIOR = 1000, 400_000


def two_layers():
    """A step in six data, and two inducing inputs: what lies between these is unknown, but the data say much of it."""
    centres = torch.tensor([[-0.6], [0.7]], dtype=torch.float64)

    def layer(variance, lengthscale):
        logs = (torch.tensor(value, dtype=torch.float64).log() for value in ([lengthscale], variance))
        return Layer(find_kernel("matern32"), centres, *logs)

    return DeepGP((layer(0.5, 1.0), layer(4.0, 2.0)), torch.tensor([0.05], dtype=torch.float64).log())


def exact_draws(model, generator):
    """(positions "C V", latents "C N 1") from the posterior, and its means and standard deviations "V"."""
    (inner, last), noise = model.layers, model.noise_variance
    factors = factorise_all(model).factors
    v, latent = normal(generator, NUM_PRIOR, 2, 1), normal(generator, NUM_PRIOR, len(X), 1)
    mean, variance = conditional(inner, factors[0], v, X.expand(NUM_PRIOR, -1, -1))
    hidden = X + mean + variance.sqrt().unsqueeze(-1) * latent
    a = last.variance.sqrt() * project(last, factors[1], hidden)  # "S M N"
    spread = last.variance - a.square().sum(-2) + noise
    evidence = torch.distributions.MultivariateNormal(0 * Y[:, 0], a.mT @ a + torch.diag_embed(spread)).log_prob(
        Y[:, 0]
    )
    weighted = a / spread.unsqueeze(-2)
    covariance = torch.linalg.inv(torch.eye(2).double() + weighted @ a.mT)
    last_mean = (covariance @ weighted @ Y).squeeze(-1)
    weight = (evidence - evidence.logsumexp(0)).exp()
    assert 1.0 / weight.square().sum() > 20 * NUM_CHAINS, "the weights are worth many draws"
    moments = torch.cat([v[..., 0], last_mean], dim=1)
    mean = weight @ moments
    variance = weight @ (moments - mean).square()
    variance[2:] += weight @ covariance.diagonal(dim1=-2, dim2=-1)
    pick = torch.multinomial(weight, NUM_CHAINS, replacement=True, generator=generator)
    root = torch.linalg.cholesky(covariance[pick])
    drawn = last_mean[pick] + (root @ normal(generator, NUM_CHAINS, 2, 1)).squeeze(-1)
    return torch.cat([v[pick, :, 0], drawn], dim=1), latent[pick], mean, variance.sqrt()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("gibbs_every", [0, 2])
def test_chains_that_start_in_the_posterior_stay_in_it(gibbs_every):
    """Within five standard errors of independent draws, and 3 % that the step size may bend standard deviations by."""
    generator, one = seeded(1), two_layers()
    position, latent, mean, std = exact_draws(one, generator)
    model = one.at_all(NUM_CHAINS)
    state = ChainState(sghmc.init(position), sghmc.init(flatten(model.parameters())), [latent])
    settings = InferenceSettings(step_size=0.08, decay=0.1, gibbs_every=gibbs_every)
    chains = Chains(model, state, Data(X, Y), settings, 0)
    for step in range(400):
        chains.step(generator, frozen=True)
        if gibbs_every and step % gibbs_every == 0:
            chains.draw_last_layer(generator)
    found = chains.state.whitened.position
    assert not torch.equal(found, position)
    assert ((found.mean(0) - mean).abs() < 5 * std / NUM_CHAINS**0.5).all()
    # The fourth moments are not those of a Gaussian, whose standard error is (2 n)^-1/2; twice that is ample.
    assert ((found.std(0) / std - 1.0).abs() < 0.03 + 5 * 2 * (2 * NUM_CHAINS) ** -0.5).all()
