"""Where Adam starts: what it remembers of a parameter, made by the dtype and device of the parameter.

Used by `sampler.py` and by the ensemble. PyTorch's own start takes the process's default device, which may be another.
"""

import torch
from torch import Tensor


def adam_memory(
    parameter: Tensor, num_updates: int = 0, moments: tuple[Tensor, Tensor] | None = None
) -> dict[str, Tensor]:
    """The state of `torch.optim.Adam` for one parameter.

    Args:
        parameter: what it moves.
        num_updates: how often it has moved it.
        moments: means of the gradient and of its square, of the parameter's shape; None: zeros.
    """
    first, second = (torch.zeros_like(parameter), torch.zeros_like(parameter)) if moments is None else moments
    step = torch.tensor(float(num_updates), dtype=torch.float32, device="cpu")
    return {"step": step, "exp_avg": first.detach().clone(), "exp_avg_sq": second.detach().clone()}
