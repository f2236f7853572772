"""The reward, the termination and the observation spec to plan with: given by the user, found on the environment,
known of its class, or to be learned.

`task.py` keeps what is found here.
"""

import inspect
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import torch
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from gym_dgpmpc.envs import known
from gym_dgpmpc.envs.performed_actions import ChangingActionsError
from gym_dgpmpc.tasks.dict_observations import FlatDict, GoalReward, goal_spec
from gym_dgpmpc.tasks.environment import describe, offered_by
from gym_dgpmpc.tasks.first_batch import (
    REWARD_SIGNATURE,
    TERMINATED_SIGNATURE,
    check_reward,
    check_termination,
    example_batch,
)
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn

Learned = Literal["learned"]
LEARNED: Learned = "learned"
Never = Literal["never"]
NEVER: Never = "never"
Source = Literal["given", "the environment's", "compute_reward", "known", "shaped", "never", "learned"]

HARMLESS_VEC_WRAPPERS = (VecNormalize, VecMonitor, VecCheckNan)
"""What leaves observations as they are (of VecNormalize: with norm_obs=False, which is all that is let in)."""


class TaskFunctions(NamedTuple):
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


def find_functions(
    env: VecEnv | None,
    reward_fn: RewardFn | Learned | None,
    terminated_fn: TerminatedFn | Learned | Never | None,
    both_spaces: tuple[spaces.Box, spaces.Box],
    device: torch.device | str = "cpu",
) -> TaskFunctions:
    """The reward and termination to plan with, each from the first of these that has it.

    What the user gave; what the environment offers as an attribute (a goal environment: `compute_reward`); what is
    known of Gymnasium's own environments ("shaped": another reward is better planned with); else it must be
    learned. The user may ask for that with "learned". That episodes never terminate, the user says with "never" and an
    environment with ``terminated_fn = None``. An attribute that cannot be such a function is not taken for one.

    Raises:
        ValueError: a function does not return one finite value per state of a batch, on the device of the batch; or a
            wrapper may change actions before they reach the layer that offers the reward.
        TypeError: a function is not callable or does not return a tensor.
    """
    reward_fn, reward_source = _find_reward(env, reward_fn)
    terminated_fn, terminated_source = _find_termination(env, terminated_fn)
    if reward_fn is not None:
        with _place_named(env, "reward_fn", reward_source):
            check_reward(reward_fn, *both_spaces, device)
    if terminated_fn is not None:
        with _place_named(env, "terminated_fn", terminated_source):
            check_termination(terminated_fn, *both_spaces, device)
    is_another = reward_source == "shaped" or (
        reward_source == "the environment's" and offered_by(env, "plans_with_another_reward") is True
    )
    return TaskFunctions(reward_fn, terminated_fn, reward_source, terminated_source, not is_another)


def _find_reward(env: VecEnv | None, given: RewardFn | Learned | None) -> tuple[RewardFn | None, Source]:
    if isinstance(given, str):
        _check_choice("reward_fn", given, (LEARNED,))
        return None, LEARNED
    if given is not None:
        return given, "given"
    offered = _offered_function(env, "reward_fn", REWARD_SIGNATURE)
    if offered is not None:
        return _of_chosen_actions(env, offered), "the environment's"
    goal_reward = _goal_reward(env)
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


def _goal_reward(env: VecEnv | None) -> GoalReward | None:
    """A goal environment's `compute_reward`, called in the way that it can be: see `GoalReward`.

    Raises:
        ValueError: it can be called in neither.
    """
    reward = GoalReward.of(env)
    if reward is None:
        return None
    assert env is not None and isinstance(env.observation_space, spaces.Box)
    assert isinstance(env.action_space, spaces.Box)
    batch = example_batch(env.observation_space, env.action_space)
    told = []
    for way in (reward, replace(reward, in_rows=True)):
        try:
            returned = way(*batch)
        except Exception as error:
            told.append(f"raised {type(error).__name__}: {error}")
        else:
            if returned.shape == batch[0].shape[:-1]:
                return way
            told.append(f"returned the shape {list(returned.shape)}")
    rows, size = batch[0][..., 0].numel(), reward.achieved.stop - reward.achieved.start
    raise ValueError(
        f"{_place(env, 'compute_reward')} must map goals [*b, {size}] and a dict to rewards [*b], or, as "
        f"Stable-Baselines3's HER wants it, goals [n, {size}] and n dicts, which are empty here, to rewards [n]. With "
        f"*b = {list(batch[0].shape[:-1])} it {told[0]}. With n = {rows} it {told[1]}. {HOW_TO_DO_WITHOUT['reward_fn']}"
    )


