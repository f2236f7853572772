"""Policy search, of PILCO and its successors: a policy of few parameters climbs its return through the model."""

from gym_dgpmpc.policy_search.controller import MomentSearchController, SampledSearchController
from gym_dgpmpc.policy_search.policies import PolicyForm, SquashedPolicy

__all__ = ["MomentSearchController", "PolicyForm", "SampledSearchController", "SquashedPolicy"]
