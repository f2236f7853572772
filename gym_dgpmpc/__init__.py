"""Sample-efficient model-predictive control with deep Gaussian processes."""

from typing import TYPE_CHECKING, Any

from gym_dgpmpc.envs.registration import CLASSES, import_public, register_environments

if TYPE_CHECKING:
    from gym_dgpmpc.agents import DeepPILCOAgent as DeepPILCOAgent
    from gym_dgpmpc.agents import DGPMPCAgent as DGPMPCAgent
    from gym_dgpmpc.agents import DynaAgent as DynaAgent
    from gym_dgpmpc.agents import GPMPCAgent as GPMPCAgent
    from gym_dgpmpc.agents import MCPILCOAgent as MCPILCOAgent
    from gym_dgpmpc.agents import MixtureMPCAgent as MixtureMPCAgent
    from gym_dgpmpc.agents import MPCAgent as MPCAgent
    from gym_dgpmpc.agents import PETSAgent as PETSAgent
    from gym_dgpmpc.agents import PILCOAgent as PILCOAgent
    from gym_dgpmpc.agents.presets import mixture_settings_for as mixture_settings_for
    from gym_dgpmpc.agents.presets import settings_for as settings_for
    from gym_dgpmpc.envs.registration import *  # noqa: F403
    from gym_dgpmpc.imagination import ImaginedVecEnv as ImaginedVecEnv
    from gym_dgpmpc.wrappers import RiskSensitiveReward as RiskSensitiveReward

# Public name -> the module it is imported from on first use, so that `import gym_dgpmpc` stays light.
_MODULE_OF = {
    **dict.fromkeys(
        (
            "DGPMPCAgent",
            "DeepPILCOAgent",
            "DynaAgent",
            "GPMPCAgent",
            "MCPILCOAgent",
            "MPCAgent",
            "MixtureMPCAgent",
            "PETSAgent",
            "PILCOAgent",
        ),
        "gym_dgpmpc.agents",
    ),
    **dict.fromkeys(("settings_for", "mixture_settings_for"), "gym_dgpmpc.agents.presets"),
    "ImaginedVecEnv": "gym_dgpmpc.imagination",
    "RiskSensitiveReward": "gym_dgpmpc.wrappers",
    **CLASSES,
}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    return import_public(__name__, _MODULE_OF, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
