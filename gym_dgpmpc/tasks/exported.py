"""The transition store as data for other libraries: arrays, SB3's replay buffers, Minari's datasets.

The inverse of `logged.py`: `MPCAgent.add_transitions` takes back everything that is made here.

The store does not keep truncations. Buffers and datasets mark a step as truncated if it is the last of its episode and
did not terminate: at a time limit, in an episode that is still running, or where the next row does not begin where this
one ended.
"""

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import EnvironmentDataError
from gym_dgpmpc.tasks.actions import performed
from gym_dgpmpc.tasks.dict_observations import layout_of


def arrays(store: TransitionStore, observation_space: spaces.Space, action_space: spaces.Box) -> dict[str, Any]:
    """Copies of the n stored steps, in the order in which they were stored.

    Args:
        store: not empty.
        observation_space: the environment's own, a one-dimensional Box or a Dict of such; see
            `dict_observations.original_space`.
        action_space: finite bounds.

    Returns:
        "observation" and "next_observation" [n, S], or dicts of such; "action" [n, ...], in the action space's shape;
        "reward" and "terminated" [n]; "episode" [n], the number of the episode to which a step belongs. Observations
        and actions have the dtypes of their spaces.

    Raises:
        EnvironmentDataError: the store is empty.
    """
    if not len(store):
        raise EnvironmentDataError("the store holds 0 transitions, so there is nothing to export: call learn first")
    observation, action, after = (column.numpy() for column in store.exact_transitions())
    return {
        "observation": _in_space(observation, observation_space),
        "action": performed(action, action_space),
        "next_observation": _in_space(after, observation_space),
        "reward": store.rewards.numpy().copy(),
        "terminated": store.terminated.numpy().copy(),
        "episode": store.episodes.numpy().copy(),
    }


def replay_buffer(
    store: TransitionStore,
    observation_space: spaces.Space,
    action_space: spaces.Box,
    buffer_size: int | None = None,
    device: torch.device | str = "auto",
) -> ReplayBuffer:
    """The stored steps as SB3's off-policy algorithms keep them, one episode after the other.

    Actions are scaled to [-1, 1]. Truncations are marked as time limits, at which SB3 bootstraps. The buffer is for a
    single environment: an algorithm with several can train on it, but cannot add to it.

    Args:
        store, observation_space, action_space: see `arrays`.
        buffer_size: the rows of the buffer, so that an algorithm can add its own; at least as many as are stored, which
            is what None gives.
        device: where the buffer's samples are placed.

    Returns:
        A `DictReplayBuffer` for Dict observations.

    Raises:
        EnvironmentDataError: the store is empty.
    """
    columns = arrays(store, observation_space, action_space)
    order, is_last = _by_episode(store)
    low, high = action_space.low.astype(np.float64), action_space.high.astype(np.float64)
    width = np.where(high > low, high - low, 1.0)  # a number that is fixed has none
    scaled = 2.0 * (columns["action"] - low) / width - 1.0
    kind: Any = DictReplayBuffer if isinstance(observation_space, spaces.Dict) else ReplayBuffer
    buffer = kind(max(len(store), buffer_size or 0), observation_space, action_space, device)
    for row, done in zip(order, is_last, strict=True):
        buffer.add(
            _rows_of(columns["observation"], row),
            _rows_of(columns["next_observation"], row),
            scaled[row],
            columns["reward"][row],
            done,
            [{"TimeLimit.truncated": done and not columns["terminated"][row]}],
        )
    return buffer


def minari_dataset(
    store: TransitionStore,
    observation_space: spaces.Space,
    action_space: spaces.Box,
    dataset_id: str,
    **metadata: Any,
) -> Any:
    """Write the stored episodes as a new dataset into Minari's folder, from where `minari.load_dataset` reads it.

    Args:
        store, observation_space, action_space: see `arrays`.
        dataset_id: "namespace/name-v0".
        **metadata: further arguments of `minari.create_dataset_from_buffers`, such as ``env``, ``algorithm_name``,
            ``author`` and ``description``. Minari warns about those that are missing.

    Returns:
        The `minari.MinariDataset`.

    Raises:
        EnvironmentDataError: the store is empty.
        ImportError: Minari is not installed.
        ValueError: the id is not one of Minari's, or there is such a dataset already.
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError as error:
        raise ImportError('a Minari dataset needs the package minari: pip install "gym-dgpmpc[minari]"') from error
    columns = arrays(store, observation_space, action_space)
    order, is_last = _by_episode(store)
    episodes = [
        EpisodeBuffer(
            id=number,
            observations=_joined(columns["observation"], columns["next_observation"], rows),
            actions=columns["action"][rows],
            rewards=columns["reward"][rows],
            terminations=columns["terminated"][rows],
            truncations=(rows == rows[-1]) & ~columns["terminated"][rows],
        )
        for number, rows in enumerate(np.split(order, np.flatnonzero(is_last)[:-1] + 1))
    ]
    own_spaces = {"observation_space": observation_space, "action_space": action_space}
    return minari.create_dataset_from_buffers(dataset_id, episodes, **{**own_spaces, **metadata})


def _by_episode(store: TransitionStore) -> tuple[Int[ndarray, " n"], Bool[ndarray, " n"]]:
    """The rows of the store, one episode after the other, and which of them are the last of an episode.

    Environments that run side by side store their steps in turns. Logged arrays without episode numbers are stored as
    one episode, whatever they hold. It is split after each termination, and where a row does not begin where the one
    before it ended.
    """
    order = np.argsort(store.episodes.numpy(), kind="stable")
    episode, terminated = store.episodes.numpy()[order], store.terminated.numpy()[order]
    observation, _, after = (column.numpy()[order] for column in store.transitions())
    continues = (episode[1:] == episode[:-1]) & (observation[1:] == after[:-1]).all(axis=1)
    return order, np.append(terminated[:-1] | ~continues, True)


def _in_space(vectors: Float[ndarray, "n S"], space: spaces.Space) -> Any:
    """A copy of the vectors in the space's dtype; for a Dict space, a dict with the columns of each key."""
    if not isinstance(space, spaces.Dict):
        return vectors.astype(space.dtype)
    return {key: vectors[:, columns].astype(space[key].dtype) for key, columns in layout_of(space).items()}


def _rows_of(observations: Any, rows: Any) -> Any:
    """Rows of observations, or of each array in a dict of them."""
    if isinstance(observations, dict):
        return {key: values[rows] for key, values in observations.items()}
    return observations[rows]


def _joined(before: Any, after: Any, rows: Int[ndarray, " n"]) -> Any:
    """The n + 1 observations of an episode of n steps."""
    if isinstance(before, dict):
        return {key: _joined(before[key], after[key], rows) for key in before}
    return np.concatenate([before[rows], after[rows[-1:]]])
