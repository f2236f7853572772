"""Stable-Baselines3's algorithms by name, with what suits worlds that cost next to nothing to live in."""

import importlib
import inspect
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
from gymnasium import spaces
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from gym_dgpmpc.imagination.gradient import PolicyGradient

AlgorithmName = Literal["gradient", "SAC", "TD3", "DDPG", "PPO", "A2C", "TQC", "CrossQ"]

_OWN: Mapping[str, type[BaseAlgorithm]] = {
    "gradient": PolicyGradient,
    "SAC": SAC,
    "TD3": TD3,
    "DDPG": DDPG,
    "PPO": PPO,
    "A2C": A2C,
}
_CONTRIBUTED = ("TQC", "CrossQ")


class Budget(NamedTuple):
    """How long to train, unless it is said.

    Attributes:
        total_timesteps: imagined steps.
        trial_every: imagined steps between two trials.
    """

    total_timesteps: int
    trial_every: int


def budget_of(algorithm: type[BaseAlgorithm]) -> Budget:
    """The budget that suits an algorithm: a gradient is over thousands of imagined steps, SAC learns from each."""
    if issubclass(algorithm, PolicyGradient):
        return Budget(4_000_000, 160_000)
    if issubclass(algorithm, OnPolicyAlgorithm):
        return Budget(400_000, 20_000)
    return Budget(60_000, 3_000)


NETWORK: Mapping[str, Any] = {"net_arch": [128, 128]}
"""Smaller than Stable-Baselines3's, since most of the time goes into steps of gradients."""


def algorithm_class(algorithm: AlgorithmName | str | type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    """The class of an algorithm that is given by name, or as a class itself; "gradient" is `PolicyGradient`.

    Raises:
        ValueError: there is none of this name, or it is one of sb3-contrib, which is not installed.
        TypeError: it is neither a name nor a class of algorithms.
    """
    if isinstance(algorithm, type) and issubclass(algorithm, BaseAlgorithm):
        return algorithm
    if not isinstance(algorithm, str):
        raise TypeError(f"algorithm must be the name or class of a Stable-Baselines3 algorithm, got {algorithm!r}")
    if algorithm in _OWN:
        return _OWN[algorithm]
    if algorithm not in _CONTRIBUTED:
        known = ", ".join([*_OWN, *_CONTRIBUTED])
        raise ValueError(f"algorithm must be one of {known}, or a class of Stable-Baselines3's, got {algorithm!r}")
    try:
        return getattr(importlib.import_module("sb3_contrib"), algorithm)
    except ImportError as error:
        raise ValueError(f"algorithm {algorithm!r} is one of sb3-contrib: pip install sb3-contrib") from error


def suited_settings(
    algorithm: type[BaseAlgorithm],
    num_worlds: int,
    total_timesteps: int,
    space: spaces.Space,
    features: Mapping[str, Any],
) -> dict[str, Any]:
    """An algorithm's arguments for so many worlds: off the policy, a gradient step for every imagined step.

    On the policy, and where the algorithm has other arguments, its own defaults.

    Args:
        algorithm: the class.
        num_worlds: worlds side by side.
        total_timesteps: imagined steps of the training.
        space: of observations.
        features: further arguments of the policy, for vectors of observations.
    """
    is_dict = isinstance(space, spaces.Dict)
    of_policy = {**NETWORK, **({} if is_dict else features)}
    if issubclass(algorithm, PolicyGradient):
        of_policy["activation_fn"] = torch.nn.SiLU  # smooth, as a gradient likes it
    settings: dict[str, Any] = {"policy": "MultiInputPolicy" if is_dict else "MlpPolicy", "policy_kwargs": of_policy}
    if "gradient_steps" in inspect.signature(algorithm).parameters:
        settings |= {
            "train_freq": 1,
            "gradient_steps": num_worlds,
            "batch_size": 128,
            "learning_rate": 1e-3,
            "buffer_size": max(total_timesteps, num_worlds),
            "learning_starts": min(1_000, total_timesteps // 10),
        }
    return settings
