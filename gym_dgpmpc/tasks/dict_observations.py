"""Dict observations as vectors, and the reward and observation spec of goal environments.

A Dict of vectors becomes one vector, with the parts in the alphabetical order of their keys: (achieved_goal,
desired_goal, observation) in a goal environment.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from torch import Tensor

from gym_dgpmpc.types import ObservationSpec

ACHIEVED, DESIRED = "achieved_goal", "desired_goal"

REPEATS_ACHIEVED_GOAL = ("gymnasium_robotics.envs.fetch.", "gymnasium_robotics.envs.maze.point_maze")
"""Modules of the environments whose "observation" repeats the achieved goal."""


class FlatDict(VecEnvWrapper):
    """A VecEnv of Dict observations, whose observations it makes vectors.

    Args:
        venv: its observation space must be a Dict of one-dimensional Boxes of floats.

    Attributes:
        dict_space: the observation space of ``venv``.
        layout: where in the vector each part is.

    Raises:
        ValueError: see `check_dict_space`.
    """

    def __init__(self, venv: VecEnv):
        space = venv.observation_space
        assert isinstance(space, spaces.Dict), f"FlatDict is for Dict observations, got {space}"
        check_dict_space(space)
        self.dict_space = space
        boxes = [space[key] for key in sorted(space.spaces)]
        low, high = (np.concatenate([getattr(box, name) for box in boxes]) for name in ("low", "high"))
        super().__init__(venv, spaces.Box(low, high, dtype=low.dtype.type))
        self.layout = layout_of(space)

    def reset(self) -> np.ndarray:
        return flatten(self.venv.reset())

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, rewards, dones, infos = self.venv.step_wait()
        flat_infos = [
            {**info, "terminal_observation": flatten(info["terminal_observation"])}
            if "terminal_observation" in info
            else info
            for info in infos
        ]
        return flatten(observation), rewards, dones, flat_infos


def check_dict_space(space: spaces.Dict) -> None:
    """Refuse a Dict of which no vector of real numbers can be made.

    Raises:
        ValueError: it has no parts, or one is not a one-dimensional Box of floats.
    """
    if not space.spaces:
        raise ValueError(f"a Dict observation space must have at least one part, got {space}")
    for key, part in space.items():
        if not isinstance(part, spaces.Box) or len(part.shape) != 1 or part.dtype.kind != "f":
            raise ValueError(
                "every part of a Dict observation space must be a one-dimensional Box of floats, got "
                f"{part} for {key!r}. Leave the part out with gymnasium.wrappers.FilterObservation, or make nested "
                "parts one vector with FlattenObservation, and floats of whole numbers with DtypeObservation "
                "around it; images are not supported"
            )


def flattened(env: VecEnv) -> VecEnv:
    """The environment, in a `FlatDict` if its observations are Dicts."""
    return FlatDict(env) if isinstance(env.observation_space, spaces.Dict) else env


def flatten(observation: Any) -> Any:
    """The parts of a Dict observation, or of a batch of them, joined along the last dimension; others unchanged."""
    if not isinstance(observation, Mapping):
        return observation
    return np.concatenate([np.asarray(observation[key]) for key in sorted(observation)], axis=-1)


def unflattened(
    vectors: Float[np.ndarray, "n S"], space: spaces.Space
) -> Float[np.ndarray, "n S"] | dict[str, np.ndarray]:
    """n observations as a space has them, the inverse of `flatten`: vectors, or a Dict of parts [n, ...]."""
    if not isinstance(space, spaces.Dict):
        return vectors.astype(space.dtype)
    return {key: vectors[:, part].astype(space[key].dtype) for key, part in layout_of(space).items()}


def check_parts(observation: Any, parts: dict[str, slice]) -> None:
    """Refuse a Dict observation, or a batch of them, whose parts are not those of `layout`; empty ``parts`` allow any.

    Raises:
        ValueError: a part is missing, unknown or of the wrong shape.
    """
    if not isinstance(observation, Mapping) or not parts:
        return
    expected = {key: (part.stop - part.start,) for key, part in parts.items()}
    received = {key: np.shape(part) for key, part in observation.items()}
    batch = next(iter(received.values()), ())[:-1]
    if len(batch) > 1 or received != {key: (*batch, *shape) for key, shape in expected.items()}:
        raise ValueError(
            f"expected a dict of the shapes {expected}, or with a first dimension n in each, got {received}"
        )


def layout_of(space: spaces.Space) -> dict[str, slice]:
    """Where in the vector each part of a Dict space is."""
    assert isinstance(space, spaces.Dict)
    layout, start = {}, 0
    for key in sorted(space.spaces):
        size = int(np.prod(space[key].shape or ()))
        layout[key] = slice(start, start + size)
        start += size
    return layout


def layout(env: VecEnv | None) -> dict[str, slice]:
    """Where in the vectors of a `FlatDict` each part is; empty for any other environment, and for None."""
    flat = _flat_dict(env)
    return {} if flat is None else flat.layout


def original_space(env: VecEnv | None, space: spaces.Space) -> spaces.Space:
    """The Dict space of the environment in a `FlatDict`; ``space`` for any other environment, and for None."""
    flat = _flat_dict(env)
    return space if flat is None else flat.dict_space


def goal_spec(env: VecEnv | None) -> ObservationSpec:
    """How to read a goal environment's vectors: the goal is constant in an episode, and only the reward depends on it.

    Hindsight relabelling assumes the same. Where "observation" repeats the achieved goal, only the repetition is an
    input.
    """
    parts = layout(env)
    if DESIRED not in parts:
        return ObservationSpec()
    assert env is not None
    goal = _indices(parts[DESIRED])
    module = type(env.get_attr("unwrapped")[0]).__module__ if hasattr(env.unwrapped, "envs") else ""
    repeated = _indices(parts[ACHIEVED]) if module.startswith(REPEATS_ACHIEVED_GOAL) else ()
    return ObservationSpec(constant=goal, not_inputs=(*repeated, *goal))


@dataclass(frozen=True)
class GoalReward:
    """A goal environment's `compute_reward` as a `gym_dgpmpc.types.RewardFn`, on the goal that the step achieved.

    Attributes:
        compute_reward: (achieved [*b, G], desired [*b, G], info) -> reward [*b], in NumPy, as hindsight relabelling
            needs it.
        achieved: where in the vector the achieved goal is.
        desired: where in the vector the desired goal is.
        in_rows: whether it is called as Stable-Baselines3's HER calls it, with goals [n, G] and a list of n infos;
            else with goals [*b, G] and one. Infos are empty dicts: nobody knows what a predicted step would tell.
    """

    compute_reward: Callable[[np.ndarray, np.ndarray, Any], Any]
    achieved: slice
    desired: slice
    in_rows: bool = False

    @classmethod
    def of(cls, env: VecEnv | None) -> "GoalReward | None":
        """The reward of an environment that has both goals and `compute_reward`; None for any other environment."""
        parts = layout(env)
        if env is None or not {ACHIEVED, DESIRED} <= set(parts) or not env.has_attr("compute_reward"):
            return None

        def compute_reward(achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
            # Called by its name, because the environment may be in another process.
            return env.env_method("compute_reward", achieved, desired, info, indices=[0])[0]

        return cls(compute_reward, parts[ACHIEVED], parts[DESIRED])

    def __call__(
        self,
        observation: Float[Tensor, "*b S"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S"],
    ) -> Float[Tensor, "*b"]:
        """The rewards of the steps; they do not depend on ``observation`` and ``action``."""
        achieved, desired = (
            np.array(next_observation[..., part].double().cpu().numpy()) for part in (self.achieved, self.desired)
        )
        batch = achieved.shape[:-1]
        if self.in_rows:
            achieved, desired = (goals.reshape(-1, goals.shape[-1]) for goals in (achieved, desired))
            count = len(achieved)
            reward = np.array(self.compute_reward(achieved, desired, [{} for _ in range(count)]))
            reward = reward.reshape(batch) if reward.shape == (count,) else reward
        else:
            reward = np.array(self.compute_reward(achieved, desired, {}))
        return torch.as_tensor(reward, dtype=next_observation.dtype, device=next_observation.device)


def _indices(part: slice) -> tuple[int, ...]:
    return tuple(range(part.start, part.stop))


def _flat_dict(env: VecEnv | None) -> FlatDict | None:
    """The `FlatDict` among an environment's wrappers."""
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, FlatDict):
            return env
        env = env.venv
    return None
