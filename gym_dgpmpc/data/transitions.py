"""The store of everything observed: validated at the door, float32, growing without limit.

Where observations come as float64 they are kept as such too, beside what they are in float32. Rows are copied in and
handed out as views. A buffer that is full is replaced by one of twice the size, so adding a row costs a constant on
average.
"""

from typing import SupportsFloat

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from torch import Tensor

from gym_dgpmpc.errors import CheckpointError, EnvironmentDataError
from gym_dgpmpc.types import StateDict, Transitions

EXACT = {"observation": "exact_observation", "next_observation": "exact_next_observation"}
"""Fields that are kept as float64 too, and the names under which they are."""


def _empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.empty(*shape, dtype=dtype, device="cpu")


class TransitionStore:
    """The transitions of all episodes, in the order in which they were performed.

    A batch that is refused leaves the store as it was, so a bad observation never costs what was gathered before.

    Args:
        observation_size: S.
        action_size: A.
        capacity: rows to reserve at first; the store grows beyond it by itself.
        observation_dtype: float64 keeps observations in that precision too, for `exact_transitions`.

    Raises:
        ValueError: a size or the capacity is not positive.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        capacity: int = 1024,
        *,
        observation_dtype: torch.dtype = torch.float32,
    ):
        if min(observation_size, action_size, capacity) < 1:
            raise ValueError(
                "observation_size, action_size and capacity must be at least 1, "
                f"got {observation_size}, {action_size} and {capacity}"
            )
        self.observation_size = observation_size
        self.action_size = action_size
        self._length = 0
        self._buffers = {
            "observation": _empty(capacity, observation_size),
            "action": _empty(capacity, action_size),
            "next_observation": _empty(capacity, observation_size),
            "reward": _empty(capacity),
            "terminated": _empty(capacity, dtype=torch.bool),
            "episode": _empty(capacity, dtype=torch.int64),
        }
        self._names = tuple(self._buffers)  # of what a row is added as
        if observation_dtype == torch.float64:
            for name in EXACT.values():
                self._buffers[name] = _empty(capacity, observation_size, dtype=torch.float64)

    def __len__(self) -> int:
        return self._length

    def append(
        self,
        observation: ArrayLike,
        action: ArrayLike,
        next_observation: ArrayLike,
        *,
        reward: SupportsFloat,
        terminated: bool | np.bool_ = False,
        episode: int = 0,
    ) -> None:
        """Add one step: ``observation`` and ``next_observation`` [S], ``action`` [A].

        Raises:
            EnvironmentDataError: a shape is wrong, a component is not finite as float32, or a termination or episode is
                not what its kind can hold.
        """
        row = (observation, action, next_observation, reward, terminated, episode)
        self._add(*(np.asarray(value)[None] for value in row))

    def extend(
        self,
        observation: ArrayLike,
        action: ArrayLike,
        next_observation: ArrayLike,
        *,
        reward: ArrayLike,
        terminated: ArrayLike,
        episode: ArrayLike,
    ) -> None:
        """Add n steps, or none of them: observations [n, S], actions [n, A] and the rest [n].

        Raises:
            EnvironmentDataError: a shape is wrong, a component is not finite as float32, or a termination or episode is
                not what its kind can hold.
        """
        rows = (observation, action, next_observation, reward, terminated, episode)
        self._add(*(np.asarray(value) for value in rows))

    def transitions(self) -> Transitions:
        """All transitions, as views: they stay as they are when more rows are added, and must not be written to."""
        return Transitions(*(self._view(name) for name in Transitions._fields))

    def exact_transitions(self) -> Transitions:
        """All transitions as views, the observations in the precision that they came in: float64, or float32."""
        return Transitions(*(self._view(self._exact(name)) for name in Transitions._fields))

    def _exact(self, name: str) -> str:
        """The buffer that holds the field in the precision it came in."""
        exact = EXACT.get(name, name)
        return exact if exact in self._buffers else name

    @property
    def rewards(self) -> Float[Tensor, "N"]:
        return self._view("reward")

    @property
    def terminated(self) -> Bool[Tensor, "N"]:
        return self._view("terminated")

    @property
    def episodes(self) -> Int[Tensor, "N"]:
        """The index of the episode to which each row belongs."""
        return self._view("episode")

    def state_dict(self) -> StateDict:
        """The rows, copied, without the spare capacity."""
        return {name: self._view(name).clone() for name in self._buffers}

    def load_state_dict(self, state: StateDict) -> None:
        """Replace all rows by those of ``state``; on an error the store is as it was.

        Raises:
            CheckpointError: a field is missing or unknown, or does not fit the sizes of this store.
        """
        names = {name: name for name in self._names}
        if not set(EXACT.values()).isdisjoint(state):  # older files hold float32 alone
            names |= {name: self._exact(name) for name in EXACT}
        if set(state) != {*self._names, *names.values()}:
            raise CheckpointError(
                f"stored transitions must have the fields {sorted(self._buffers)}, got {sorted(state)}"
            )
        fields = []
        for name in names.values():
            value = state[name]
            if not isinstance(value, Tensor) or value.dtype != self._buffers[name].dtype:
                received = value.dtype if isinstance(value, Tensor) else type(value).__name__
                raise CheckpointError(f"stored {name} must be a {self._buffers[name].dtype} tensor, got {received}")
            fields.append(value.detach().cpu().numpy())
        loaded = TransitionStore(
            self.observation_size,
            self.action_size,
            len(self._buffers["reward"]),
            observation_dtype=self._buffers[self._exact("observation")].dtype,
        )
        try:
            loaded._add(*fields)
        except EnvironmentDataError as error:
            raise CheckpointError(f"the stored transitions do not fit this store: {error}") from error
        for name in EXACT:
            if not isinstance(state[name], Tensor) or not torch.equal(state[name].cpu(), loaded._view(name)):
                raise CheckpointError(
                    f"stored {name} must be finite, and the float32 of {names[name]} where that is held"
                )
        self._buffers, self._length = loaded._buffers, loaded._length

    def _view(self, name: str) -> Tensor:
        return self._buffers[name][: self._length]

    @torch.inference_mode(False)  # of tensors made in it, no more rows could be added
    def _add(self, *fields: np.ndarray) -> None:
        """Add rows, their fields in the order of the buffers: check every field, and only then write."""
        rows = dict(zip(self._names, fields, strict=True))
        count = len(rows["reward"]) if rows["reward"].ndim else 0
        converted = {name: self._converted(name, value, count) for name, value in rows.items()}
        converted |= {self._exact(name): rows[name].astype(np.float64) for name in EXACT if self._exact(name) != name}
        self._reserve(self._length + count)
        for name, value in converted.items():
            self._buffers[name][self._length : self._length + count] = torch.from_numpy(value)
        self._length += count

    def _converted(self, name: str, value: np.ndarray, count: int) -> np.ndarray:
        """``value`` in the buffer's dtype, or an error that names the step, the field and what is wrong."""
        buffer = self._buffers[name]
        expected = (count, *buffer.shape[1:])
        if value.shape != expected:
            raise EnvironmentDataError(
                f"step {self._length}: {name} must have shape {expected}, steps first, got {value.shape}"
            )
        dtype = buffer.numpy().dtype
        if value.dtype.kind not in "fiub":
            raise EnvironmentDataError(f"step {self._length}: {name} must be numeric, got dtype {value.dtype}")
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is reported below, with its place
            converted = value.astype(dtype)
        kept = np.isfinite(converted) if buffer.is_floating_point() else converted == value
        bad = np.argwhere(~kept)
        if len(bad):
            row, *component = bad[0].tolist()
            where = f"{name}{component or ''}"
            wanted = {"b": "true or false", "i": "a whole number"}.get(dtype.kind, "finite as float32")
            raise EnvironmentDataError(
                f"step {self._length + row}: {where} must be {wanted}, got {value[tuple(bad[0])]}"
            )
        return converted

    def _reserve(self, length: int) -> None:
        """Make room for ``length`` rows, at least doubling; views handed out keep the buffer they look into."""
        capacity = len(self._buffers["reward"])
        if length <= capacity:
            return
        for name, old in self._buffers.items():
            new = old.new_empty(max(length, 2 * capacity), *old.shape[1:])
            new[: self._length] = old[: self._length]
            self._buffers[name] = new
