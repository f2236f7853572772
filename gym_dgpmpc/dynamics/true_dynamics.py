"""The environment's own simulator as a dynamics model: what the planner earns when there is nothing to learn.

The ceiling that learned models are measured against, with the same planner and the same settings:

    env = gymnasium.make("ModCartPole-v0")
    agent = MPCAgent(env, TrueDynamics(env), planner, num_particles=1, learning_starts=1)

Deterministic, so one particle is enough; see `envs/simulator.py` for what an environment must offer.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import refuse_if_asked
from gym_dgpmpc.envs.simulator import Simulator
from gym_dgpmpc.types import StateDict, Transitions, TransitionSampler


class TrueDynamics:
    """Implements `DynamicsModel` with a MuJoCo environment's simulator; there is nothing to fit.

    Args:
        env: the environment, wrapped or not; it is neither stepped nor changed.

    Raises:
        ValueError: its simulator cannot be used; see `Simulator`.
    """

    takes_float64 = True  # as a simulator's own state is

    def __init__(self, env: Any):
        self.simulator = Simulator(env)

    def fit(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Do nothing: there is nothing to fit."""
        return {}

    def resample(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Do nothing: there is nothing to fit."""
        return {}

    def draw(self, num_particles: int, horizon: int, generator: torch.Generator) -> TransitionSampler:
        """The simulator, the same for every particle."""
        return SimulatorSampler(self.simulator, num_particles)

    def state_dict(self) -> StateDict:
        """Empty: nothing is learned."""
        return {}

    def load_state_dict(self, state: StateDict) -> None:
        """Accept an empty state.

        Raises:
            ValueError: the state is another model's.
        """
        if state:
            raise ValueError(f"the true dynamics must have an empty state, received one with {sorted(state)}")


class SimulatorSampler:
    """Moves every particle by the simulator, one step or a whole plan at a time.

    It has no gradients, and refuses where one is asked for (`NotDifferentiableError`).
    """

    def __init__(self, simulator: Simulator, num_particles: int):
        self._simulator, self._num_particles = simulator, num_particles

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        refuse_if_asked(self, observation, action)
        actions = action.expand(len(observation), -1, -1).flatten(0, 1).unsqueeze(1)
        after = self._simulator.trajectories(observation.flatten(0, 1).cpu().numpy(), actions.cpu().numpy())
        return torch.from_numpy(after[:, 0]).to(observation).view_as(observation)

    def trajectories(
        self, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        """What repeated calls from ``observation`` give, without rounding the states in between."""
        refuse_if_asked(self, observation, actions)
        start = observation.expand(len(actions), -1)
        after = self._simulator.trajectories(start.cpu().numpy(), actions.cpu().numpy())
        states = torch.cat([start.unsqueeze(1), torch.from_numpy(after).to(observation)], 1)  # "K H+1 S"
        return states.transpose(0, 1).unsqueeze(1).expand(-1, self._num_particles, -1, -1)
