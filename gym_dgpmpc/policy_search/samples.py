"""Policy search through sampled worlds: particles live whole episodes, and their mean reward has a gradient.

Amadio et al. (2022), "Model-Based Policy Search Using Monte Carlo Gradient Estimation With Real Systems Application"
(MC-PILCO); with moments matched at each step, Gal, McAllister and Rasmussen (2016), "Improving PILCO with Bayesian
Neural Network Dynamics Models" (DeepPILCO). What differs is in docs/deviations.md.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.imagination.gradient import Paths, climb
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv
from gym_dgpmpc.policy_search.policies import SquashedPolicy

LAST_STEP_SIZE = 0.1
"""What the optimiser's steps fall to, linearly, of what they began with."""

LATEST = 10
"""Steps of the optimiser over which the return is averaged that a search reports."""


class Dropped(torch.nn.Module):
    """A policy each of whose basis functions is left out at random, at every call anew; the others count for more.

    Args:
        policy: the policy; a linear one has no basis functions to leave out.
        generator: decides which.

    Attributes:
        rate: chance that one is left out, in [0, 1).
    """

    def __init__(self, policy: SquashedPolicy, generator: torch.Generator):
        super().__init__()
        self.policy, self.rate, self._generator = policy, 0.0, generator

    def forward(self, observation: Float[Tensor, "n S"]) -> Float[Tensor, "n A"]:
        if self.rate == 0.0 or not self.policy.num_centres:
            return self.policy(observation)
        shape = len(observation), self.policy.num_centres
        uniform = torch.rand(shape, generator=self._generator, dtype=observation.dtype, device=observation.device)
        return self.policy(observation, (uniform >= self.rate).to(observation) / (1.0 - self.rate))


class SampledSearch(NamedTuple):
    """How to search by samples.

    Attributes:
        num_paths: particles in each world.
        num_steps: steps of the optimiser, Adam.
        step_size: of its first step.
        dropout: chance that a basis function is left out at the first step; it falls to zero, linearly.
        matches_moments: see `Paths`.
    """

    num_paths: int
    num_steps: int
    step_size: float
    dropout: float
    matches_moments: bool = False

    def improve(self, policy: SquashedPolicy, worlds: ImaginedVecEnv) -> dict[str, float]:
        """Let the policy climb its mean reward over episodes in the worlds, which are drawn anew for each step.

        Raises:
            NotDifferentiableError: no gradient comes through the reward, or through the model's draws.
        """
        paths = Paths(
            worlds, worlds.episode_steps, self.num_paths, action_noise=0.0, goes_on=0.0,
            matches_moments=self.matches_moments,
        )  # fmt: skip
        acting = Dropped(policy, worlds.generator)
        optimiser = torch.optim.Adam(policy.parameters(), lr=self.step_size)
        earned = []
        for step in range(self.num_steps):
            left = 1.0 - step / self.num_steps
            acting.rate = self.dropout * left
            for group in optimiser.param_groups:
                group["lr"] = self.step_size * (LAST_STEP_SIZE + (1.0 - LAST_STEP_SIZE) * left)
            earned.append(climb(paths, acting, optimiser))
        latest = earned[-LATEST:]
        return {"imagined_return": worlds.episode_steps * sum(latest) / len(latest)}
