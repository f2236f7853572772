"""Gaussian-process predictions at a Gaussian input: exact mean, covariance and input-output covariance, RBF kernel.

Deisenroth and Rasmussen (2011), "PILCO: A Model-Based and Data-Efficient Approach to Policy Search", section 2.2, and
Candela, Girard, Larsen and Rasmussen (2003), "Propagation of Uncertainty in Bayesian Kernel Models". Here all outputs
share their kernel, so the matrix of the second moments is one for all of them.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.linalg import cholesky

_ELEMENTS_AT_ONCE = 2_000_000  # elements of the second moments, K M^2 in all, which would not fit in memory at once


class Predictor(NamedTuple):
    """T functions that are independent given x: mean r(x) . weights_t, variance sigma^2 - r(x)^T reduction_t r(x).

    r_i(x) = exp(-1/2 sum_d (x_d - z_id)^2 / lengthscale_d^2) is the RBF correlation with centre i.
    """

    centres: Float[Tensor, "M D"]
    lengthscale: Float[Tensor, "D"]
    variance: Float[Tensor, ""]
    weights: Float[Tensor, "M T"]
    reduction: Float[Tensor, "T M M"]


class Moments(NamedTuple):
    """Moments of f(x) for x ~ N(mean, covariance); the input-output covariance is Cov[x, f] = covariance @ gain."""

    mean: Float[Tensor, "K T"]
    covariance: Float[Tensor, "K T T"]
    gain: Float[Tensor, "K D T"]


def predicted_moments(predictor: Predictor, mean: Float[Tensor, "K D"], covariance: Float[Tensor, "K D D"]) -> Moments:
    """Moments of the T functions at K Gaussian inputs.

    In inputs over the lengthscales, with S their covariance and d_i = z_i - mean,

        E[r_i] = |I + S|^-1/2 exp(-1/2 d_i^T (I + S)^-1 d_i),
        E[r_i r_j] = |I + 2 S|^-1/2 exp(-1/4 |d_i - d_j|^2 - 1/4 (d_i + d_j)^T (I + 2 S)^-1 (d_i + d_j)),
        Cov[x, f] = S (I + S)^-1 sum_i weights_i E[r_i] d_i.

    Args:
        covariance: positive semi-definite; inputs that are known have variance zero.
    """
    count = max(1, _ELEMENTS_AT_ONCE // len(predictor.centres) ** 2)
    moments = [_moments(predictor, *inputs) for inputs in zip(mean.split(count), covariance.split(count), strict=True)]
    return Moments(*(torch.cat(values) for values in zip(*moments, strict=True)))


def _moments(predictor: Predictor, mean: Tensor, covariance: Tensor) -> Moments:
    lengthscale, weights = predictor.lengthscale, predictor.weights
    difference = (predictor.centres - mean.unsqueeze(1)) / lengthscale  # "K M D"
    spread = covariance / (lengthscale.unsqueeze(-1) * lengthscale)
    eye = torch.eye(spread.shape[-1], dtype=spread.dtype, device=spread.device)
    one = torch.ones_like(predictor.variance)

    # First moments. I + S has no eigenvalue below one, so its factorisation needs no jitter.
    root = cholesky(eye + spread, one, jitter=0.0)
    solved = torch.cholesky_solve(difference.mT, root)  # (I + S)^-1 d, "K D M"
    scale = root.diagonal(dim1=-2, dim2=-1).prod(-1, keepdim=True)
    first = torch.exp(-0.5 * (difference.mT * solved).sum(-2)) / scale  # E[r], "K M"
    output = first @ weights
    gain = ((solved * first.unsqueeze(1)) @ weights) / lengthscale.unsqueeze(-1)

    # Second moments: the exponent is -1/4 (e_i + e_j) + 1/2 d_i^T (I - W) d_j with W = (I + 2 S)^-1, e = d^T (I + W) d.
    root = cholesky(eye + 2.0 * spread, one, jitter=0.0)
    shrunk = torch.cholesky_solve(difference.mT, root).mT  # W d, "K M D"
    own = -0.25 * (difference * (difference + shrunk)).sum(-1)
    second = torch.baddbmm(own.unsqueeze(-1) + own.unsqueeze(-2), 0.5 * difference, (difference - shrunk).mT).exp()
    second = second / root.diagonal(dim1=-2, dim2=-1).prod(-1).view(-1, 1, 1)  # E[r r^T], "K M M"
    products = weights.mT @ (second @ weights)
    reduced = second.flatten(1) @ predictor.reduction.flatten(1).mT
    variance = (predictor.variance - reduced).clamp_min(0.0)
    return Moments(output, products - output.unsqueeze(-1) * output.unsqueeze(-2) + torch.diag_embed(variance), gain)
