"""The dynamics model of PETS, an ensemble of probabilistic networks, with its draws."""

from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics

__all__ = ["EnsembleDynamics"]
