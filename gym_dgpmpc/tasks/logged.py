"""Transitions that were logged elsewhere, as rows of the transition store: arrays, SB3's buffers, Minari's datasets."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from jaxtyping import Float
from numpy import ndarray
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from gym_dgpmpc.errors import EnvironmentDataError
from gym_dgpmpc.tasks.dict_observations import flatten
from gym_dgpmpc.tasks.environment import flat_size

REQUIRED = ("observation", "action", "next_observation", "reward")
FIELDS = (*REQUIRED, "terminated")
ROUNDING = 1e-4
"""Of an action's range; logged actions may leave the bounds by that much."""


@runtime_checkable
class EpisodeDataset(Protocol):
    """A Minari dataset, as far as it is read here; each episode has one observation more than actions."""

    def iterate_episodes(self) -> Iterator[Any]: ...


Logged = Mapping[str, Any] | ReplayBuffer | EpisodeDataset


class LoggedRows(NamedTuple):
    """n logged steps; ``episode`` counts from 0."""

    observation: ndarray
    action: ndarray
    next_observation: ndarray
    reward: ndarray
    terminated: ndarray
    episode: ndarray


def read_logged(
    data: Logged, scaled_actions: bool | None, observation_space: spaces.Box, action_space: spaces.Box
) -> LoggedRows:
    """The rows of logged data, with observations [n, S] and actions [n, A] in the units of the spaces.

    Args:
        data: see `MPCAgent.add_transitions`.
        scaled_actions: whether its actions are scaled to [-1, 1]; None: those of a `ReplayBuffer` alone.
        observation_space: one-dimensional.
        action_space: finite bounds.

    Raises:
        EnvironmentDataError: a field is missing, or has another shape or actions out of bounds.
        TypeError: the data are of no kind that can be read.
    """
    if isinstance(data, ReplayBuffer):
        rows, in_buffer = _of_buffer(data), True
    elif isinstance(data, Mapping):
        rows, in_buffer = _of_mapping(data), False
    elif isinstance(data, EpisodeDataset):
        rows, in_buffer = _of_episodes(data), False
    else:
        raise TypeError(
            f"logged transitions are a mapping with the arrays {', '.join(FIELDS)}, a ReplayBuffer of "
            f"Stable-Baselines3 or a Minari dataset, got {type(data).__name__}"
        )
    rows = rows._replace(action=_flat_actions(rows.action, action_space))
    sizes = {"observation": observation_space.shape, "action": (flat_size(action_space),)}
    sizes |= {"next_observation": observation_space.shape, "reward": (), "terminated": (), "episode": ()}
    count = len(rows.action)
    for name, value in rows._asdict().items():
        if value.shape != (count, *sizes[name]):
            raise EnvironmentDataError(
                f"logged {name} must have the shape {[count, *sizes[name]]}, as there are {count} actions and the "
                f"environment's spaces are {observation_space} and {action_space}, got {list(value.shape)}"
            )
    if not count:
        raise EnvironmentDataError("the logged data hold no transitions")
    scaled = in_buffer if scaled_actions is None else scaled_actions
    return rows._replace(action=_unscaled(rows.action, action_space, scaled))


def _of_mapping(data: Mapping[str, Any]) -> LoggedRows:
    missing, unknown = [name for name in REQUIRED if name not in data], sorted(set(data) - set(FIELDS))
    if missing or unknown:
        raise EnvironmentDataError(
            f"logged transitions have the fields {', '.join(FIELDS)}; missing: {missing}, unknown: {unknown}"
        )
    observation, action, after, reward = (np.asarray(flatten(data[name])) for name in REQUIRED)
    terminated = np.asarray(data["terminated"]) if "terminated" in data else np.zeros(reward.shape, dtype=bool)
    return LoggedRows(observation, action, after, reward, terminated, np.zeros(len(action), dtype=np.int64))


def _of_episodes(data: EpisodeDataset) -> LoggedRows:
    parts: list[list[ndarray]] = [[] for _ in LoggedRows._fields]
    for number, episode in enumerate(data.iterate_episodes()):
        observations, actions = np.asarray(flatten(episode.observations)), np.asarray(episode.actions)
        if len(observations) != len(actions) + 1:
            raise EnvironmentDataError(
                f"logged episode {number} has {len(actions)} actions, so it must have {len(actions) + 1} observations, "
                f"got {len(observations)}"
            )
        columns = (
            observations[:-1],
            actions,
            observations[1:],
            np.asarray(episode.rewards),
            np.asarray(episode.terminations),
            np.full(len(actions), number),
        )
        for part, column in zip(parts, columns, strict=True):
            part.append(column)
    if not parts[0]:
        raise EnvironmentDataError("the logged dataset has no episodes")
    return LoggedRows(*(np.concatenate(part) for part in parts))


def _of_buffer(buffer: ReplayBuffer) -> LoggedRows:
    """In the order in which they were added, one environment after the other.

    A buffer with ``optimize_memory_usage`` has lost what each episode ended in, the newest step aside: the last steps
    of its episodes are left out.
    """
    size, position = buffer.buffer_size, buffer.pos
    steps = (np.arange(size) + position) % size if buffer.full else np.arange(position)
    if isinstance(buffer, DictReplayBuffer):
        before, after = flatten(buffer.observations)[steps], flatten(buffer.next_observations)[steps]
    elif buffer.optimize_memory_usage:
        # The next observation stands where the next step's own is, and has overwritten the oldest step's. At an
        # episode's end the reset's has come in its place.
        steps = steps[1:] if buffer.full else steps
        before, after = buffer.observations[steps], buffer.observations[(steps + 1) % size]
    else:
        before, after = buffer.observations[steps], buffer.next_observations[steps]
    dones = buffer.dones[steps].astype(bool)
    terminated = dones & ~buffer.timeouts[steps].astype(bool)
    episode = np.cumsum(dones, axis=0) - dones
    episode = episode + np.concatenate([[0], np.cumsum(episode.max(axis=0, initial=0) + 1)[:-1]])
    columns = (before, buffer.actions[steps], after, buffer.rewards[steps], terminated, episode)
    known = np.ones_like(dones)
    if buffer.optimize_memory_usage:
        known[:-1] = ~dones[:-1]
    return LoggedRows(*(column.swapaxes(0, 1)[known.T] for column in columns))


def _flat_actions(action: ndarray, space: spaces.Box) -> ndarray:
    """Actions of the space's shape as vectors; those of any other shape as they are, to be refused."""
    shaped = action.ndim == 1 + len(space.shape) and action.shape[1:] == space.shape
    return action.reshape(len(action), flat_size(space)) if shaped else action


def _unscaled(action: Float[ndarray, "n A"], space: spaces.Box, scaled: bool) -> ndarray:
    low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
    least, most = (np.full_like(low, -1.0), np.ones_like(high)) if scaled else (low, high)
    margin = ROUNDING * (most - least)
    outside = np.argwhere((action < least - margin) | (action > most + margin))
    if len(outside):
        row, component = outside[0]
        told = "scaled to [-1, 1]" if scaled else f"within {low.tolist()} and {high.tolist()}"
        raise EnvironmentDataError(
            f"logged actions must be {told}, got {action[row, component]} in component {component} of step {row}, and "
            f"{len(outside) - 1} more such numbers. scaled_actions={not scaled} reads them the other way; if the "
            "environment has clipped them, clip them before they are added"
        )
    if not scaled:
        return action
    return low + (action + 1) / 2 * (high - low)
