"""The package's environments. Each knows its own reward as a batched function that its ``step`` uses too.

The classes are imported on first use: registering the environments must not import MuJoCo or PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gym_dgpmpc.envs.mod_cartpole import CartPoleReward, ModCartPoleEnv, SwingUpCartPoleEnv

__all__ = ["CartPoleReward", "ModCartPoleEnv", "SwingUpCartPoleEnv"]

_MODULE_OF = {
    "CartPoleReward": "gym_dgpmpc.envs.mod_cartpole",
    "ModCartPoleEnv": "gym_dgpmpc.envs.mod_cartpole",
    "SwingUpCartPoleEnv": "gym_dgpmpc.envs.mod_cartpole",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
