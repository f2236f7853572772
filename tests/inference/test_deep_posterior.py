"""The sampler against the joint posterior of two layers: chains that start in it stay in it.

The problem is so small that draws from the prior, weighted by the likelihood with the last layer integrated out, are
the exact posterior. Thousands of chains start at such draws. Whatever moves them must leave their law as it is; latents
that are drawn from their prior, or an exact draw of the last layer given such, do not.
"""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp.deep_gp import DeepGP, factorise_all
from gym_dgpmpc.gp.kernels import find_kernel
from gym_dgpmpc.gp.layer import Layer, conditional, project
from gym_dgpmpc.inference import sghmc
from gym_dgpmpc.inference.sampler import Chains, ChainState, flatten
from gym_dgpmpc.inference.settings import InferenceSettings
from tests.oracles import sghmc as oracle
from tests.oracles.models import chains as side_by_side
from tests.oracles.models import normal, seeded

X = torch.tensor([[-1.2], [-0.8], [-0.3], [0.1], [0.5], [1.1]], dtype=torch.float64)
Y = torch.tensor([[-1.2], [-1.0], [-0.9], [1.0], [1.1], [0.8]], dtype=torch.float64)
NUM_CHAINS, NUM_PRIOR = 3000, 200_000


def two_layers():
    """A step in six data, and two inducing inputs: what lies between these is unknown, but the data say much of it."""
    centres = torch.tensor([[-0.6], [0.7]], dtype=torch.float64)

    def layer(variance, lengthscale):
        logs = (torch.tensor(value, dtype=torch.float64).log() for value in ([lengthscale], variance))
        return Layer(find_kernel("matern32"), centres, *logs)

    return DeepGP((layer(0.5, 1.0), layer(4.0, 2.0)), torch.tensor([0.05], dtype=torch.float64).log())


class Exact(NamedTuple):
    """The posterior: its moments, and a draw for each chain."""

    mean: torch.Tensor  # "V"
    std: torch.Tensor  # "V"
    sharpest: float
    """Mean of the last layer's largest precision, per datum, given all else: the most that SG-HMC's steps meet."""
    worth: float
    """Independent draws that would know the moments as well."""
    position: torch.Tensor  # "C V"
    latent: torch.Tensor  # "C N 1"


@pytest.fixture(scope="module")
def exact():
    model, generator = two_layers(), seeded(1)
    (inner, last), noise = model.layers, model.noise_variance
    factors = factorise_all(model).factors
    v, latent = normal(generator, NUM_PRIOR, 2, 1), normal(generator, NUM_PRIOR, len(X), 1)
    mean, variance = conditional(inner, factors[0], v, X.expand(NUM_PRIOR, -1, -1))
    hidden = X + mean + variance.sqrt().unsqueeze(-1) * latent
    a = last.variance.sqrt() * project(last, factors[1], hidden)  # "S M N"
    spread = last.variance - a.square().sum(-2) + noise
    evidence = torch.distributions.MultivariateNormal(0 * Y[:, 0], a.mT @ a + torch.diag_embed(spread))
    log_weight = evidence.log_prob(Y[:, 0])
    weight = (log_weight - log_weight.logsumexp(0)).exp()
    weighted = a / spread.unsqueeze(-2)
    precision = torch.eye(2).double() + weighted @ a.mT
    covariance = torch.linalg.inv(precision)
    last_mean = (covariance @ weighted @ Y).squeeze(-1)
    moments = torch.cat([v[..., 0], last_mean], dim=1)
    mean = weight @ moments
    variance = weight @ (moments - mean).square()
    variance[2:] += weight @ covariance.diagonal(dim1=-2, dim2=-1)
    pick = torch.multinomial(weight, NUM_CHAINS, replacement=True, generator=generator)
    root = torch.linalg.cholesky(covariance[pick])
    drawn = last_mean[pick] + (root @ normal(generator, NUM_CHAINS, 2, 1)).squeeze(-1)
    sharpest = float(torch.linalg.eigvalsh(precision[pick])[:, -1].mean()) / len(X)
    worth = float(1.0 / weight.square().sum())
    return Exact(mean, variance.sqrt(), sharpest, worth, torch.cat([v[pick, :, 0], drawn], dim=1), latent[pick])


@pytest.mark.usefixtures("unchecked")  # hundreds of steps
@pytest.mark.parametrize("gibbs_every", [0, 2])
def test_chains_that_start_in_the_posterior_stay_in_it(gibbs_every, exact):
    """Means and standard deviations within four standard errors, the latter besides what the step size bends.

    Chains are independent: how much their averages over time differ is the standard error. Latents from their prior
    at each step make the standard deviations twice as large.
    """
    generator, one = seeded(2), two_layers()
    model = side_by_side(*[one] * NUM_CHAINS)
    state = ChainState(sghmc.init(exact.position), sghmc.init(flatten(model.parameters())), [exact.latent.clone()])
    settings = InferenceSettings(step_size=0.08, decay=0.1, gibbs_every=gibbs_every)
    chains, seen = Chains(model, state, Data(X, Y), settings, 0), []
    for step in range(200):
        chains.step(generator, frozen=True)
        if gibbs_every and step % gibbs_every == 0:
            chains.draw_last_layer(generator)
        if step >= 100 and step % 10 == 0:
            seen.append(chains.state.whitened.position)
    away = torch.stack(seen) - exact.mean  # "n C V"
    assert not (away[0] == away[-1]).any()
    # On a quadratic potential as sharp as that of the last layer at its sharpest; the others are flatter.
    wide = oracle.stationary_covariance(np.array([[exact.sharpest]]), np.ones(1), len(X), 0.08, 0.1)
    bent = math.sqrt(float(wide[0, 0]) * len(X) * exact.sharpest) - 1.0
    assert 0.0 < bent < 0.04
    for power, expected, allowed in ((1, 0.0 * exact.mean, 0.0), (2, exact.std.square(), 2.0 * bent)):
        averages = (away**power).mean(0)
        error = averages.std(0) * (1.0 / NUM_CHAINS + 1.0 / exact.worth) ** 0.5
        scale = exact.std**power
        assert ((averages.mean(0) - expected).abs() < 4 * error + allowed * scale).all()
