"""GP-MPC: one sparse Gaussian process for the dynamics, the cross-entropy method for the plan.

The Gaussian-process baselines of Chua et al. (2018) and of Gadd et al. (2020): GP-DS and GP-MM.
"""

from typing import TYPE_CHECKING

from gym_dgpmpc.agents.mpc import MPCAgent
from gym_dgpmpc.dynamics.sparse_gp import SparseGPDynamics
from gym_dgpmpc.tasks.environment import flat_size
from gym_dgpmpc.types import DynamicsModel, ObservationSpec

if TYPE_CHECKING:
    from gym_dgpmpc.agents.typed import GPMPCAgentBase  # MPCAgent with every argument, see `typed.pyi`
else:
    GPMPCAgentBase = MPCAgent


class GPMPCAgent(GPMPCAgentBase):
    """The comparison's Gaussian process: an `MPCAgent` made of a `SparseGPDynamics` and, by default, a `CEM`.

        agent = GPMPCAgent("ModCartPole-v0", **COMPARISON_GP["ModCartPole-v0"], draw="MM", seed=0, verbose=1)
        agent.learn(total_timesteps=2_000)

    Raises:
        ValueError: an argument is out of its range, or the environment is one that cannot be planned for.
        TypeError: there is no such setting.
        AssertionError: the action space is not a Box, as from every SB3 algorithm.
        UnknownRewardError: of a loaded agent: the reward function that it was given is missing.
    """

    dynamics_class = SparseGPDynamics

    def _make_dynamics(
        self, observation_size: int, action_size: int, observation_spec: ObservationSpec
    ) -> DynamicsModel | None:
        largest, particles = observation_size, self._planning_given.num_particles
        # Termination is learned from the first one on, in the middle of a run: too late to say this then.
        learned = self.task.must_learn_reward + self.task.may_learn_termination
        largest = max(largest, flat_size(self.observation_space) + learned)
        if self.settings["draw"] == "AMM" and particles <= largest:
            raise ValueError(
                f"the draw AMM needs more particles than the {largest} numbers of an observation and of what else "
                "is or may be learned (the reward and, unless terminated_fn says when episodes end, termination), got "
                f"num_particles = {particles}"
            )
        return super()._make_dynamics(observation_size, action_size, observation_spec)
