"""The last layer's inducing outputs given everything else, in closed form.

Given the inner layers' inducing outputs and one draw of what they feed the last layer, the likelihood is linear and
Gaussian in v_L, so v_L can be drawn exactly instead of by many SG-HMC steps. `mcem.py` uses it as a Gibbs step
between SG-HMC steps: the chain forgets its start at once in the layer that the data determine most, and new data
count in full as soon as they are observed.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.deep_gp import Factorised, propagate_inner
from gym_dgpmpc.gp.layer import project
from gym_dgpmpc.gp.linalg import cholesky


class LastLayerPosterior(NamedTuple):
    """p(v_L | y, inner layers): independent Gaussians over the targets, N(mean_t, (R_t R_t^T)^-1)."""

    mean: Float[Tensor, "T M"]
    precision_factor: Float[Tensor, "T M M"]

    def sample(self, num_samples: int, generator: torch.Generator) -> Float[Tensor, "n M T"]:
        """Independent draws."""
        targets, inducing = self.mean.shape
        noise = torch.randn(
            targets, inducing, num_samples, generator=generator, dtype=self.mean.dtype, device=self.mean.device
        )
        spread = torch.linalg.solve_triangular(self.precision_factor.mT, noise, upper=True)
        return (self.mean.unsqueeze(-1) + spread).permute(2, 1, 0)


def last_layer_posterior(
    factorised: Factorised,
    whitened: Float[Tensor, "V"],
    x: Float[Tensor, "n D"],
    y: Float[Tensor, "n T"],
    generator: torch.Generator,
    weight: float = 1.0,
) -> LastLayerPosterior:
    """Bayesian linear regression on a_n = L_z^-1 k_zn whose datum n has the noise s_n = k_nn - |a_n|^2 + noise.

    precision = I + sum_n a_n a_n^T / s_n,  mean = precision^-1 sum_n a_n y_n / s_n, under the likelihood of
    `deep_gp.log_likelihood` and one sample of the inner layers' function values at the data.

    Args:
        whitened: flat vector of all layers; its last layer is not used.
        weight: how often each datum counts: N / n where the rows are a subset of the data.

    Raises:
        FactorisationError: the precision is not finite, or so large that rounding hides the prior.
    """
    model, factors = factorised
    last = model.layers[-1]
    hidden = propagate_inner(factorised, model.split(whitened), x, generator)
    a = last.variance.sqrt() * project(last, factors[-1], hidden)
    variance = (last.variance - a.square().sum(0)).clamp_min(0.0)
    weights = weight / (variance + model.noise_variance.unsqueeze(-1))
    weighted = a * weights.unsqueeze(1)
    prior = torch.eye(a.shape[-2], dtype=a.dtype, device=a.device)
    # No eigenvalue lies below the prior's one, so no jitter is needed.
    factor = cholesky(weighted @ a.mT + prior, torch.ones_like(weights[0, 0]), jitter=0.0)
    mean = torch.cholesky_solve(weighted @ y.mT.unsqueeze(-1), factor).squeeze(-1)
    return LastLayerPosterior(mean, factor)
