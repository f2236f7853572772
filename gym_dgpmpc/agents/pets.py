"""PETS: an ensemble of probabilistic networks for the dynamics, the cross-entropy method for the plan.

Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models".
"""

from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.dynamics.ensemble import EnsembleDynamics

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import PETSAgentBase  # MPCAgent with every argument, see `typed.pyi`
else:
    PETSAgentBase = MPCAgent


class PETSAgent(PETSAgentBase):
    """PETS, an `MPCAgent` made of an `EnsembleDynamics` and, by default, a `CEM`.

        agent = PETSAgent("SwingUpCartPole-v0", **PETS["SwingUpCartPole-v0"], seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)

    The settings that PETS was published with are in `presets.PETS`, those of the paper's comparison in
    `presets.COMPARISON_PETS`. The defaults are the former on the cart-pole.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    dynamics_class = EnsembleDynamics
    part_defaults = MappingProxyType({"horizon": 25, "num_candidates": 400})

    if not TYPE_CHECKING:  # to whom the base says all of it

        def __init__(self, *args: Any, num_particles: int = 20, **settings: Any):
            super().__init__(*args, num_particles=num_particles, **settings)
