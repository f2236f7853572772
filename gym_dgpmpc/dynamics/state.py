"""Reading a saved state: every entry is checked for its name, its type and its shape before anything is replaced."""

import torch
from torch import Tensor

from gym_dgpmpc.types import StateDict


def take_tensor(
    state: StateDict,
    name: str,
    shape: tuple[int, ...],
    device: torch.device,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """A copy of the entry ``name``.

    Raises:
        ValueError: it is missing, is no tensor, or has another shape.
    """
    value = state.get(name)
    received = tuple(value.shape) if isinstance(value, Tensor) else value
    if not isinstance(value, Tensor) or value.shape != shape:
        raise ValueError(f"dynamics state {name!r}: expected a tensor of shape {shape}, received {received}")
    return value.to(device, dtype).clone()
