"""Planning: a drawn world and a reward become an objective, and a planner maximises it over action sequences."""

from gym_dgpmpc.planning.cem import CEM
from gym_dgpmpc.planning.gradient import GradientAscent
from gym_dgpmpc.planning.icem import ICEM
from gym_dgpmpc.planning.mppi import MPPI
from gym_dgpmpc.planning.registry import PLANNERS, make_planner, planner_factory, register_planner
from gym_dgpmpc.planning.rollout import particle_returns, rollout, rollout_objective

__all__ = [
    "CEM",
    "ICEM",
    "MPPI",
    "PLANNERS",
    "GradientAscent",
    "make_planner",
    "particle_returns",
    "planner_factory",
    "register_planner",
    "rollout",
    "rollout_objective",
]
