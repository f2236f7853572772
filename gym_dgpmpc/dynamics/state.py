"""Saved states: every entry is checked for its name, its type and its shape before anything is replaced."""

from collections.abc import Mapping

import torch
from torch import Tensor

from gym_dgpmpc.data.normaliser import Normaliser
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
        ValueError: it is missing, is not a tensor, or has another shape.
    """
    value = state.get(name)
    received = tuple(value.shape) if isinstance(value, Tensor) else value
    if not isinstance(value, Tensor) or value.shape != shape:
        raise ValueError(f"dynamics state {name!r}: expected a tensor of shape {shape}, received {received}")
    return value.to(device, dtype).clone()


def take_tensors(
    state: StateDict,
    shapes: Mapping[str, tuple[int, ...]],
    device: torch.device,
    dtype: torch.dtype = torch.float64,
    *,
    prefix: str = "",
) -> dict[str, Tensor]:
    """Copies of the entries whose names are ``prefix`` and one of those in ``shapes``, by the latter.

    Raises:
        ValueError: as `take_tensor`.
    """
    return {name: take_tensor(state, f"{prefix}{name}", shape, device, dtype) for name, shape in shapes.items()}


def normalisers_state(inputs: Normaliser, targets: Normaliser) -> StateDict:
    """The entries "inputs.mean" to "targets.std"."""
    pairs = (("inputs", inputs), ("targets", targets))
    return {f"{name}.{key}": value for name, normaliser in pairs for key, value in normaliser._asdict().items()}


def take_normaliser(state: StateDict, name: str, size: int, device: torch.device) -> Normaliser:
    """The standardisation of ``size`` numbers whose entries begin with ``name``.

    Raises:
        ValueError: as `take_tensor`.
    """
    return Normaliser(**take_tensors(state, dict.fromkeys(Normaliser._fields, (size,)), device, prefix=f"{name}."))
