"""The last layer's inducing outputs given everything else, in closed form.

Given what the inner layers feed the last one, the likelihood is linear and Gaussian in v_L, so v_L can be drawn exactly
instead of by many SG-HMC steps. `sampler.py` uses it as a Gibbs step between SG-HMC steps: the chain forgets its start
at once in the layer that the data determine most, and new data count in full as soon as they are observed. It is a
step of the joint posterior because the latents of the inner layers, which say what the last one is fed, are part of the
chain's state; drawn from their prior instead, they would make the draw far too wide.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.errors import FactorisationError
from gym_dgpmpc.gp.linalg import Factorise, by_lapack, cholesky
from gym_dgpmpc.inference.gradients import Prepared
from gym_dgpmpc.inference.layers import Passed, gram


class LastLayerPosterior(NamedTuple):
    """p(v_L | y, inner layers): independent Gaussians over chains and targets, N(mean, (R R^T)^-1)."""

    mean: Float[Tensor, "C T M"]
    precision_factor: Float[Tensor, "C T M M"]

    def sample(self, num_samples: int, generator: torch.Generator) -> Float[Tensor, "n C M T"]:
        """Independent draws."""
        shape = (*self.mean.shape, num_samples)
        noise = torch.randn(shape, generator=generator, dtype=self.mean.dtype, device=self.mean.device)
        spread = torch.linalg.solve_triangular(self.precision_factor.mT, noise, upper=True)
        return (self.mean.unsqueeze(-1) + spread).permute(3, 0, 2, 1)

    def positions(
        self, inner: Float[Tensor, "C I"], num_samples: int, generator: torch.Generator
    ) -> Float[Tensor, "n C V"]:
        """Draws behind the inner layers' inducing outputs, which they share."""
        drawn = self.sample(num_samples, generator).flatten(-2)
        return torch.cat([inner.expand(num_samples, -1, -1), drawn], dim=-1)


class LastLayerEvidence(NamedTuple):
    """What data say of v_L: of independent data the sum of what each says."""

    precision: Float[Tensor, "C T M M"]
    moment: Float[Tensor, "C T M"]

    def plus(self, other: "LastLayerEvidence") -> "LastLayerEvidence":
        """Of both data."""
        return LastLayerEvidence(self.precision + other.precision, self.moment + other.moment)

    def posterior(self, factorise: Factorise = by_lapack) -> LastLayerPosterior:
        """With the standard normal prior.

        Raises:
            FactorisationError: the precision or the mean is not finite, or the precision so large that rounding hides
                the prior.
        """
        prior = torch.eye(self.moment.shape[-1], dtype=self.moment.dtype, device=self.moment.device)
        # No eigenvalue lies below the prior's one, so no jitter is needed.
        factor = cholesky(self.precision + prior, jitter=0.0, factorise=factorise)
        mean = torch.cholesky_solve(self.moment.unsqueeze(-1), factor).squeeze(-1)
        if not bool(mean.isfinite().all()):  # targets are in the moment alone
            raise FactorisationError(
                "the mean of the last layer's posterior is not finite: check whether all targets are, and are plausible"
            )
        return LastLayerPosterior(mean, factor)


def last_layer_evidence(
    prepared: Prepared, passed: Passed, y: Float[Tensor, "n T"], weight: float = 1.0
) -> LastLayerEvidence:
    """Bayesian linear regression on a_n = L_z^-1 k_zn whose datum n has the noise s_n = k_nn - |a_n|^2 + noise.

    precision = sum_n a_n a_n^T / s_n,  moment = sum_n a_n y_n / s_n, under the likelihood of `deep_gp.log_likelihood`.

    Args:
        passed: of the last layer.
        weight: how often each datum counts: N / n where the rows are a subset of the data.
    """
    layer, noise = prepared.layers[-1], prepared.model.noise_variance
    weights = weight / (passed.variance.unsqueeze(1) + noise.unsqueeze(-1))  # "C T n"
    # a_n is the projected datum times the kernel's standard deviation.
    precision = gram(layer, passed.seen, layer.variance * weights)
    return LastLayerEvidence(precision, layer.variance.sqrt() * ((weights * y.mT) @ passed.seen.projected.mT))
