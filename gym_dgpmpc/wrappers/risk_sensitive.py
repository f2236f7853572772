"""Planning that shuns large angles, as in Gadd et al. (2020), while the task's own reward goes on being reported."""

import math
from dataclasses import dataclass
from operator import index
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.envs import known
from gym_dgpmpc.types import RewardFn

ORIGINAL_REWARD = "reward_original"
"""Where ``info`` holds the reward that agents are compared by, if `step` may return another one."""


@dataclass(frozen=True)
class AnglePenalty:
    """One for each full ``angle_step`` by which an angle differs from 0: floor(|angle| / angle_step).

    Attributes:
        angle_index: which number of the observation is the angle, in rad.
        angle_step: in rad.
        wrap: take the angle to within half a turn of 0 first. Without it, where the angle counts full turns so does the
            penalty.
    """

    angle_index: int
    angle_step: float
    wrap: bool = False

    def __call__(self, next_observation: Float[Tensor, "*b S"]) -> Float[Tensor, "*b"]:
        """The penalty of each state, in the precision of ``next_observation``."""
        angle = next_observation[..., self.angle_index]
        if self.wrap:
            angle = (angle + math.pi).remainder(2.0 * math.pi) - math.pi
        return (angle.abs() / self.angle_step).floor()


@dataclass(frozen=True)
class PenalisedReward:
    """A reward less a penalty of the state that the step leads to; a `gym_dgpmpc.types.RewardFn`."""

    reward_fn: RewardFn
    penalty: AnglePenalty

    def __call__(
        self,
        observation: Float[Tensor, "*b S"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S"],
    ) -> Float[Tensor, "*b"]:
        """The penalised reward of each step."""
        return self.reward_fn(observation, action, next_observation) - self.penalty(next_observation)


class RiskSensitiveReward(gym.Wrapper, RecordConstructorArgs):
    """Plan with a reward that falls as an angle grows: r - floor(|angle| / angle_step).

    A planner finds the penalised reward as `reward_fn`, and evaluates it on the states that it predicts. What `step`
    returns is still the reward of the task, by which agents are compared, unless ``penalise_step``: agents
    without a model, which learn from the returned reward, cannot learn of the risk otherwise. ``info`` holds both,
    as ``reward_original`` and ``reward_risk_sensitive``.

    Args:
        env: an environment that offers a `reward_fn`, or one of Gymnasium's own whose reward is known (see
            `gym_dgpmpc.envs.known`); its observations are vectors.
        angle_index: which number of the observation is the angle, in rad.
        angle_step: the angle that costs one unit, in rad; 20 degrees as in the paper.
        penalise_step: return the penalised reward from `step` too.
        wrap: count the angle from the nearest full turn. The paper does not: who has turned over once then pays 18 a
            step for ever, at 20 degrees, standing upright or not.

    Raises:
        ValueError: the environment's reward is not known as a function of the actions that it is given, or an argument
            is out of its range.
    """

    keeps_observations = True  # for `known.may_change_observations`

    def __init__(
        self,
        env: gym.Env,
        angle_index: int,
        angle_step: float = math.pi / 9,
        penalise_step: bool = False,
        wrap: bool = False,
    ) -> None:
        RecordConstructorArgs.__init__(
            self, angle_index=angle_index, angle_step=angle_step, penalise_step=penalise_step, wrap=wrap
        )
        gym.Wrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"observations must be vectors for angle_index to name one number; the space is {space}")
        try:
            angle_index = index(angle_index)
        except TypeError as error:
            raise ValueError(f"angle_index must be an integer; got {angle_index!r}") from error
        if not 0 <= angle_index < space.shape[0]:
            raise ValueError(f"angle_index must be from 0 to {space.shape[0] - 1}; got {angle_index}")
        if not (math.isfinite(angle_step) and angle_step > 0):
            raise ValueError(f"angle_step must be a positive number, in rad; got {angle_step!r}")
        self._penalty, self._penalise_step = AnglePenalty(angle_index, float(angle_step), wrap), penalise_step
        self.reward_fn: RewardFn = PenalisedReward(_reward_of(env), self._penalty)
        """The penalised reward, batched."""
        self.plans_with_another_reward = not penalise_step
        """Whether `step` deliberately returns another reward than `reward_fn`."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment; both rewards are in the info."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        original = float(reward)
        penalised = original - float(self._penalty(torch.from_numpy(np.asarray(observation))))
        info = {**info, ORIGINAL_REWARD: original, "reward_risk_sensitive": penalised}
        return observation, penalised if self._penalise_step else original, terminated, truncated, info


def _reward_of(env: gym.Env) -> RewardFn:
    """What the environment offers, else what is known of it."""
    if env.has_wrapper_attr("reward_fn"):
        return known.offered_reward(env, env.get_wrapper_attr("reward_fn"))
    task = known.find(env)
    if task is None or task.reward_fn is None:
        raise ValueError(
            f"cannot evaluate the reward of {env} on predicted states: it has no attribute 'reward_fn', and its reward "
            "is not among those of gym_dgpmpc.envs.known; give the environment a reward_fn"
        )
    return task.reward_fn
