"""Random Fourier features: finite-dimensional draws of a stationary Gaussian process's prior.

Sits beside `kernels.py`; the pathwise draws of a trained model are built from them. A stationary kernel is the
Fourier transform of a spectral density (Bochner), so with frequencies from that density and uniform phases,
phi_i(x) = sqrt(2 / F) cos(omega_i . x / lengthscale + b_i) has E[phi(x) . phi(x')] = k(x, x')
(Rahimi and Recht 2007), with an error of order F^-1/2.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.gp.kernels import Kernel


class Features(NamedTuple):
    """Frequencies for unit lengthscales, and phases, of F random features over D inputs."""

    frequency: Float[Tensor, "F D"]
    phase: Float[Tensor, "F"]

    def __call__(self, x: Float[Tensor, "*b D"]) -> Float[Tensor, "*b F"]:
        """phi(x) for inputs already divided by the lengthscales; unit kernel variance."""
        return torch.cos(x @ self.frequency.mT + self.phase) * (2.0 / self.phase.numel()) ** 0.5


def draw_features(
    kernel: Kernel, num_features: int, input_size: int, generator: torch.Generator, dtype: torch.dtype = torch.float64
) -> Features:
    """Frequencies from the kernel's spectral density, phases uniform over a turn."""
    frequency = kernel.draw_frequencies(num_features, input_size, generator, dtype)
    phase = 2 * torch.pi * torch.rand(num_features, generator=generator, dtype=dtype, device=generator.device)
    return Features(frequency, phase)
