"""Life in the model's worlds: policies that Stable-Baselines3's algorithms learn in draws of a dynamics model."""

from gym_dgpmpc.imagination.worlds import ImaginedVecEnv

__all__ = ["ImaginedVecEnv"]
