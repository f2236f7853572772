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
OPTIONAL = ("terminated", "episode")
FIELDS = (*REQUIRED, *OPTIONAL)
ROUNDING = 1e-4
"""Logged actions may leave their bounds by this fraction of their range."""


@runtime_checkable
class EpisodeDataset(Protocol):
    """What is read here of a Minari dataset. An episode has one observation more than actions."""

    def iterate_episodes(self) -> Iterator[Any]: ...


Logged = Mapping[str, Any] | ReplayBuffer | EpisodeDataset


class LoggedRows(NamedTuple):
    """n logged steps; ``episode`` numbers their episodes from 0 on."""

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
        scaled_actions: whether the actions are scaled to [-1, 1]. None: they are in a `ReplayBuffer`, and else not.
        observation_space: one-dimensional.
        action_space: finite bounds.

    Raises:
        EnvironmentDataError: there are no transitions, a field is missing, unknown or of the wrong shape, an episode's
            number is not an integer, or an action is out of bounds.
        TypeError: the data are not of a kind that can be read.
    """
    if isinstance(data, ReplayBuffer):
        rows, in_buffer = _from_buffer(data), True
    elif isinstance(data, Mapping):
        rows, in_buffer = _from_mapping(data), False
    elif isinstance(data, EpisodeDataset):
        rows, in_buffer = _from_episodes(data), False
    else:
        raise TypeError(
            f"logged transitions must be a mapping with the arrays {', '.join(FIELDS)}, a ReplayBuffer of "
            f"Stable-Baselines3 or a Minari dataset, got {type(data).__name__}"
        )
    rows = rows._replace(action=_flat_actions(rows.action, action_space))
    sizes = {"observation": observation_space.shape, "action": (flat_size(action_space),)}
    sizes |= {"next_observation": observation_space.shape, "reward": (), "terminated": (), "episode": ()}
    count = len(rows.action)
    for name, value in rows._asdict().items():
        if value.shape != (count, *sizes[name]):
            raise EnvironmentDataError(
                f"logged {name} must have the shape {[count, *sizes[name]]}, because there are {count} actions in "
                f"{action_space} and observations are in {observation_space}, got {list(value.shape)}"
            )
    if not count:
        raise EnvironmentDataError("the logged data hold 0 transitions; at least 1 is needed")
    scaled = in_buffer if scaled_actions is None else scaled_actions
    return rows._replace(action=_unscaled(rows.action, action_space, scaled))


def _from_mapping(data: Mapping[str, Any]) -> LoggedRows:
    missing, unknown = [name for name in REQUIRED if name not in data], sorted(set(data) - set(FIELDS))
    if missing or unknown:
        raise EnvironmentDataError(
            f"logged transitions must have the fields {', '.join(REQUIRED)} and may have {', '.join(OPTIONAL)}; "
            f"missing: {missing}, unknown: {unknown}"
        )
    observation, action, after, reward = (np.asarray(flatten(data[name])) for name in REQUIRED)
    terminated = np.asarray(data["terminated"]) if "terminated" in data else np.zeros(reward.shape, dtype=bool)
    episode = _numbered(data["episode"]) if "episode" in data else np.zeros(len(action), dtype=np.int64)
    return LoggedRows(observation, action, after, reward, terminated, episode)


def _numbered(episode: Any) -> ndarray:
    """Episode numbers, whatever they are, as 0, 1, ... in the same order."""
    array = np.asarray(episode)
    if array.dtype.kind not in "iu":
        raise EnvironmentDataError(f"logged episode must hold integers, got dtype {array.dtype}")
    return np.unique(array, return_inverse=True)[1] if array.ndim == 1 else array  # others are refused by their shape


def _from_episodes(data: EpisodeDataset) -> LoggedRows:
    columns: list[list[ndarray]] = [[] for _ in LoggedRows._fields]
    for number, episode in enumerate(data.iterate_episodes()):
        observations, actions = np.asarray(flatten(episode.observations)), np.asarray(episode.actions)
        if len(observations) != len(actions) + 1:
            raise EnvironmentDataError(
                f"logged episode {number} must have {len(actions) + 1} observations, one more than its "
                f"{len(actions)} actions, got {len(observations)}"
            )
        values = (
            observations[:-1],
            actions,
            observations[1:],
            np.asarray(episode.rewards),
            np.asarray(episode.terminations),
            np.full(len(actions), number),
        )
        for column, value in zip(columns, values, strict=True):
            column.append(value)
    if not columns[0]:
        raise EnvironmentDataError("the logged dataset holds 0 episodes; at least 1 is needed")
    return LoggedRows(*(np.concatenate(column) for column in columns))


def _from_buffer(buffer: ReplayBuffer) -> LoggedRows:
    """The rows in the order in which they were added, one environment after the other.

    A buffer with ``optimize_memory_usage`` keeps no next observation for the last step of an episode, unless that is
    the newest step. These steps are left out.
    """
    size, position = buffer.buffer_size, buffer.pos
    steps = (np.arange(size) + position) % size if buffer.full else np.arange(position)
    if isinstance(buffer, DictReplayBuffer):
        before, after = flatten(buffer.observations)[steps], flatten(buffer.next_observations)[steps]
    elif buffer.optimize_memory_usage:
        # A step's next observation is kept only as the observation of the row after it. In a full buffer, that of the
        # newest step has overwritten the oldest step's observation. After the last step of an episode, the row holds
        # the observation of the reset.
        steps = steps[1:] if buffer.full else steps
        before, after = buffer.observations[steps], buffer.observations[(steps + 1) % size]
    else:
        before, after = buffer.observations[steps], buffer.next_observations[steps]
    dones = buffer.dones[steps].astype(bool)
    terminated = dones & ~buffer.timeouts[steps].astype(bool)
    episode = np.cumsum(dones, axis=0) - dones
    episode = episode + np.concatenate([[0], np.cumsum(episode.max(axis=0, initial=0) + 1)[:-1]])
    columns = (before, buffer.actions[steps], after, buffer.rewards[steps], terminated, episode)
    is_complete = np.ones_like(dones)
    if buffer.optimize_memory_usage:
        is_complete[:-1] = ~dones[:-1]
    return LoggedRows(*(column.swapaxes(0, 1)[is_complete.T] for column in columns))


def _flat_actions(action: ndarray, space: spaces.Box) -> ndarray:
    """Actions of the space's shape as vectors. Others are returned unchanged, for the check of shapes to refuse."""
    has_shape = action.ndim == 1 + len(space.shape) and action.shape[1:] == space.shape
    return action.reshape(len(action), flat_size(space)) if has_shape else action


def _unscaled(action: Float[ndarray, "n A"], space: spaces.Box, scaled: bool) -> ndarray:
    low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
    least, most = (np.full_like(low, -1.0), np.ones_like(high)) if scaled else (low, high)
    margin = ROUNDING * (most - least)
    outside = np.argwhere((action < least - margin) | (action > most + margin))
    if len(outside):
        row, component = outside[0]
        expected = "scaled to [-1, 1]" if scaled else f"within {low.tolist()} and {high.tolist()}"
        raise EnvironmentDataError(
            f"logged actions must be {expected}, got {action[row, component]} in component {component} of step {row} "
            f"({len(outside)} numbers are out of bounds). If they are {'not ' if scaled else ''}scaled to [-1, 1], "
            f"pass scaled_actions={not scaled}; if the environment clipped them, clip them before adding them"
        )
    if not scaled:
        return action
    return low + (action + 1) / 2 * (high - low)
