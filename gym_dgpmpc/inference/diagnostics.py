"""How well a chain has mixed: effective sample size and split R-hat of the kept samples."""

import torch
from jaxtyping import Float
from torch import Tensor


def effective_sample_size(samples: Float[Tensor, "n V"]) -> Float[Tensor, "V"]:
    """ESS of each coordinate of one chain: n / (1 + 2 sum of autocorrelations), cut off by Geyer's rule.

    The sum runs over pairs of neighbouring lags while the pair is positive (Geyer 1992, initial positive sequence).
    A coordinate that does not move has an ESS of zero.
    """
    n, size = samples.shape
    centred = samples.double() - samples.double().mean(0)
    spectrum = torch.fft.rfft(centred, n=2 * n, dim=0)
    autocovariance = torch.fft.irfft(spectrum.abs().square(), n=2 * n, dim=0)[:n] / n
    moving = autocovariance[0] > 0
    correlation = autocovariance / torch.where(moving, autocovariance[0], 1.0)
    pairs = correlation[: n - n % 2].reshape(n // 2, 2, size).sum(1)
    positive = (pairs > 0).cumprod(0)
    time = (2.0 * (pairs * positive).sum(0) - 1.0).clamp_min(1.0 / n)
    return torch.where(moving, n / time, 0.0)


def split_r_hat(samples: Float[Tensor, "n V"]) -> Float[Tensor, "V"]:
    """Split R-hat of each coordinate of one chain: 1 when its two halves agree, infinite for two
    halves at rest in different places (Gelman et al. 2013, section 11.4).

    Raises:
        ValueError: fewer than four samples.
    """
    n = samples.shape[0]
    if n < 4:
        raise ValueError(f"R-hat needs at least 4 samples, received {n}")
    half = n // 2
    halves = torch.stack([samples[:half], samples[n - half :]]).double()
    within = halves.var(1).mean(0)
    between = half * halves.mean(1).var(0)
    pooled = (half - 1) / half * within + between / half
    return torch.where(pooled == 0, 1.0, pooled / within).sqrt()


def rank_normalised_r_hat(samples: Float[Tensor, "n V"]) -> Float[Tensor, "V"]:
    """The larger of two split R-hats of each coordinate of one chain: of its ranks, and of its distances' ranks.

    Ranks are made normal scores, Phi^-1((rank - 3/8) / (n + 1/4)), so that heavy tails do not hide a drift; distances
    are those from the median, so that halves that differ in their spread alone are seen (Vehtari et al. 2021, section
    4). Of an odd number of samples the one in the middle is left out.

    Raises:
        ValueError: fewer than four samples.
    """
    half = len(samples) // 2
    halves = torch.cat([samples[:half], samples[len(samples) - half :]]).double()
    middle = (halves.median(0).values - (-halves).median(0).values) / 2  # of an even number, the mean of the two
    return torch.maximum(*(split_r_hat(_normal_scores(each)) for each in (halves, (halves - middle).abs())))


def _normal_scores(samples: Float[Tensor, "n V"]) -> Float[Tensor, "n V"]:
    """What normal samples of these ranks would be; equal samples share their mean rank."""
    rows = samples.mT.contiguous()
    ordered = rows.sort(-1).values
    below, up_to = (torch.searchsorted(ordered, rows, right=right) for right in (False, True))
    rank = (below + up_to + 1).to(samples.dtype) / 2
    return torch.special.ndtri((rank - 0.375) / (rows.shape[-1] + 0.25)).mT
