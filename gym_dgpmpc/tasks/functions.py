"""The reward, the termination and the observation spec to plan with: given by the user, found on the environment,
known of its class, or to be learned.

`task.py` keeps what is found here.
"""

import warnings
from collections.abc import Iterator
from typing import Literal, NamedTuple

import gymnasium as gym
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from gym_dgpmpc.envs import known
from gym_dgpmpc.tasks.dict_observations import FlatDict, GoalReward, goal_spec
from gym_dgpmpc.tasks.environment import describe, offered_by
from gym_dgpmpc.tasks.first_batch import check_reward, check_termination
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn

Learned = Literal["learned"]
LEARNED: Learned = "learned"
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
    terminated_fn: TerminatedFn | Learned | None,
    both_spaces: tuple[spaces.Box, spaces.Box],
    device: torch.device | str = "cpu",
) -> TaskFunctions:
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
    return TaskFunctions(reward_fn, terminated_fn, reward_source, terminated_source, not is_another)


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
    """How the dynamics model should read observations, found as `find_functions` finds what it looks for.

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
