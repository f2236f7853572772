"""Gaussian processes and networks for the dynamics, each as far as it has predicted, and a planner.

Gadd et al. (2020) name the combination of Gaussian processes and neural networks as future work.
"""

from typing import TYPE_CHECKING

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.dynamics.mixture import MixtureDynamics

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import MixtureMPCAgentBase  # MPCAgent with every argument, see `typed.pyi`
else:
    MixtureMPCAgentBase = MPCAgent


class MixtureMPCAgent(MixtureMPCAgentBase):
    """An `MPCAgent` made of a `MixtureDynamics` and, by default, a `CEM`.

        agent = MixtureMPCAgent("ModCartPole-v0", **mixture_settings_for("ModCartPole-v0"), seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)

    Settings of its models have the model's name before their own, as ``deep_gp_kernel`` and ``ensemble_draw``.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    dynamics_class = MixtureDynamics
