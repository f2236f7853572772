"""The dynamics model of DeepPILCO, a Bayesian network by dropout, with its draws."""

from gym_dgpmpc.dynamics.dropout.model import DropoutDynamics

__all__ = ["DropoutDynamics"]
