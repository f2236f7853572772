"""DGP-MPC: a deep Gaussian process for the dynamics, the cross-entropy method for the plan.

Gadd et al. (2020), "Sample-Efficient Reinforcement Learning using Deep Gaussian Processes".
"""

from typing import TYPE_CHECKING

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import DGPMPCAgentBase  # MPCAgent with every argument, see `typed.pyi`
else:
    DGPMPCAgentBase = MPCAgent


class DGPMPCAgent(DGPMPCAgentBase):
    """The paper's agent, an `MPCAgent` made of a `DeepGPDynamics` and, by default, a `CEM`.

        agent = DGPMPCAgent("ModCartPole-v0", seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)

    The best known settings of a task are ``DGPMPCAgent(env, **settings_for("ModCartPole-v0"))``, the paper's
    are in `presets.PAPER`.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    dynamics_class = DeepGPDynamics
