"""The paper's dynamics model, a deep Gaussian process sampled by SG-HMC, with its draws and their compiled rollouts."""

from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics

__all__ = ["DeepGPDynamics"]
