"""What the agent must know of its environment: given by the user, found on it, known of its class, or to be learned."""

import warnings
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    unwrap_vec_normalize,
)

from gym_dgpmpc.envs import known
from gym_dgpmpc.tasks.dict_observations import FlatDict, GoalReward, flattened, goal_spec
from gym_dgpmpc.tasks.first_batch import check_reward, check_termination
from gym_dgpmpc.tasks.replay import remember_starts
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn

Learned = Literal["learned"]
LEARNED: Learned = "learned"
Source = Literal["given", "the environment's", "compute_reward", "known", "shaped", "never", "learned"]

HARMLESS_VEC_WRAPPERS = (VecNormalize, VecMonitor, VecCheckNan)
"""What leaves observations as they are (of VecNormalize: with norm_obs=False, which is all that is let in)."""


class Task(NamedTuple):
    """The functions that score a predicted trajectory, in raw environment units, and where they come from."""

    reward_fn: RewardFn | None
    """None: the model is to predict the reward."""
    terminated_fn: TerminatedFn | None
    """None: episodes do not end, or the model is to predict it; ``terminated_source`` tells."""
    reward_source: Source = "given"
    terminated_source: Source = "given"
    is_reported: bool = True
    """Whether ``reward_fn`` is meant to be the reward that the environment's `step` returns."""

    def describe(self, *, can_learn_termination: bool = True) -> str:
        """Where reward and termination come from, on one line, for a person."""
        terminated: str = self.terminated_source
        if terminated == LEARNED:
            terminated = "learned, once an episode has terminated" if can_learn_termination else "unknown"
        return f"reward: {self.reward_source} | termination: {terminated}"


def wrapped_env(env: GymEnv | str) -> VecEnv:
    """The environment, or the registered one of this id, as a monitored VecEnv that can be planned for and resumed.

    Dict observations come out of it as vectors.

    Raises:
        TypeError: it is neither an environment nor the id of one.
        ValueError, AssertionError: see `check_env`.
    """
    _refuse_no_environment(env)
    vec_env = flattened(BaseAlgorithm._wrap_env(maybe_make_env(env, 0)))
    check_env(vec_env)
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


def find_task(
    env: VecEnv | None,
    reward_fn: RewardFn | Learned | None,
    terminated_fn: TerminatedFn | Learned | None,
    both_spaces: tuple[spaces.Box, spaces.Box],
    device: torch.device | str = "cpu",
) -> Task:
    """The reward and termination to plan with, each from the first of these that has it.

    What the user gave; what the environment offers as an attribute (a goal environment: `compute_reward`); what is
    known of Gymnasium's own environments ("shaped": another reward is better planned with); else it must be
    learned. The user may ask for that with "learned". An environment's ``terminated_fn = None`` says that its episodes
    never terminate.

    Raises:
        ValueError: a function does not return one finite value per state of a batch, on the device of the batch.
        TypeError: a function is not callable or does not return a tensor.
    """
    reward_fn, reward_source = _find_reward(env, reward_fn)
    terminated_fn, terminated_source = _find_termination(env, terminated_fn)
    if reward_fn is not None:
        check_reward(reward_fn, *both_spaces, device)
    if terminated_fn is not None:
        check_termination(terminated_fn, *both_spaces, device)
    is_another = reward_source == "shaped" or (
        reward_source == "the environment's" and bool(offered_by(env, "plans_with_another_reward"))
    )
    return Task(reward_fn, terminated_fn, reward_source, terminated_source, not is_another)


def _find_reward(env: VecEnv | None, given: RewardFn | Learned | None) -> tuple[RewardFn | None, Source]:
    if isinstance(given, str):
        _check_choice("reward_fn", given)
        return None, LEARNED
    if given is not None:
        return given, "given"
    offered = offered_by(env, "reward_fn")
    if offered is not None:
        return offered, "the environment's"
    goal_reward = GoalReward.of(env)
    if goal_reward is not None:
        assert env is not None
        if offered_by(env, "reward_type") == "sparse":
            warnings.warn(
                f"{describe(env)} has sparse rewards, in which a planner has nothing to climb until it stands at the "
                "goal by chance: its variant with dense rewards is the one to take",
                stacklevel=2,
            )
        return goal_reward, "compute_reward"
    task = known_task(env)
    if task is None:
        return None, LEARNED
    if task.planning_reward_fn is not None:
        return task.planning_reward_fn, "shaped"
    return task.reward_fn, LEARNED if task.reward_fn is None else "known"


def _find_termination(env: VecEnv | None, given: TerminatedFn | Learned | None) -> tuple[TerminatedFn | None, Source]:
    if isinstance(given, str):
        _check_choice("terminated_fn", given)
        return None, LEARNED
    if given is not None:
        return given, "given"
    if env is not None and env.has_attr("terminated_fn"):
        offered = offered_by(env, "terminated_fn")
        return offered, "never" if offered is None else "the environment's"
    task = known_task(env)
    if task is None:
        return None, LEARNED
    return task.terminated_fn, "never" if task.terminated_fn is None else "known"


