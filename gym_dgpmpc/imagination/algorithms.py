"""Stable-Baselines3's algorithms by name, with what suits worlds that cost next to nothing to live in."""

import importlib
import inspect
from collections.abc import Mapping
from typing import Any, Literal

from gymnasium import spaces
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm

AlgorithmName = Literal["SAC", "TD3", "DDPG", "PPO", "A2C", "TQC", "CrossQ"]

_OWN: Mapping[str, type[BaseAlgorithm]] = {"SAC": SAC, "TD3": TD3, "DDPG": DDPG, "PPO": PPO, "A2C": A2C}
_CONTRIBUTED = ("TQC", "CrossQ")

NETWORK: Mapping[str, Any] = {"net_arch": [128, 128]}
"""Smaller than Stable-Baselines3's, since most of the time goes into steps of gradients."""


def algorithm_class(algorithm: AlgorithmName | str | type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    """The class of an algorithm that is given by name, or as a class itself.

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
    algorithm: type[BaseAlgorithm], num_worlds: int, total_timesteps: int, space: spaces.Space
) -> dict[str, Any]:
    """An algorithm's arguments for so many worlds: off the policy, a gradient step for every imagined step.

    On the policy, and where the algorithm has other arguments, its own defaults.
    """
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    settings: dict[str, Any] = {"policy": policy, "policy_kwargs": dict(NETWORK)}
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
