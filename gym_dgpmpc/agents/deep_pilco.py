"""DeepPILCO: a policy that climbs its mean reward through a Bayesian network, whose particles stay Gaussian.

Gal, McAllister and Rasmussen (2016), "Improving PILCO with Bayesian Neural Network Dynamics Models"; what differs is in
docs/deviations.md.
"""

from types import MappingProxyType
from typing import TYPE_CHECKING

from gym_dgpmpc.agents.acting import PolicyAgent
from gym_dgpmpc.dynamics.dropout import DropoutDynamics
from gym_dgpmpc.policy_search.controller import SampledSearchController
from gym_dgpmpc.policy_search.policies import SquashedPolicy

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import DeepPILCOAgentBase  # PolicyAgent with every argument, see `typed.pyi`
else:
    DeepPILCOAgentBase = PolicyAgent


class DeepPILCOAgent(DeepPILCOAgentBase):
    """Learns a network with dropout, and acts by a policy that is searched through functions drawn from it.

        agent = DeepPILCOAgent("SwingUpCartPole-v0", search_horizon=75, seed=0, verbose=1)
        agent.learn(total_timesteps=1_000)

    After each training of the model the policy climbs the mean reward of particles, each with a function of its own,
    that live whole episodes from the recorded first observations. At each step they are drawn anew from the Gaussian
    with their means and variances, unless ``match_moments=False``. The planner acts nowhere, and its settings do
    nothing.

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        NotDifferentiableError: while it learns: no gradient comes through the reward.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    dynamics_class = DropoutDynamics
    controller_class = SampledSearchController
    controller: SampledSearchController
    part_defaults = MappingProxyType(
        {"match_moments": True, "num_worlds": 50, "num_paths": 1, "policy_dropout": 0.0, "num_centres": 50}
    )

    @property
    def searched_policy(self) -> SquashedPolicy | None:
        """The policy, from observations to actions in [-1, 1]; None before the first training."""
        return self.controller.policy
