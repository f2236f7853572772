"""What the agent must know of its environment, found on it or given by the user, and checked at construction."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from torch import Tensor

from gym_dgpmpc.agents.env_state import remember_starts
from gym_dgpmpc.errors import UnknownRewardError
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn

REWARD_SIGNATURE = "reward_fn(observation [*b, S], action [*b, A], next_observation [*b, S]) -> reward [*b]"
TERMINATED_SIGNATURE = "terminated_fn(next_observation [*b, S]) -> terminated [*b], bool"


class Task(NamedTuple):
    """The functions that score a predicted trajectory, in raw environment units."""

    reward_fn: RewardFn
    terminated_fn: TerminatedFn | None
    """None: as far as the planner knows, episodes do not end."""


def wrapped_env(env: GymEnv | str) -> VecEnv:
    """The environment, or the registered one of this id, as a monitored VecEnv that can be planned for and resumed.

    Raises:
        ValueError, AssertionError: see `check_env`.
    """
    vec_env = BaseAlgorithm._wrap_env(maybe_make_env(env, 0))
    check_env(vec_env)
    remember_starts(vec_env)
    return vec_env


def find_task(
    env: VecEnv | None,
    reward_fn: RewardFn | None,
    terminated_fn: TerminatedFn | None,
    both_spaces: tuple[spaces.Space, spaces.Space] | None = None,
) -> Task:
    """The reward and termination to plan with: what the user gave, else what the environment (if any) offers.

    Raises:
        UnknownRewardError: neither gives a reward function.
        ValueError: a function does not return one value per state of a batch.
        TypeError: a function is not callable or does not return a tensor.
    """
    if both_spaces is None and env is not None:
        both_spaces = env.observation_space, env.action_space
    assert both_spaces is not None, "find_task needs an environment or its spaces"
    size = flat_size(both_spaces[0]), flat_size(both_spaces[1])
    reward_fn = offered_by(env, "reward_fn") if reward_fn is None else reward_fn
    terminated_fn = offered_by(env, "terminated_fn") if terminated_fn is None else terminated_fn
    if reward_fn is None:
        raise UnknownRewardError(
            f"{describe(env)} has no attribute 'reward_fn' and none was passed. Planning scores predicted "
            "trajectories, so it needs the reward as a function of batched torch tensors: pass reward_fn=... to the "
            f"agent or give the environment that attribute, with the signature {REWARD_SIGNATURE} where S = {size[0]}, "
            f"A = {size[1]} and *b stands for any leading dimensions"
        )
    observation, action, next_observation = _example_batch(*both_spaces)
    _check_function("reward_fn", REWARD_SIGNATURE, reward_fn, (observation, action, next_observation), is_bool=False)
    if terminated_fn is not None:
        _check_function("terminated_fn", TERMINATED_SIGNATURE, terminated_fn, (next_observation,), is_bool=True)
    return Task(reward_fn, terminated_fn)


def find_observation_spec(env: VecEnv | None, observation_spec: ObservationSpec | None) -> ObservationSpec:
    """How the dynamics model should read observations: as the user says, else the environment, else as they are."""
    if observation_spec is None:
        observation_spec = offered_by(env, "observation_spec")
    return ObservationSpec() if observation_spec is None else observation_spec


def check_env(env: VecEnv) -> None:
    """Refuse what cannot be planned for, naming what was received.

    Raises:
        ValueError: an observation that is not a vector of real numbers, an unbounded action, more than one
            environment, or normalised observations.
        AssertionError: an action space that is not a Box, as from every SB3 algorithm.
    """
    observation, action = env.observation_space, env.action_space
    if not isinstance(observation, spaces.Box) or len(observation.shape) != 1 or observation.dtype.kind != "f":
        raise ValueError(
            "the dynamics model learns vectors of real numbers: the observation space must be a one-dimensional Box of "
            f"floats, got {observation}. gymnasium.wrappers.FlattenObservation makes one of nested vectors; images are "
            "not supported"
        )
    assert isinstance(action, spaces.Box), (
        f"The algorithm only supports {spaces.Box} as action spaces but {action} was provided: "
        "the planner searches real-valued action sequences. For discrete actions see SB3's DQN or PPO"
    )
    if not bool(np.all(np.isfinite(action.low) & np.isfinite(action.high) & (action.low <= action.high))):
        raise ValueError(
            f"the planner needs finite action bounds, got low = {action.low} and high = {action.high}; "
            "gymnasium.wrappers.RescaleAction or ClipAction can supply them"
        )
    if env.num_envs != 1:
        raise ValueError(f"the agent learns in one environment at a time, got a VecEnv with num_envs = {env.num_envs}")
    normalize = unwrap_vec_normalize(env)
    if isinstance(normalize, VecNormalize) and normalize.norm_obs:
        raise ValueError(
            "got VecNormalize(norm_obs=True): its moving statistics would change the meaning of the transitions "
            "already stored and of the reward function. Use norm_obs=False; the dynamics model standardises for itself"
        )


def offered_by(env: VecEnv | None, name: str) -> Any:
    """An attribute of the (single) environment under all its wrappers, or None."""
    return env.get_attr(name)[0] if env is not None and env.has_attr(name) else None


def describe(env: VecEnv | None) -> str:
    """The environment's id if it is a registered one, else its class."""
    if env is None:
        return "the agent has no environment: none"
    spec = offered_by(env, "spec")
    return f"the environment {spec.id}" if spec is not None else f"the environment {offered_by(env, 'unwrapped')}"


def flat_size(space: spaces.Space) -> int:
    """How many numbers an element of a Box holds."""
    return int(np.prod(space.shape or ()))


def _example_batch(observation_space: spaces.Space, action_space: spaces.Space) -> tuple[Tensor, Tensor, Tensor]:
    """Two-dimensional batches [3, 2] of observations, actions and next observations to try a function on."""
    batch = []
    for seed, space in enumerate((observation_space, action_space, observation_space)):
        # A space of its own, so that the environment's sampling is not advanced.
        box = deepcopy(space)
        box.seed(seed)
        samples = np.stack([box.sample().ravel() for _ in range(6)])
        batch.append(torch.from_numpy(samples).float().reshape(3, 2, -1))
    return batch[0], batch[1], batch[2]


def _check_function(
    name: str, signature: str, function: Callable[..., Tensor], batch: tuple[Tensor, ...], *, is_bool: bool
) -> None:
    if not callable(function):
        raise TypeError(f"{name} must be a function {signature}, got {function!r}")
    shapes = ", ".join(str(list(tensor.shape)) for tensor in batch)
    kind = "bool" if is_bool else "float"
    expected = f"{name} must map tensors of shapes {shapes} to a {kind} tensor [3, 2]; its signature is {signature}"
    try:
        value = function(*batch)
    except Exception as error:
        raise ValueError(f"{expected}. It raised {type(error).__name__}: {error}") from error
    if not isinstance(value, Tensor):
        raise TypeError(f"{expected}. It returned {type(value).__name__}")
    if value.shape != (3, 2) or (value.dtype == torch.bool) != is_bool:
        raise ValueError(f"{expected}. It returned {value.dtype} of shape {list(value.shape)}")