def _check_choice(name: str, given: str) -> None:
    if given != LEARNED:
        raise ValueError(f'{name} must be a function, "{LEARNED}" or None, got {given!r}')


def find_observation_spec(env: VecEnv | None, observation_spec: ObservationSpec | None) -> ObservationSpec:
    """How the dynamics model should read observations, found as `find_task` finds what it looks for.

    Of a goal environment the goal is constant and no input; all else is read as it is.

    Raises:
        ValueError: between the agent and what the environment offers stands a wrapper that may change observations. In
            another process none is seen.
    """
    if observation_spec is not None:
        return observation_spec
    observation_spec = offered_by(env, "observation_spec")
    if observation_spec is not None:
        _refuse_changed_observations(env)
        return observation_spec
    task = known_task(env)
    return goal_spec(env) if task is None else task.observation_spec


def _refuse_changed_observations(env: VecEnv | None) -> None:
    for wrapper in _wrappers_around("observation_spec", env):
        is_harmless = isinstance(wrapper, (*HARMLESS_VEC_WRAPPERS, FlatDict))
        if not is_harmless and known.may_change_observations(wrapper):
            raise ValueError(
                f"the environment offers an observation_spec, but the wrapper {type(wrapper).__name__} around it may "
                "change what its numbers mean: pass observation_spec=... to the agent, of the observations that it is "
                "given, or ObservationSpec() to read them as they are. The class of a wrapper that leaves observations "
                "alone may say so with an attribute keeps_observations = True"
            )


def _wrappers_around(name: str, env: VecEnv | None) -> Iterator[VecEnvWrapper | gym.Wrapper]:
    """The wrappers between the agent and what has this attribute, but for those in another process."""
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv
    layer = env.envs[0] if isinstance(env, DummyVecEnv) else None
    while isinstance(layer, gym.Wrapper) and not hasattr(layer, name):
        yield layer
        layer = layer.env


def known_task(env: VecEnv | None) -> known.KnownTask | None:
    """What is known of the environment as one of Gymnasium's own, or None."""
    while isinstance(env, HARMLESS_VEC_WRAPPERS):
        env = env.venv
    if env is None or env is not env.unwrapped:
        return None
    # One in another process cannot be looked at; its spec says how it was made.
    found = env.envs[0] if isinstance(env, DummyVecEnv) else offered_by(env, "spec")
    return None if found is None else known.find(found)


def check_env(env: VecEnv) -> None:
    """Refuse what cannot be planned for, naming what was received.

    Raises:
        ValueError: an observation that is not a vector of real numbers, an action that is unbounded or not of real
            numbers, or normalised observations.
        AssertionError: an action space that is not a Box, as from every SB3 algorithm.
    """
    observation, action = env.observation_space, env.action_space
    if not isinstance(observation, spaces.Box) or len(observation.shape) != 1 or observation.dtype.kind != "f":
        raise ValueError(
            "the dynamics model learns vectors of real numbers: the observation space must be a one-dimensional Box of "
            f"floats, or a Dict of such, got {observation}. gymnasium.wrappers.FlattenObservation makes one of nested "
            "vectors; images are not supported"
        )
    assert isinstance(action, spaces.Box), (
        f"The algorithm only supports {spaces.Box} as action spaces but {action} was provided: "
        "the planner searches real-valued action sequences. For discrete actions see SB3's DQN or PPO"
    )
    if action.dtype.kind != "f":
        raise ValueError(
            f"the planner searches real-valued actions: the action space must be a Box of floats, got {action}. "
            "gymnasium.wrappers.TransformAction can round them for an environment that takes whole numbers"
        )
    bad = ~(np.isfinite(action.low) & np.isfinite(action.high) & (action.low <= action.high))
    if bad.any():
        where = "" if bad.all() else f" (those at {np.argwhere(bad).tolist()} are not)"
        raise ValueError(
            f"the planner needs finite action bounds{where}, got low = {action.low} and high = {action.high}; "
            "gymnasium.wrappers.TransformAction(env, lambda action: action, Box(low, high)) gives an environment bounds"
        )
    normalize = unwrap_vec_normalize(env)
    if isinstance(normalize, VecNormalize) and normalize.norm_obs:
        raise ValueError(
            "got VecNormalize(norm_obs=True): its moving statistics would change the meaning of the transitions "
            "already stored and of the reward function. Use norm_obs=False; the dynamics model standardises for itself"
        )


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


def describe(env: VecEnv) -> str:
    """The environment's id if it is a registered one, else its class."""
    spec = offered_by(env, "spec")
    return f"the environment {spec.id}" if spec is not None else f"the environment {offered_by(env, 'unwrapped')}"


def flat_size(space: spaces.Space) -> int:
    """How many numbers an element of a Box holds."""
    return int(np.prod(space.shape or ()))
