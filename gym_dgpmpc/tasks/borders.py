"""Where arrays come in from environments and go out to them: copied, of the right shape, with what was wrong named.

An environment may hand out one array again and again, write into what it is given, or return something else than its
spaces say. Nothing of that reaches what is stored: `guard` puts a `Border` around every environment of a VecEnv, and
what comes from a VecEnv whose environments cannot be reached goes through `received_batch` and `terminal_observation`.
"""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Float
from numpy import ndarray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from gym_dgpmpc.errors import DGPMPCError, EnvironmentDataError, EnvironmentFailedError


class Border(gymnasium.Wrapper):
    """Outside of all wrappers but Stable-Baselines3's monitor and ours: copies of actions go in, copies come out.

    Raises:
        EnvironmentDataError: `reset` or `step` returned something else than Gymnasium and the observation space say.
        EnvironmentFailedError: it raised an exception, which is the cause.
    """

    keeps_task = True  # for `known.find`

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        with failures_named("reset"):
            returned = self.env.reset(seed=seed, options=options)
        if not isinstance(returned, tuple) or len(returned) != 2 or not isinstance(returned[1], Mapping):
            raise EnvironmentDataError(
                "the environment's reset must return (observation, info), info a dict, as Gymnasium has it since 0.26, "
                f"got {type(returned).__name__} {returned!r}"
            )
        return received(returned[0], self.observation_space, "reset"), dict(returned[1])

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        with failures_named("step"):
            returned: Any = self.env.step(np.array(action))
        if not isinstance(returned, tuple) or len(returned) != 5 or not isinstance(returned[4], Mapping):
            size = f" of {len(returned)}" if isinstance(returned, tuple) else ""
            raise EnvironmentDataError(
                "the environment's step must return (observation, reward, terminated, truncated, info), info a dict, "
                f"as Gymnasium has it since 0.26, got {type(returned).__name__}{size} {returned!r}"
            )
        observation, reward, terminated, truncated, info = returned
        return (
            received(observation, self.observation_space, "step"),
            _number(reward, "reward"),
            _truth(terminated, "terminated"),
            _truth(truncated, "truncated"),
            dict(info),
        )


@contextmanager
def failures_named(method: str) -> Iterator[None]:
    """What the environment's ``method`` raises becomes the cause of an `EnvironmentFailedError`."""
    try:
        yield
    except DGPMPCError:
        raise
    except Exception as error:
        raise EnvironmentFailedError(f"the environment's {method} raised {type(error).__name__}: {error}") from error


def guard(vec_env: VecEnv) -> None:
    """Put a `Border` around every environment that runs in this process, in place; others are left as they are."""
    inner = vec_env.unwrapped
    if isinstance(inner, DummyVecEnv):
        inner.envs = [env if _has_border(env) else _with_border(env) for env in inner.envs]


def _with_border(env: gymnasium.Env) -> gymnasium.Env:
    """The environment in a `Border`, which stands within the outermost monitors: these write into the infos."""
    if not isinstance(env, Monitor):
        return Border(env)
    env.env = _with_border(env.env)
    return env


def _has_border(env: Any) -> bool:
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, Border):
            return True
        env = env.env
    return False


def received(observation: Any, space: spaces.Space, method: str) -> Any:
    """A copy of the observation that ``method`` returned, in the shape of ``space``: an array, or a dict of arrays.

    Args:
        observation: as many numbers as the space has. Axes of length one may be more or fewer.
        space: a Box, or a Dict of such. Parts that it does not name are left out.
        method: "reset" or "step", for the error.

    Raises:
        EnvironmentDataError: the numbers are more or fewer, or none.
    """
    if not isinstance(space, spaces.Dict):
        return _copied(observation, space.shape or (), f"the environment's {method} returned an observation")
    if not isinstance(observation, Mapping) or not set(space.spaces) <= set(observation):
        told = list(observation) if isinstance(observation, Mapping) else repr(observation)
        raise EnvironmentDataError(
            f"the environment's {method} must return a dict with the parts {list(space.spaces)}, got {told}"
        )
    return {
        key: _copied(observation[key], part.shape or (), f"the environment's {method} returned the part {key!r}")
        for key, part in space.spaces.items()
    }


def received_batch(observations: Any, shape: tuple[int, ...], method: str) -> Float[ndarray, "n S"]:
    """A copy of the observations that a VecEnv's ``method`` returned, of this ``shape`` [n, S].

    Raises:
        EnvironmentDataError: they have another one, or are no numbers.
    """
    array = np.array(observations)
    if array.shape != shape or array.dtype.kind not in "fiub":
        raise EnvironmentDataError(
            f"the environment's {method} must return observations of shape {shape}, environments first, got "
            f"{array.dtype} of shape {array.shape}"
        )
    return array


def terminal_observation(info: Mapping[str, Any], shape: tuple[int, ...]) -> Float[ndarray, "S"]:
    """A copy of the last observation of the episode that has ended, which Stable-Baselines3 hands over in ``info``.

    Raises:
        EnvironmentDataError: there is none, or it has another shape.
    """
    if "terminal_observation" not in info:
        raise EnvironmentDataError(
            "the VecEnv reset an environment without handing over its last observation, which belongs into "
            f'info["terminal_observation"]; info has {list(info)}'
        )
    return _copied(info["terminal_observation"], shape, "the VecEnv handed over a terminal_observation")


def _number(value: Any, name: str) -> float:
    """One number, be it an array or a tensor of one.

    Raises:
        EnvironmentDataError: it is none, or more than one.
    """
    try:
        return float(_copied(value, (), "")[()])
    except EnvironmentDataError as error:
        raise EnvironmentDataError(f"the environment's step must return one number as {name}, got {value!r}") from error


def _truth(value: Any, name: str) -> bool:
    """True or false, be it a number.

    Raises:
        EnvironmentDataError: it is neither.
    """
    number = _number(value, name)
    if number not in (0.0, 1.0):
        raise EnvironmentDataError(f"the environment's step must return true or false as {name}, got {value!r}")
    return bool(number)


def _copied(value: Any, shape: tuple[int, ...], what: str) -> ndarray:
    try:
        array = np.asarray(value).copy()
    except Exception as error:  # a ragged list, a tensor that requires a gradient
        raise EnvironmentDataError(f"{what} that cannot be made an array: {value!r} ({error})") from error
    if array.dtype.kind not in "fiub":
        raise EnvironmentDataError(f"{what} that is not numeric, but of dtype {array.dtype}: {value!r}")
    if array.size != np.prod(shape, dtype=int):
        raise EnvironmentDataError(f"{what} of shape {array.shape}, expected {shape}: {value!r}")
    return array.reshape(shape)


def warn_of_shared_memory(env: VecEnv, new_obs: ndarray, after: ndarray, dones: ndarray) -> bool:
    """Warn if, in another process, episodes seem to end in the observation that the next one begins with.

    There no `Border` can stand between an environment that fills one array again and again and the reset that does so.

    Returns:
        Whether it has warned.
    """
    ended = np.flatnonzero(dones)
    is_reached = isinstance(env.unwrapped, DummyVecEnv)
    if is_reached or not len(ended) or not np.array_equal(new_obs[ended], after[ended]):
        return False
    warnings.warn(
        f"an episode ended in exactly the observation that the next one begins with, {after[ended[0]]}: if the "
        "environment returns one array again and again and writes into it in reset, the true last observation is lost. "
        "Return copies of it, or make the environments in this process (DummyVecEnv)",
        stacklevel=4,
    )
    return True
