"""The environment as the agent has it: a VecEnv that can be planned for, and what is asked of it by name.

`task.py` finds rewards, terminations and observation specs on what is made here.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from gym_dgpmpc.tasks.borders import guard
from gym_dgpmpc.tasks.dict_observations import check_dict_space, flattened, layout
from gym_dgpmpc.tasks.replay import options_to_reset, remember_starts

MOVING = (gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward)
"""Wrappers whose statistics follow what they see, unless they are frozen."""


def wrapped_env(env: GymEnv | str) -> VecEnv:
    """The environment, or the registered one of this id, as a monitored VecEnv that can be planned for and resumed.

    Dict observations come out of it as vectors.

    Raises:
        TypeError: it is neither an environment nor the id of one.
        ValueError, AssertionError: see `check_env`.
    """
    _refuse_no_environment(env)
    made = maybe_make_env(env, 0)
    check_observation_space(made.observation_space)  # before Stable-Baselines3 fails at those that it cannot hold
    vec_env = flattened(BaseAlgorithm._wrap_env(made))
    check_env(vec_env)
    guard(vec_env)
    remember_starts(vec_env)
    return vec_env


def _refuse_no_environment(env: object) -> None:
    if not isinstance(env, (str, gym.Env, VecEnv)):
        told = (
            f"the class {env.__name__}: make an instance" if isinstance(env, type) else f"{type(env).__name__} {env!r}"
        )
        raise TypeError(
            "env must be a Gymnasium environment, the id of a registered one, or a VecEnv of Stable-Baselines3 "
            f"(`make_vec_env`; not Gymnasium's own vector environments), got {told}"
        )


def check_env(env: VecEnv) -> None:
    """Refuse what cannot be planned for, naming what was received.

    Raises:
        ValueError: an observation that is not a vector of real numbers, an action that is unbounded or not of real
            numbers, or observations or rewards that are normalised by moving statistics.
        AssertionError: an action space that is not a Box, as from every SB3 algorithm.
    """
    check_observation_space(env.observation_space)
    action = env.action_space
    assert isinstance(action, spaces.Box), (
        f"The algorithm only supports {spaces.Box} as action spaces but {action} was provided: "
        "the planner searches real-valued action sequences. For discrete actions see SB3's DQN or PPO"
    )
    if action.dtype.kind != "f" or not flat_size(action):
        raise ValueError(
            "the planner searches actions of one or more real numbers: the action space must be a Box of floats, got "
            f"{action}. "
            "gymnasium.wrappers.TransformAction can round them for an environment that takes whole numbers"
        )
    bad = ~(np.isfinite(action.low) & np.isfinite(action.high) & (action.low <= action.high))
    if bad.any():
        where = "" if bad.all() else f" (those at {np.argwhere(bad).tolist()} are not)"
        raise ValueError(
            f"the planner needs finite action bounds{where}, got low = {action.low} and high = {action.high}; "
            "gymnasium.wrappers.TransformAction(env, lambda action: action, Box(low, high)) gives an environment bounds"
        )
    with np.errstate(over="ignore"):  # the planner has float32
        width = action.high.astype(np.float32) - action.low.astype(np.float32)
    if not np.isfinite(width).all():
        raise ValueError(
            f"the planner needs action bounds whose distance float32 can hold, got low = {action.low} and high = "
            f"{action.high}; gymnasium.wrappers.RescaleAction(env, -1.0, 1.0) gives an environment other bounds"
        )
    normalize = unwrap_vec_normalize(env)
    if isinstance(normalize, VecNormalize) and normalize.norm_obs:
        raise ValueError(
            "got VecNormalize(norm_obs=True): its moving statistics would change the meaning of the transitions "
            "already stored and of the reward function. Use norm_obs=False; the dynamics model standardises for itself"
        )
    normalizing = _moving_normalizer(env)
    if normalizing is not None:
        raise ValueError(
            f"got {normalizing}: its moving statistics would change the meaning of the transitions already stored and "
            "of the reward function. Leave it out, for the dynamics model standardises for itself, or freeze it with "
            "update_running_mean = False"
        )


def check_observation_space(space: spaces.Space) -> None:
    """Refuse observations that are neither a vector of real numbers nor a Dict of such.

    Raises:
        ValueError: they are none.
    """
    if isinstance(space, spaces.Dict):
        check_dict_space(space)
    elif not isinstance(space, spaces.Box) or len(space.shape) != 1 or space.dtype.kind != "f" or not flat_size(space):
        raise ValueError(
            "the dynamics model learns vectors of one or more real numbers: the observation space must be a "
            f"one-dimensional Box of floats, or a Dict of such, got {space}. {_how_to_make_floats(space)}; images are "
            "not supported"
        )


def _how_to_make_floats(space: spaces.Space) -> str:
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return "gymnasium.wrappers.DtypeObservation(env, numpy.float32) makes floats of whole numbers"
    return (
        "gymnasium.wrappers.FlattenObservation makes one vector of nested ones or of a matrix, and "
        "DtypeObservation(env, numpy.float32) floats of whole numbers"
    )


def _moving_normalizer(env: VecEnv) -> str | None:
    """The name of a wrapper of Gymnasium's whose statistics of observations or rewards are still moving."""
    inner = env.unwrapped
    if not isinstance(inner, DummyVecEnv):
        # In another process the outermost one is seen.
        names = {"obs_rms": "NormalizeObservation", "return_rms": "NormalizeReward"}
        is_moving = offered_by(inner, "update_running_mean") is True
        return next((named for name, named in names.items() if is_moving and inner.has_attr(name)), None)
    for layer in inner.envs:
        while isinstance(layer, gym.Wrapper):
            if isinstance(layer, MOVING) and layer.update_running_mean:
                return type(layer).__name__
            layer = layer.env
    return None


