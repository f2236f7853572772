"""Life in the model's worlds: policies that Stable-Baselines3's algorithms learn in draws of a dynamics model."""

from gym_dgpmpc.imagination.algorithms import AlgorithmName, algorithm_class, budget_of
from gym_dgpmpc.imagination.beginnings import StartFunction, StartName
from gym_dgpmpc.imagination.policies import imagine
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv

__all__ = [
    "AlgorithmName",
    "ImaginedVecEnv",
    "StartFunction",
    "StartName",
    "algorithm_class",
    "budget_of",
    "imagine",
]
