"""The agents: model-predictive control as Stable-Baselines3 algorithms, and the named methods made of its parts."""

from gym_dgpmpc.agents.deep_pilco import DeepPILCOAgent
from gym_dgpmpc.agents.dgp_mpc import DGPMPCAgent
from gym_dgpmpc.agents.dyna import DynaAgent
from gym_dgpmpc.agents.gp_mpc import GPMPCAgent
from gym_dgpmpc.agents.mc_pilco import MCPILCOAgent
from gym_dgpmpc.agents.mixture import MixtureMPCAgent
from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.agents.pets import PETSAgent
from gym_dgpmpc.agents.pilco import PILCOAgent

__all__ = [
    "DGPMPCAgent",
    "DeepPILCOAgent",
    "DynaAgent",
    "GPMPCAgent",
    "MCPILCOAgent",
    "MPCAgent",
    "MixtureMPCAgent",
    "PETSAgent",
    "PILCOAgent",
]