def offered_by(env: VecEnv | None, name: str) -> Any:
    """An attribute of the (first) environment under all its wrappers, or None.

    Raises:
        ValueError: it cannot be sent from the process that the environment runs in, which has ended of it.
    """
    try:
        return env.get_attr(name)[0] if env is not None and env.has_attr(name) else None
    except (EOFError, ConnectionError) as error:
        raise ValueError(
            f"the environment's attribute {name!r} cannot be sent from the process that it runs in (its own error is "
            "printed above): what is pickled must be a function or class at the top level of a module, not a lambda or "
            f"a function within another. Or make the environment without it and pass {name}=... to the agent"
        ) from error


def environment_id(env: VecEnv | None) -> str | None:
    """What `gymnasium.make` makes the environment from, once this package is imported; None if it is not registered.

    The module of an environment from elsewhere stands before its id, for importing that is what registers it.
    """
    spec = offered_by(env, "spec")
    if spec is None:
        return None
    entry = spec.entry_point
    module = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "__main__")
    package = module.partition(".")[0]
    if package == "gymnasium_robotics":
        return f"gym_dgpmpc.envs.robotics:{spec.id}"
    return spec.id if package in ("gymnasium", "gym_dgpmpc", "__main__") else f"{module}:{spec.id}"


def time_limit(env: VecEnv | None) -> int | None:
    """Steps after which an episode is truncated, as far as the (first) environment says; else None."""
    limit = offered_by(env, "_max_episode_steps")  # of Gymnasium's TimeLimit, be the environment registered or not
    if limit is None:
        limit = getattr(offered_by(env, "spec"), "max_episode_steps", None)
    return int(limit) if isinstance(limit, int | np.integer) and limit > 0 else None


def about_environment(env: VecEnv) -> dict[str, Any]:
    """What a file says of the environment, as plain values: its id, the parts of Dict observations, reset's options."""
    return {
        "environment": environment_id(env),
        "observation_parts": {key: [part.start, part.stop] for key, part in layout(env).items()},
        "reset_options": options_to_reset(env, again=True),
    }


def describe(env: VecEnv) -> str:
    """The environment's id if it is a registered one, else its class."""
    spec = offered_by(env, "spec")
    return f"the environment {spec.id}" if spec is not None else f"the environment {offered_by(env, 'unwrapped')}"


def flat_size(space: spaces.Space) -> int:
    """How many numbers an element of a Box holds."""
    return int(np.prod(space.shape or ()))
