"""A Dyna of the deep Gaussian process: act by a policy, learn the model, let the policy learn in the model's worlds.

Sutton (1991), "Dyna, an Integrated Architecture for Learning, Planning, and Reacting". Nearest to it is MBPO, which has
an ensemble of networks: Janner et al. (2019), "When to Trust Your Model: Model-Based Policy Optimization"; what differs
is in docs/deviations.md.
"""

from typing import TYPE_CHECKING

from stable_baselines3.common.base_class import BaseAlgorithm

from gym_dgpmpc.agents.acting import PolicyAgent
from gym_dgpmpc.agents.dgp_mpc import DGPMPCAgent
from gym_dgpmpc.imagination.controller import PolicyController

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import DynaAgentBase  # DGPMPCAgent with every argument, see `typed.pyi`
else:
    DynaAgentBase = DGPMPCAgent


class DynaAgent(PolicyAgent, DynaAgentBase):
    """Learns a deep Gaussian process as `DGPMPCAgent` does, and acts by a policy that lives in its worlds.

        agent = DynaAgent("ModCartPole-v0", seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)
        agent.imagined_policy.save("policy.zip")  # acts by itself

    After each training of the model the policy goes on learning in new worlds. An action then costs a fraction of a
    millisecond. With ``acts_by="planner"`` the planner acts, as `DGPMPCAgent` does, and the policy learns beside it.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    controller_class = PolicyController
    controller: PolicyController

    @property
    def imagined_policy(self) -> BaseAlgorithm | None:
        """The policy, a Stable-Baselines3 algorithm; None before the first training."""
        return self.controller.policy
