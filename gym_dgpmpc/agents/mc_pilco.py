"""MC-PILCO: a policy that climbs its mean reward through functions drawn from a Gaussian process, or from a deep one.

Amadio et al. (2022), "Model-Based Policy Search Using Monte Carlo Gradient Estimation With Real Systems Application";
what differs is in docs/deviations.md.
"""

from functools import partial
from typing import TYPE_CHECKING

from gym_dgpmpc.agents.acting import PolicyAgent
from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.policy_search.controller import SampledSearchController
from gym_dgpmpc.policy_search.policies import SquashedPolicy

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import MCPILCOAgentBase  # PolicyAgent with every argument, see `typed.pyi`
else:
    MCPILCOAgentBase = PolicyAgent


class MCPILCOAgent(MCPILCOAgentBase):
    """Learns a Gaussian process (``num_layers=1``) or a deep one, and acts by a policy that is searched in its worlds.

        agent = MCPILCOAgent("SwingUpCartPole-v0", search_horizon=75, seed=0, verbose=1)
        agent.learn(total_timesteps=1_000)

    After each training of the model the policy climbs the mean reward of particles that live whole episodes from the
    recorded first observations. The planner acts nowhere, and its settings do nothing.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        NotDifferentiableError: while it learns: no gradient comes through the reward.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    dynamics_class = partial(DeepGPDynamics, num_layers=1, kernel="rbf")
    controller_class = SampledSearchController
    controller: SampledSearchController

    @property
    def searched_policy(self) -> SquashedPolicy | None:
        """The policy, from observations to actions in [-1, 1]; None before the first training."""
        return self.controller.policy
