"""Settings as data: keyword arguments of `DGPMPCAgent` for a task, by the environment's id."""

from types import MappingProxyType
from typing import Any


def _paper(horizon: int, num_iterations: int, actions_per_plan: int) -> MappingProxyType[str, Any]:
    """What the paper holds fixed over its tasks, and what it does not."""
    return MappingProxyType(
        {
            "num_candidates": 300,
            "num_elites": 30,
            "num_particles": 5,
            "num_inducing": 200,
            "horizon": horizon,
            "num_iterations": num_iterations,
            "actions_per_plan": actions_per_plan,
        }
    )


_CART_POLE = _paper(horizon=30, num_iterations=5, actions_per_plan=1)
_REACHER = _paper(horizon=20, num_iterations=5, actions_per_plan=1)
_HALF_CHEETAH = _paper(horizon=40, num_iterations=10, actions_per_plan=2)

PAPER = MappingProxyType(
    {
        "ModCartPole-v0": _CART_POLE,
        "SwingUpCartPole-v0": _CART_POLE,
        "Reacher7DoF-v0": _REACHER,
        "BiasedReacher-v0": _REACHER,
        "VelocityHalfCheetah-v0": _HALF_CHEETAH,
        "RiskSensitiveHalfCheetah-v0": _HALF_CHEETAH,
    }
)
"""The planning settings of Gadd et al. (2020); layers and kernel are what the paper compares, so they are not here."""

REAL_TIME = MappingProxyType(
    {"ModCartPole-v0": MappingProxyType({"num_candidates": 200, "num_elites": 20, "num_iterations": 4})}
)
"""Planning settings quick enough for a plant's own clock, to be laid over others: 25 plans a second on two cores."""
