"""Policy search: a policy of few parameters that climbs its own return through the model, as PILCO and MC-PILCO have it."""

from gym_dgpmpc.policy_search.controller import MomentSearchController, SampledSearchController
from gym_dgpmpc.policy_search.policies import PolicyForm, SquashedPolicy

__all__ = ["MomentSearchController", "PolicyForm", "SampledSearchController", "SquashedPolicy"]
