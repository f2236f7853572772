"""The sparse Gaussian process that PETS is compared with, with its draws and their analytic moments."""

from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics
from gym_dgpmpc.dynamics.sparse_gp.moment_matched import MomentMatchedDynamics

__all__ = ["MomentMatchedDynamics", "SparseGPDynamics"]
