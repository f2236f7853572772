"""The sparse Gaussian process that PETS is compared with, with its draws and their analytic moments."""

from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics

__all__ = ["SparseGPDynamics"]
