"""PILCO: a policy that climbs its expected reward through the exact moments of a Gaussian process.

Deisenroth and Rasmussen (2011), "PILCO: A Model-Based and Data-Efficient Approach to Policy Search"; what differs is in
docs/deviations.md.
"""

from typing import TYPE_CHECKING

from gym_dgpmpc.agents.acting import PolicyAgent
from gym_dgpmpc.dynamics.sparse_gp import MomentMatchedDynamics
from gym_dgpmpc.policy_search.controller import MomentSearchController
from gym_dgpmpc.policy_search.policies import SquashedPolicy

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import PILCOAgentBase  # PolicyAgent with every argument, see `typed.pyi`
else:
    PILCOAgentBase = PolicyAgent


class PILCOAgent(PILCOAgentBase):
    """Learns a sparse or exact Gaussian process, and acts by a policy that is searched by exact moments.

        agent = PILCOAgent("SwingUpCartPole-v0", search_horizon=75, seed=0, verbose=1)
        agent.learn(total_timesteps=1_000)

    After each training of the model the policy climbs the expected reward of a belief that stays Gaussian, from the
    recorded first observations to the end of the episode. The planner acts nowhere, and its settings do nothing.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        NotDifferentiableError: while it learns: no gradient comes through the reward.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    dynamics_class = MomentMatchedDynamics
    controller_class = MomentSearchController
    controller: MomentSearchController

    @property
    def searched_policy(self) -> SquashedPolicy | None:
        """The policy, from observations to actions in [-1, 1]; None before the first training."""
        return self.controller.policy
