"""Random Fourier features: finite-dimensional draws of a stationary Gaussian process's prior.

Sits beside `kernels.py`; the pathwise draws of a trained model are built from them. A stationary kernel is the
Fourier transform of a spectral density (Bochner), so with frequencies omega from that density, each used for a cosine
and a sine, phi(x) = sqrt(2 / F) (cos(omega . x / lengthscale), sin(omega . x / lengthscale)) has
E[phi(x) . phi(x')] = k(x, x') (Rahimi and Recht 2007), with an error of order F^-1/2, and |phi(x)| = 1 exactly.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import Kernel


class Features(NamedTuple):
    """Frequencies for unit lengthscales of F random features over D inputs, for each of P draws."""

    frequency: Float[Tensor, "P half_F D"]

    def __call__(self, x: Float[Tensor, "P n D"]) -> Float[Tensor, "P n F"]:
        """phi(x) for inputs already divided by the lengthscales, all cosines, then all sines; unit kernel variance."""
        angle = x @ self.frequency.mT
        return torch.cat([angle.cos(), angle.sin()], dim=-1) / math.sqrt(angle.shape[-1])


def draw_features(
    kernel: Kernel,
    num_draws: int,
    num_features: int,
    input_size: int,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float64,
) -> Features:
    """F features for each of P draws, of F / 2 frequencies from the spectral density.

    Args:
        num_features: F, a multiple of 2.
    """
    half = num_features // 2
    frequency = kernel.draw_frequencies(num_draws * half, input_size, generator, dtype)
    return Features(frequency.view(num_draws, half, input_size))
