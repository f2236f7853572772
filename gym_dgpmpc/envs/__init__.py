"""The package's environments. Each knows its own reward as a batched function that its ``step`` uses too.

The classes are imported on first use: registering the environments must not import MuJoCo or PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gym_dgpmpc.envs.half_cheetah import HalfCheetahReward, VelocityHalfCheetahEnv
    from gym_dgpmpc.envs.mod_cartpole import CartPoleReward, ModCartPoleEnv, SwingUpCartPoleEnv
    from gym_dgpmpc.envs.reacher7dof import BiasedReacherEnv, Reacher7DoFEnv, ReacherReward

__all__ = [
    "BiasedReacherEnv",
    "CartPoleReward",
    "HalfCheetahReward",
    "ModCartPoleEnv",
    "Reacher7DoFEnv",
    "ReacherReward",
    "SwingUpCartPoleEnv",
    "VelocityHalfCheetahEnv",
]

_MODULE_OF = {
    "BiasedReacherEnv": "gym_dgpmpc.envs.reacher7dof",
    "CartPoleReward": "gym_dgpmpc.envs.mod_cartpole",
    "HalfCheetahReward": "gym_dgpmpc.envs.half_cheetah",
    "ModCartPoleEnv": "gym_dgpmpc.envs.mod_cartpole",
    "Reacher7DoFEnv": "gym_dgpmpc.envs.reacher7dof",
    "ReacherReward": "gym_dgpmpc.envs.reacher7dof",
    "SwingUpCartPoleEnv": "gym_dgpmpc.envs.mod_cartpole",
    "VelocityHalfCheetahEnv": "gym_dgpmpc.envs.half_cheetah",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
