"""Sample-efficient model-predictive control with deep Gaussian processes."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gym_dgpmpc.envs.registration import register_environments

if TYPE_CHECKING:
    from gym_dgpmpc.agents import DGPMPCAgent, GPMPCAgent, MPCAgent, PETSAgent
    from gym_dgpmpc.envs import (
        BiasedReacherEnv,
        ModCartPoleEnv,
        Reacher7DoFEnv,
        SwingUpCartPoleEnv,
        VelocityHalfCheetahEnv,
    )
    from gym_dgpmpc.wrappers import RiskSensitiveReward

__all__ = [
    "BiasedReacherEnv",
    "DGPMPCAgent",
    "GPMPCAgent",
    "MPCAgent",
    "ModCartPoleEnv",
    "PETSAgent",
    "Reacher7DoFEnv",
    "RiskSensitiveReward",
    "SwingUpCartPoleEnv",
    "VelocityHalfCheetahEnv",
]

# Public name -> the module it is imported from on first use, so that `import gym_dgpmpc` stays light.
_MODULE_OF = {
    "BiasedReacherEnv": "gym_dgpmpc.envs",
    "DGPMPCAgent": "gym_dgpmpc.agents",
    "GPMPCAgent": "gym_dgpmpc.agents",
    "MPCAgent": "gym_dgpmpc.agents",
    "ModCartPoleEnv": "gym_dgpmpc.envs",
    "PETSAgent": "gym_dgpmpc.agents",
    "Reacher7DoFEnv": "gym_dgpmpc.envs",
    "RiskSensitiveReward": "gym_dgpmpc.wrappers",
    "SwingUpCartPoleEnv": "gym_dgpmpc.envs",
    "VelocityHalfCheetahEnv": "gym_dgpmpc.envs",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
