"""Deep Gaussian processes in numpy, by dense conditioning of joint Gaussians: no whitening trick, no sharing of work.

Kernels come from their definitions (the Bessel function of Matern's), distances from differences.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.special

MATERN_ORDER = {"matern12": 0.5, "matern32": 1.5, "matern52": 2.5, "matern72": 3.5}
JITTER = 1e-6  # relative to the kernel's variance, on the inducing outputs' covariance


class DenseLayer(NamedTuple):
    """One layer's hyperparameters as numpy arrays."""

    inducing_inputs: np.ndarray  # [M, D]
    lengthscale: np.ndarray  # [D]
    variance: float
    slope: np.ndarray | float = 0.0  # [D], standard deviation of a linear function's, over the kernel's


def correlation(kernel: str, distance: np.ndarray) -> np.ndarray:
    """RBF exp(-r^2 / 2); Matern 2^(1 - nu) / Gamma(nu) s^nu K_nu(s), s = sqrt(2 nu) r (Rasmussen and Williams 4.14)."""
    if kernel == "rbf":
        return np.exp(-0.5 * distance**2)
    nu = MATERN_ORDER[kernel]
    s = np.sqrt(2 * nu) * np.where(distance > 0, distance, 1.0)
    value = 2 ** (1 - nu) / math.gamma(nu) * s**nu * scipy.special.kv(nu, s)
    return np.where(distance > 0, value, 1.0)


def covariance(kernel: str, layer: DenseLayer, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """k(x, z) [..., n, m]."""
    x, z = x[..., :, None, :] / layer.lengthscale, z[..., None, :, :] / layer.lengthscale
    linear = (x * z * np.square(layer.slope)).sum(-1)
    return layer.variance * (correlation(kernel, np.sqrt(((x - z) ** 2).sum(-1))) + linear)


def inducing_covariance(kernel: str, layer: DenseLayer) -> np.ndarray:
    """K_zz + jitter [M, M]."""
    z = layer.inducing_inputs
    return covariance(kernel, layer, z, z) + JITTER * layer.variance * np.eye(len(z))


def conditional(kernel: str, layer: DenseLayer, whitened: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [..., n, O] and covariance [..., n, n] of f(x) given u = L_z v, from the joint Gaussian of (f, u)."""
    K_zz = inducing_covariance(kernel, layer)
    u = np.linalg.cholesky(K_zz) @ whitened
    K_xz = covariance(kernel, layer, x, layer.inducing_inputs)
    gain = K_xz @ np.linalg.inv(K_zz)
    return gain @ u, covariance(kernel, layer, x, x) - gain @ np.swapaxes(K_xz, -1, -2)


def sample(
    kernel: str,
    layers: list[DenseLayer],
    whitened: list[np.ndarray],
    x: np.ndarray,
    num_samples: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Joint samples [num_samples, n, T] of the composed layers at the points x [n, D], identity means inside."""
    x = np.broadcast_to(x, (num_samples, *x.shape))
    for index, (layer, v) in enumerate(zip(layers, whitened, strict=True)):
        mean, cov = conditional(kernel, layer, v, x)
        root = np.linalg.cholesky(cov + 1e-10 * layer.variance * np.eye(x.shape[1]))
        value = mean + root @ rng.standard_normal(mean.shape)
        x = value if index == len(layers) - 1 else x + value
    return x
