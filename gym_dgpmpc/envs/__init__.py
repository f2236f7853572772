"""The package's environments. Each knows its own reward as a batched function that its ``step`` uses too.

The classes are imported on first use: registering the environments must not import MuJoCo or PyTorch. Which there are,
`registration.py` alone says.
"""

from typing import TYPE_CHECKING, Any

from gym_dgpmpc.envs.registration import CLASSES, REWARDS, import_public

if TYPE_CHECKING:
    from gym_dgpmpc.envs.registration import *  # noqa: F403

__all__ = sorted({**CLASSES, **REWARDS})


def __getattr__(name: str) -> Any:
    return import_public(__name__, {**CLASSES, **REWARDS}, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
