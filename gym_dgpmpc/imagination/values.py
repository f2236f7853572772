"""What a state is worth to a policy, from the critics that its algorithm has learned in imagination."""

from collections.abc import Callable
from typing import Any

import torch
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor

from gym_dgpmpc.imagination.gradient import PolicyGradient

Value = Callable[[Float[Tensor, "*b S"]], Float[Tensor, "*b"]]


def learns_values(algorithm: type[BaseAlgorithm]) -> bool:
    """Whether an algorithm has critics that are trained."""
    return not issubclass(algorithm, PolicyGradient)


def state_value(model: BaseAlgorithm) -> Value:
    """V(s) of a model's policy: min_i Q_i(s, pi(s)) of its critics, the mean where these learn quantiles.

    SAC's critics count the entropy that its policy is to have, so V is somewhat more than the return.

    Raises:
        ValueError: the model has no critics that were trained, or Dict observations.
    """
    if not learns_values(type(model)):
        raise ValueError(f"{type(model).__name__} learns no values: take SAC, TD3, TQC, CrossQ or PPO as algorithm")
    if not isinstance(model.observation_space, spaces.Box):
        raise ValueError(f"values are of observations that are vectors, got {model.observation_space}")
    policy = model.policy
    policy.set_training_mode(False)

    def of_rows(observation: Float[Tensor, "n S"]) -> Float[Tensor, " n"]:
        if isinstance(policy, ActorCriticPolicy):
            return policy.predict_values(observation).squeeze(-1)
        critic: Any = policy.critic  # which SB3's base class does not have
        found = critic(observation, policy._predict(observation, deterministic=True))  # actions in [-1, 1]
        if isinstance(found, Tensor):  # quantiles [n, networks, quantiles]
            return found.flatten(1).mean(-1)
        return torch.cat(found, dim=-1).amin(-1)

    def value(observation: Float[Tensor, "*b S"]) -> Float[Tensor, "*b"]:
        rows = observation.flatten(0, -2).float()
        return of_rows(rows).reshape(observation.shape[:-1])

    return value