def _of_chosen_actions(env: VecEnv | None, reward_fn: RewardFn) -> RewardFn:
    """The environment's own reward as a function of the agent's actions, which wrappers may change on their way.

    Of an environment in another process the wrappers are those that its spec names.

    Raises:
        ChangingActionsError: see `known.offered_reward`.
    """
    while isinstance(env, VecEnvWrapper):
        keeps = isinstance(env, HARMLESS_VEC_WRAPPERS) or getattr(type(env), "keeps_actions", False)
        if type(env).step_async is not VecEnvWrapper.step_async and not keeps:
            raise ChangingActionsError(type(env).__name__)
        env = env.venv
    if isinstance(env, DummyVecEnv):
        return known.offered_reward(env.envs[0], reward_fn)
    spec = offered_by(env, "spec")
    if spec is None or all(wrapper.entry_point == known.MONITOR for wrapper in spec.additional_wrappers):
        return reward_fn
    made = known.made_from(spec)
    if made is None:  # a wrapper does not record how it was made
        for wrapper in spec.additional_wrappers:
            with suppress(ImportError, AttributeError):  # of a class within a function nothing is known
                maker: Any = load_env_creator(wrapper.entry_point)
                if isinstance(maker, type) and issubclass(maker, gym.ActionWrapper):
                    raise ChangingActionsError(wrapper.name)
        return reward_fn
    try:
        return known.offered_reward(made, reward_fn)
    finally:
        made.close()


def _find_termination(
    env: VecEnv | None, given: TerminatedFn | Learned | Never | None
) -> tuple[TerminatedFn | None, Source]:
    if isinstance(given, str):
        _check_choice("terminated_fn", given, (LEARNED, NEVER))
        return None, given
    if given is not None:
        return given, "given"
    if env is not None and env.has_attr("terminated_fn"):
        if offered_by(env, "terminated_fn") is None:
            return None, NEVER
        offered = _offered_function(env, "terminated_fn", TERMINATED_SIGNATURE)
        if offered is not None:
            return offered, "the environment's"
    task = known_task(env)
    if task is None:
        return None, LEARNED
    return task.terminated_fn, "never" if task.terminated_fn is None else "known"


def _check_choice(name: str, given: str, choices: tuple[str, ...]) -> None:
    if given not in choices:
        listed = ", ".join(f'"{choice}"' for choice in choices)
        raise ValueError(f"{name} must be a function, {listed} or None, got {given!r}")


HOW_TO_DO_WITHOUT = {
    "reward_fn": 'To do without it pass reward_fn=... or reward_fn="learned" to the agent',
    "terminated_fn": 'To do without it pass terminated_fn=..., "learned" or "never" to the agent',
}


def _offered_function(env: VecEnv | None, name: str, signature: str) -> Any:
    """The environment's attribute, if it can be a function of this signature; else None, and a warning.

    Other packages have attributes of the same names.
    """
    offered = offered_by(env, name)
    if offered is None or _takes(offered, 3 if name == "reward_fn" else 1):
        return offered
    assert env is not None
    warnings.warn(
        f"{_place(env, name)} is not taken for the function to plan with, {signature}: it is {offered!r}. "
        f"{HOW_TO_DO_WITHOUT[name]}, which says so too",
        stacklevel=2,
    )
    return None


def _takes(function: Any, count: int) -> bool:
    """Whether a function can be called with so many arguments; true of one that does not say."""
    if not callable(function):
        return False
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # built in
        return True
    return True


def _place(env: VecEnv, name: str) -> str:
    """Where an attribute was found, for an error."""
    inner = env.unwrapped
    layer: Any = inner.envs[0] if isinstance(inner, DummyVecEnv) else None
    while isinstance(layer, gym.Wrapper) and not hasattr(layer, name):
        layer = layer.env
    return f"{name!r} of {describe(env) if layer is None else type(layer).__module__ + '.' + type(layer).__qualname__}"


@contextmanager
def _place_named(env: VecEnv | None, name: str, source: Source) -> Iterator[None]:
    """Lets an error about a function that the user did not pass say where it was found."""
    try:
        yield
    except (ValueError, TypeError) as error:
        if source not in ("the environment's", "compute_reward") or env is None:
            raise
        found = _place(env, "compute_reward" if source == "compute_reward" else name)
        raise type(error)(f"{error}. It was found as {found}. {HOW_TO_DO_WITHOUT[name]}") from error


def find_observation_spec(env: VecEnv | None, observation_spec: ObservationSpec | None) -> ObservationSpec:
    """How the dynamics model should read observations, found as `find_functions` finds what it looks for.

    Of a goal environment the goal is constant and no input; all else is read as it is.

    Raises:
        ValueError: between the agent and what the environment offers stands a wrapper that may change observations. In
            another process none is seen.
        TypeError: what was given is no `ObservationSpec`.
    """
    if observation_spec is not None:
        if not isinstance(observation_spec, ObservationSpec):
            raise TypeError(f"observation_spec must be a gym_dgpmpc.types.ObservationSpec, got {observation_spec!r}")
        return observation_spec
    offered = offered_by(env, "observation_spec")
    if isinstance(offered, ObservationSpec):  # dm_env has a method of that name
        _refuse_changed_observations(env)
        return offered
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
