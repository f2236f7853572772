"""Sparse Gaussian-process regression by the collapsed variational bound, with one kernel for all outputs.

Titsias (2009), "Variational Learning of Inducing Variables in Sparse Gaussian Processes". The inducing outputs have
been integrated out, so that nothing is sampled: the bound is a function of hyperparameters and inducing inputs alone.
With the data as inducing inputs it is the exact log marginal likelihood and the exact posterior, up to the jitter.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import grad_if_asked, is_asked
from gym_dgpmpc.gp.kernels import scaled_sqdist
from gym_dgpmpc.gp.layer import Layer, factorise, project
from gym_dgpmpc.gp.linalg import cholesky


def collapsed_bound(
    layer: Layer,
    noise_variance: Float[Tensor, "T"],
    x: Float[Tensor, "N D"],
    y: Float[Tensor, "N T"],
) -> Float[Tensor, ""]:
    """The sum over the outputs of Titsias's bound on log p(y_t), differentiable in the layer and the noise s_t.

    With A = L_z^-1 K_zx and B_t = I + A A^T / s_t,

        -N/2 log 2 pi s_t - 1/2 log |B_t| - |y_t|^2 / 2 s_t + |L_B^-1 A y_t|^2 / 2 s_t^2
            - (N sigma^2 - tr A A^T) / 2 s_t.

    Only A A^T, A y and |y|^2 depend on the data, so further outputs cost next to nothing.
    """
    with torch.no_grad():
        factor = factorise(layer)  # its derivative is part of the projection's
    a = layer.variance.sqrt() * project(layer, factor, x)
    gram, projected, num_data = a @ a.mT, (a @ y).mT.unsqueeze(-1), len(x)
    noise = noise_variance.view(-1, 1, 1)
    eye = torch.eye(len(a), dtype=a.dtype, device=a.device)
    # The identity bounds the eigenvalues from below by one: no jitter is needed.
    root = cholesky(eye + gram / noise, torch.ones_like(layer.log_variance), jitter=0.0)
    explained = torch.linalg.solve_triangular(root, projected, upper=False).square().sum((-2, -1)) / noise_variance**2
    log_determinant = 2.0 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1) + num_data * noise_variance.log()
    lost = num_data * layer.variance - gram.trace()
    misfit = (y.square().sum(0) + lost) / noise_variance - explained
    return -0.5 * (num_data * math.log(2.0 * math.pi) + log_determinant + misfit).sum()


class SparsePosterior(NamedTuple):
    """The optimal q(v_t) = N(m_t, B_t^-1) of the whitened inducing outputs, in the eigenbasis of A A^T.

    That basis is the same for every output, whatever its noise: A A^T = U diag(spectrum) U^T.
    """

    basis: Float[Tensor, "M M"]  # sigma^2 U^T L_z^-1, from correlations with Z to coordinates
    spectrum: Float[Tensor, "M"]
    mean: Float[Tensor, "M T"]  # U^T m_t


def sparse_posterior(
    layer: Layer,
    noise_variance: Float[Tensor, "T"],
    x: Float[Tensor, "N D"],
    y: Float[Tensor, "N T"],
) -> SparsePosterior:
    """m_t = (A A^T + s_t I)^-1 A y_t and the basis in which its covariance is diagonal."""
    factor = factorise(layer)
    a = layer.variance.sqrt() * project(layer, factor, x)
    spectrum, vectors = torch.linalg.eigh(a @ a.mT)
    spectrum = spectrum.clamp_min(0.0)
    mean = (vectors.mT @ (a @ y)) / (spectrum.unsqueeze(-1) + noise_variance)
    basis = layer.variance * torch.linalg.solve_triangular(factor.mT, vectors, upper=True).mT
    return SparsePosterior(basis, spectrum, mean)


def shrinkage(posterior: SparsePosterior, noise_variance: Float[Tensor, "T"]) -> Float[Tensor, "M T"]:
    """The share of the prior's variance that the data remove along each coordinate, lambda / (lambda + s_t)."""
    spectrum = posterior.spectrum.unsqueeze(-1)
    return spectrum / (spectrum + noise_variance)


@grad_if_asked
def sparse_predict(
    layer: Layer,
    noise_variance: Float[Tensor, "T"],
    posterior: SparsePosterior,
    x: Float[Tensor, "*b n D"],
) -> tuple[Float[Tensor, "*b n T"], Float[Tensor, "*b n T"]]:
    """Mean and marginal variance of f_t(x), without noise: with b = basis r(Z, x),

    mean = b . m_t,  variance = sigma^2 - sum_i b_i^2 lambda_i / (lambda_i + s_t).

    Differentiable by ``x``, once. Single precision will not do: trained on 1,000 transitions of the cart-pole, which
    gave sigma^2 = 104, it moves means by up to one standard deviation of the noise.
    """
    kernel, sqdist = layer.kernel, scaled_sqdist(x, layer.inducing_inputs, layer.lengthscale)
    b = kernel.correlation(sqdist) if is_asked(x) else kernel.correlation_(sqdist.mul_(kernel.argument_scale))
    b = b @ posterior.basis.mT
    mean = b @ posterior.mean
    variance = layer.variance - b.square() @ shrinkage(posterior, noise_variance)
    return mean, variance.clamp_min(0.0)
