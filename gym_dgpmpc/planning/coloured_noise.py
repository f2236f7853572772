"""Noise that is correlated in time: what planners sample around a plan, and what an agent may begin with."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def coloured_noise(
    shape: tuple[int, int, int],
    beta: float,
    generator: torch.Generator,
    *,
    device: torch.device | str,
    dtype: torch.dtype,
) -> Float[Tensor, "n H A"]:
    """Gaussian noise whose power falls with its frequency f along H as f^-beta, of variance one in law.

    White with beta = 0, pink with 1, red with 2. Timmer and König (1995), "On generating power law noise": the Fourier
    coefficients are independent Gaussians, of variance f^-beta. The lowest frequency is 1 / H, and the mean over H
    varies as much as that does. Each series ends near where it begins, for it is periodic.
    """
    if beta == 0.0:
        return torch.randn(shape, generator=generator, dtype=dtype, device=device)
    count, length, size = shape
    frequency = torch.fft.rfftfreq(length, dtype=dtype, device=device).clamp_min(1 / length)
    amplitude = frequency.pow(-beta / 2)
    # The zeroth coefficient is real, and of an even length the last: with the variance of a real and an imaginary part.
    is_real = torch.zeros_like(frequency, dtype=torch.bool)
    is_real[0] = True
    is_real[-1] |= length % 2 == 0
    power = (amplitude.square() * (4.0 - 2.0 * is_real)).sum() / length**2
    parts = (2, count, len(frequency), size)
    real, imaginary = torch.randn(parts, generator=generator, dtype=dtype, device=device)
    real[:, is_real] *= math.sqrt(2.0)
    imaginary[:, is_real] = 0.0
    spectrum = torch.complex(real, imaginary) * (amplitude / power.sqrt()).unsqueeze(-1)
    return torch.fft.irfft(spectrum, n=length, dim=1)
