"""Gaussian-process regression in closed form: what the sampled models are checked against.

With one layer and Gaussian noise nothing has to be sampled. `regression` is the textbook posterior, O(N^3);
`whitened_posterior` is the law that SG-HMC draws the inducing outputs of a one-layer model from when the
hyperparameters are fixed. Both solve with the matrix itself: no Cholesky factor, no jitter.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import scaled_sqdist
from gym_dgpmpc.gp.layer import Layer


class Gaussians(NamedTuple):
    """T independent Gaussians over n values each."""

    mean: Float[Tensor, "n T"]
    covariance: Float[Tensor, "T n n"]


def regression(
    layer: Layer,
    noise_variance: Float[Tensor, "T"],
    x: Float[Tensor, "N D"],
    y: Float[Tensor, "N T"],
    x_new: Float[Tensor, "n D"],
) -> Gaussians:
    """Posterior of the T functions at ``x_new``; only the layer's kernel and hyperparameters are used.

    mean = k_*x (K_xx + noise I)^-1 y, covariance = k_** - k_*x (K_xx + noise I)^-1 k_x*
    (Rasmussen and Williams 2006, eqs. 2.23 and 2.24).
    """
    prior, cross = _covariance(layer, x_new, x_new), _covariance(layer, x, x_new)
    noisy = _covariance(layer, x, x) + torch.diag_embed(noise_variance.unsqueeze(-1).expand(-1, len(x)))
    gain = torch.linalg.solve(noisy, cross.expand(len(noise_variance), -1, -1)).mT
    return Gaussians((gain @ y.mT.unsqueeze(-1)).squeeze(-1).mT, prior - gain @ cross)


def whitened_posterior(
    layer: Layer,
    factor: Float[Tensor, "M M"],
    noise_variance: Float[Tensor, "T"],
    x: Float[Tensor, "N D"],
    y: Float[Tensor, "N T"],
) -> Gaussians:
    """p(v | y) of a one-layer model, under the likelihood of `deep_gp.log_likelihood`.

    That likelihood integrates f out datum by datum, y_n ~ N(a_n . v, s_n) with a_n = L_z^-1 k_zn and
    s_n = k_nn - |a_n|^2 + noise (so it knows the function's variance at a datum, not its covariance between data:
    Snelson and Ghahramani 2006). It is linear and Gaussian in v ~ N(0, I), hence

        covariance = (I + sum_n a_n a_n^T / s_n)^-1,  mean = covariance sum_n a_n y_n / s_n.
    """
    a = torch.linalg.solve_triangular(factor, _covariance(layer, layer.inducing_inputs, x), upper=False)
    s = layer.variance - a.square().sum(0) + noise_variance.unsqueeze(-1)  # "T N"
    weighted = a / s.unsqueeze(1)  # "T M N"
    covariance = torch.linalg.inv(torch.eye(len(a), dtype=a.dtype, device=a.device) + weighted @ a.mT)
    return Gaussians((covariance @ weighted @ y.mT.unsqueeze(-1)).squeeze(-1).mT, covariance)


def _covariance(layer: Layer, x: Tensor, z: Tensor) -> Tensor:
    return layer.variance * layer.kernel.correlation(scaled_sqdist(x, z, layer.lengthscale))
