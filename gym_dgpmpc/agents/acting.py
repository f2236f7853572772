"""What agents have in common that act by a policy, which is improved after each training of the model."""

from collections.abc import Mapping

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.checkpoints.interface import StateOf
from gym_dgpmpc.imagination.acting import ActingByPolicy
from gym_dgpmpc.randomness import derive_seed
from gym_dgpmpc.types import StateDict, Stateful


class PolicyAgent(MPCAgent):
    """An `MPCAgent` whose controller has a policy."""

    controller: ActingByPolicy

    def _improve(self) -> Mapping[str, float]:
        return self.controller.improve(self, derive_seed(self.seed, "imagination", len(self.store)))

    def nouns(self) -> dict[str, Stateful]:
        """What a checkpoint holds, the policy included."""
        return super().nouns() | {"policy": StateOf(self.controller.state_dict, self._load_policy)}

    def _load_policy(self, state: StateDict) -> None:
        self.controller.load_policy(self, state)
