"""The only Cholesky factorisation of the package, and its only jitter."""

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.errors import FactorisationError

JITTER = 1e-6
"""Added to the diagonal of a covariance, relative to the kernel's variance."""

_LADDER = (1.0, 10.0, 100.0, 1e3, 1e4)


def cholesky(
    covariance: Float[Tensor, "*b n n"], scale: Float[Tensor, ""] | Float[Tensor, "*b 1 1"], jitter: float = JITTER
) -> Float[Tensor, "*b n n"]:
    """Lower Cholesky factor of ``covariance + jitter * scale * I``, differentiable.

    Tries ten times the jitter, four times over, where the factorisation fails.

    Args:
        covariance: symmetric and positive semi-definite up to rounding.
        scale: the kernel's variance, which the jitter is relative to; of all matrices, or of each.

    Raises:
        FactorisationError: the matrix is not finite, or not positive definite with the largest jitter.
    """
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    for rung in _LADDER:
        jittered = covariance + (rung * jitter * scale) * eye if jitter else covariance
        factor, info = torch.linalg.cholesky_ex(jittered)
        # LAPACK lets an infinite diagonal pass; some builds of it a NaN too. Either shows in the factor's diagonal.
        if not bool(info.any()) and bool(factor.diagonal(dim1=-2, dim2=-1).isfinite().all()):
            return factor
    finite = bool(torch.isfinite(covariance).all())
    raise FactorisationError(
        f"a covariance of shape {tuple(covariance.shape)} could not be factorised: "
        + (
            f"jitter up to {_LADDER[-1] * jitter:g} of the kernel's variance did not help"
            if finite
            else "it holds values that are not finite"
        )
    )
