"""The only Cholesky factorisation of the package, and its only jitter."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.errors import FactorisationError

JITTER = 1e-6
"""Added to the diagonal of a covariance, relative to the kernel's variance."""

_LADDER = (1.0, 10.0, 100.0, 1e3, 1e4)


Factorise = Callable[[Tensor, Any], tuple[Tensor, bool]]
"""From symmetric matrices, and what is to be added to their diagonals, to lower factors, and whether there are any."""


def by_lapack(covariance: Float[Tensor, "*b n n"], added: float | Tensor) -> tuple[Float[Tensor, "*b n n"], bool]:
    """The factor of ``covariance + added * I``, and whether there is one."""
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    factor, info = torch.linalg.cholesky_ex(covariance + added * eye)
    # LAPACK lets an infinite diagonal pass; some builds of it a NaN too. Either shows in the factor's diagonal.
    return factor, not bool(info.any()) and bool(factor.diagonal(dim1=-2, dim2=-1).isfinite().all())


def cholesky(
    covariance: Float[Tensor, "*b n n"],
    scale: float | Float[Tensor, ""] | Float[Tensor, "*b 1 1"] = 1.0,
    jitter: float = JITTER,
    factorise: Factorise = by_lapack,
) -> Float[Tensor, "*b n n"]:
    """Lower Cholesky factor of ``covariance + jitter * scale * I``, differentiable.

    Tries ten times the jitter, four times over, where the factorisation fails.

    Args:
        covariance: symmetric and positive semi-definite up to rounding.
        scale: the kernel's variance, which the jitter is relative to; of all matrices, or of each.
        factorise: what gives the factor.

    Raises:
        FactorisationError: the matrix is not finite, or not positive definite with the largest jitter.
    """
    for rung in _LADDER:
        factor, exists = factorise(covariance, rung * jitter * scale)
        if exists:
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
