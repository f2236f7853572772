"""Rewards of the actions that an environment's own `step` is given, where action wrappers stand before it.

A reward function that an environment offers takes the actions that this environment performs. The agent chooses what
the outermost wrapper takes. `of_chosen` puts the wrappers between the two before the reward function, layer by layer.
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces, wrappers
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gym_dgpmpc.types import RewardFn

NUM_TRIED = 64
"""Actions on which a wrapper is tried, beside the corners and the middle of the action space."""


class ChangingActionsError(ValueError):
    """A wrapper may perform another action than the chosen one, and which is not a function of the chosen one alone."""

    def __init__(self, wrapper: str):
        super().__init__(
            f"the environment offers a reward_fn, but the wrapper {wrapper} around it may perform other actions than "
            "the agent chooses, and not by the same function each time: pass reward_fn=... of the actions that the "
            'agent chooses, or reward_fn="learned". The class of a wrapper that leaves actions alone may say so with '
            "an attribute keeps_actions = True"
        )


def layers_above(env: Any, name: str) -> Iterator[gym.Wrapper]:
    """The wrappers of an environment, from the outermost one to the last before what has this attribute itself."""
    while isinstance(env, gym.Wrapper) and not hasattr(env, name):
        yield env
        env = env.env


def only_maps_actions(wrapper: Any) -> bool:
    """Whether all that a wrapper does in `step` is to put its method `action` before it."""
    return isinstance(wrapper, gym.ActionWrapper) and type(wrapper).step is gym.ActionWrapper.step


@dataclass(frozen=True)
class PerformedActions:
    """What action wrappers make of chosen actions, as a function of batches.

    Attributes:
        maps: the `action` of each wrapper, the outermost first.
        space: of the chosen actions.
        takes_batches: whether all of ``maps`` do with an array of many actions exactly what they do with each.
    """

    maps: tuple[Callable[[Any], Any], ...]
    space: spaces.Box
    takes_batches: bool = False

    def __call__(self, action: Float[Tensor, "*b A"]) -> Float[Tensor, "*b A_performed"]:
        # In a plan, all particles of a candidate have the same actions in the same memory.
        distinct = action[tuple(slice(1) if stride == 0 else slice(None) for stride in action.stride()[:-1])]
        rows = distinct.detach().reshape(-1, action.shape[-1]).cpu().numpy().astype(self.space.dtype)
        performed = torch.as_tensor(self.of_rows(rows), dtype=action.dtype, device=action.device)
        return performed.reshape(*distinct.shape[:-1], -1).expand(*action.shape[:-1], -1)

    def of_rows(self, rows: Float[ndarray, "n A"]) -> Float[ndarray, "n A_performed"]:
        """Of n actions, all at once where that is exact, else one after the other."""
        shaped = rows.reshape(-1, *self.space.shape)
        performed = self._apply(shaped.copy()) if self.takes_batches else [self._apply(row.copy()) for row in shaped]
        return np.asarray(performed, dtype=rows.dtype).reshape(len(rows), -1)

    def _apply(self, action: Any) -> Any:
        for each in self.maps:
            action = each(action)
        return action


@dataclass(frozen=True)
class RewardOfPerformed:
    """A reward function of the performed action, as one of the chosen action; a `gym_dgpmpc.types.RewardFn`."""

    reward_fn: RewardFn
    performed: PerformedActions

    def __call__(
        self,
        observation: Float[Tensor, "*b S"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S"],
    ) -> Float[Tensor, "*b"]:
        return self.reward_fn(observation, self.performed(action), next_observation)


def of_chosen(reward_fn: RewardFn, changing: Sequence[Any]) -> RewardFn:
    """The reward of a chosen action, where ``changing`` wrappers, the outermost first, come before the environment.

    Raises:
        ChangingActionsError: one of them does more than to map actions, or maps the same action now so and now so.
        ValueError: they make an action that is not finite, as rescaling to bounds that are equal does.
    """
    if not changing:
        return reward_fn
    for wrapper in changing:
        if not only_maps_actions(wrapper) or isinstance(wrapper, wrappers.StickyAction):
            raise ChangingActionsError(type(wrapper).__name__)
    space = changing[0].action_space
    if not isinstance(space, spaces.Box):
        raise ChangingActionsError(type(changing[0]).__name__)
    performed = PerformedActions(tuple(_apart(wrapper).action for wrapper in changing), space)
    rows = _tried(space)
    names = ", ".join(type(wrapper).__name__ for wrapper in changing)
    try:
        one_by_one = performed.of_rows(rows)
        backwards = performed.of_rows(rows[::-1])[::-1]
    except Exception as error:
        raise ChangingActionsError(f"{names} (which raised {type(error).__name__}: {error})") from error
    if not np.array_equal(one_by_one, backwards, equal_nan=True):
        raise ChangingActionsError(names)
    with np.errstate(over="ignore"):
        lost = ~np.isfinite(one_by_one.astype(np.float32)).all(axis=1)
    if lost.any():
        raise ValueError(
            f"the wrappers {names} make the action {one_by_one[lost][0]} of {rows[lost][0]}, which is not finite in "
            "float32: the bounds between which they rescale must differ, and not be vast"
        )
    together = PerformedActions(performed.maps, space, takes_batches=True)
    try:
        is_exact = np.array_equal(together.of_rows(rows), one_by_one)
    except Exception:  # it is written for one action
        is_exact = False
    return RewardOfPerformed(reward_fn, together if is_exact else performed)


def _apart(wrapper: Any) -> Any:
    """A copy of a wrapper, around the same environment, whose state is its own."""
    apart = copy.copy(wrapper)
    for name, value in vars(wrapper).items():
        if name != "env":
            try:
                vars(apart)[name] = copy.deepcopy(value)
            except Exception:  # it stays the wrapper's own
                continue
    return apart


def _tried(space: spaces.Box) -> Float[ndarray, "n A"]:
    """Actions in the space: its two corners, its middle, and random ones."""
    low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
    low, high = np.maximum(low, -1e6), np.minimum(high, 1e6)
    between = np.random.default_rng(0).random((NUM_TRIED, low.size))
    fractions = np.concatenate([[np.zeros_like(low), np.full_like(low, 0.5), np.ones_like(low)], between])
    return (low + fractions * (high - low)).astype(space.dtype)
