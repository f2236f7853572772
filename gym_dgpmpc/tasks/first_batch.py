"""Try a reward or termination function on a batch of states before anything is learned with it."""

import warnings
from collections.abc import Callable

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

REWARD_SIGNATURE = "reward_fn(observation [*b, S], action [*b, A], next_observation [*b, S]) -> reward [*b]"
TERMINATED_SIGNATURE = "terminated_fn(next_observation [*b, S]) -> terminated [*b], bool"

HORIZON, PARTICLES = 4, 3
"""H and P of the batch [H, P, K] on which a function is tried; a planner's batches have the same axes. There is one
candidate more than numbers in an observation, so that a function that confuses the two axes fails."""
WIDEST = 1e6
"""Bounds further apart than this say nothing about which values occur."""


def check_reward(
    reward_fn: Callable[..., Tensor],
    observation_space: spaces.Box,
    action_space: spaces.Box,
    device: torch.device | str,
) -> None:
    """Try a reward function, and report what is wrong with it.

    Warns if it is not finite for some observations in a space whose bounds do not say which values occur.

    Raises:
        ValueError: it raises, changes its arguments, or returns a tensor of the wrong shape, dtype or device or one
            with numbers that are not finite.
        TypeError: it is not callable or does not return a tensor.
    """
    batch = example_batch(observation_space, action_space, device)
    reward = _checked_output("reward_fn", REWARD_SIGNATURE, reward_fn, batch, is_bool=False)
    bad = ~reward.isfinite()
    if not bad.any():
        return
    first = tuple(bad.nonzero()[0].tolist())
    inputs = ", ".join(
        f"{name} = {tensor[first].tolist()}"
        for name, tensor in zip(("observation", "action", "next_observation"), batch, strict=True)
    )
    message = f"reward_fn must return finite numbers, but returned {reward[first].item()} for {inputs}"
    bounds_are_informative = bool((observation_space.high - observation_space.low < WIDEST).all())
    if bounds_are_informative or bad.all():
        raise ValueError(
            f"{message}; these lie within the spaces {observation_space} and {action_space}. The model can predict "
            "such observations, so make the function finite for them"
        )
    warnings.warn(
        f"{message}. If the model predicts such observations, plans that lead to them will never be taken", stacklevel=4
    )


def check_termination(
    terminated_fn: Callable[..., Tensor],
    observation_space: spaces.Box,
    action_space: spaces.Box,
    device: torch.device | str,
) -> None:
    """Try a termination function, and report what is wrong with it.

    Raises:
        ValueError: it raises, changes its argument, or returns a tensor of the wrong shape, dtype or device.
        TypeError: it is not callable or does not return a tensor.
    """
    _, _, after = example_batch(observation_space, action_space, device)
    _checked_output("terminated_fn", TERMINATED_SIGNATURE, terminated_fn, (after,), is_bool=True)


def example_batch(
    observation_space: spaces.Box, action_space: spaces.Box, device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor, Tensor]:
    """Batches [H, P, K] of observations, actions and next observations, float32.

    As in a plan, all particles of a candidate share its actions, and the next observations are the observations of the
    next step, in the same memory. Values are uniform between bounds. Without bounds, or where they are at least
    `WIDEST` apart, values are normal about the allowed value nearest to zero. The spaces' own random numbers are not
    advanced.
    """
    generator = np.random.default_rng(0)
    candidates = observation_space.low.size + 1
    states, actions = (
        torch.as_tensor(sample, dtype=torch.float32, device=device)
        for sample in (
            _sample(observation_space, (HORIZON + 1, PARTICLES, candidates), generator),
            _sample(action_space, (HORIZON, 1, candidates), generator),
        )
    )
    return states[:-1], actions.expand(-1, PARTICLES, -1, -1), states[1:]


def _sample(space: spaces.Box, batch: tuple[int, ...], generator: np.random.Generator) -> np.ndarray:
    low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
    shape = (*batch, low.size)
    with np.errstate(over="ignore"):
        bounded = high - low < WIDEST
    uniform = np.where(bounded, low, 0.0) + np.where(bounded, high - low, 1.0) * generator.random(shape)
    # About the allowed value nearest to zero; the last line clips to the bounds.
    normal = np.clip(0.0, low, high) + generator.standard_normal(shape)
    return np.where(bounded, uniform, np.clip(normal, low, high))


def _checked_output(
    name: str, signature: str, function: Callable[..., Tensor], batch: tuple[Tensor, ...], *, is_bool: bool
) -> Tensor:
    if not callable(function):
        raise TypeError(f"{name} must be a function {signature}, got {function!r}")
    shapes = ", ".join(str(list(tensor.shape)) for tensor in batch)
    shape, kind = batch[0].shape[:-1], "bool" if is_bool else "float"
    expected = (
        f"{name} must map tensors of shapes {shapes} to a {kind} tensor {list(shape)}; its signature is {signature}"
    )
    before = [tensor.clone() for tensor in batch]
    try:
        value = function(*batch)
    except Exception as error:
        raise ValueError(f"{expected}. It raised {type(error).__name__}: {error}") from error
    if not all(map(torch.equal, batch, before)):
        raise ValueError(f"{expected}. It changed its arguments: work on copies")
    if not isinstance(value, Tensor):
        raise TypeError(f"{expected}. It returned {type(value).__name__}")
    has_kind = value.dtype == torch.bool if is_bool else value.is_floating_point()
    if value.shape != shape or not has_kind:
        raise ValueError(f"{expected}. It returned {value.dtype} of shape {list(value.shape)}")
    if value.device != batch[0].device:
        raise ValueError(
            f"{expected}, on the device of its arguments, {batch[0].device}. It returned a tensor on {value.device}"
        )
    return value
