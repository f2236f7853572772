"""Models of several kinds as one: each has as many of the worlds of a plan as its predictions have earned."""

from gym_dgpmpc.dynamics.mixture.model import MixtureDynamics

__all__ = ["MixtureDynamics"]
