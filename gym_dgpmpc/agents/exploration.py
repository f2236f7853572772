"""The actions before there is a model to plan with: random ones of several kinds, or the user's own controller's; and
when there have been enough of them.

Independent random actions average out: over some steps a plant hardly moves. Held, coloured and swept ones move it
further, and show the model states that plans will lead to. All but the uniform ones, which go on from a generator, are
a function of seed, episode and step, so that a checkpoint need not hold where they are.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.planning.coloured_noise import coloured_noise
from gym_dgpmpc.randomness import episode_generator
from gym_dgpmpc.tasks.dict_observations import layout
from gym_dgpmpc.tasks.environment import time_limit

if TYPE_CHECKING:
    from gym_dgpmpc.agents.mpc import MPCAgent

ExplorationName = Literal["uniform", "held", "coloured", "chirp"]

FirstController = Callable[[Any], Any]
"""(observation, or dict of them, as the environment gives it) -> action, in the action space's shape."""

LONGEST = 1000
"""Steps after which noise and sweeps begin anew, where episodes are longer or have no limit."""

ENDLESS = 1000
"""Random steps after which a warning says that no episode has ended. Gymnasium's own tasks have at most as many."""

MANY_GIVEN_UP = 10
"""Random episodes given up for new ones, after which a warning says that it may take long until anything is learned."""

QUICKEST = 0.25
"""Cycles per step at which a sweep ends: of each cycle there are four actions, which show that it is one."""


def coloured_shares(
    length: int, size: int, beta: float, generator: torch.Generator, device: torch.device
) -> Float[Tensor, "length size"]:
    """Coloured noise as shares of the action's range: uniform in [0, 1] at each step, and correlated over the steps.

    The distribution function of the normal law takes the noise there, so no action is cut off at a bound.
    """
    noise = coloured_noise((1, length, size), beta, generator, device=device, dtype=torch.float32)[0]
    return torch.special.ndtr(noise)


def chirp_shares(
    length: int, size: int, generator: torch.Generator, device: torch.device
) -> Float[Tensor, "length size"]:
    """Sweeps as shares of the action's range: (1 + sin) / 2, with frequencies from 1 / ``length`` to `QUICKEST`.

    The frequency grows by the same factor at each step. The numbers of an action are at different places of the sweep,
    so that they are hardly correlated, and begin at random phases.
    """
    steps, numbers = (torch.arange(count, dtype=torch.float64, device=device) for count in (length, size))
    place = steps.unsqueeze(1) / length + numbers / size
    slowest = 1 / length
    frequency = slowest * (max(QUICKEST, slowest) / slowest) ** (place % 1.0)
    start = torch.rand(size, generator=generator, dtype=torch.float64, device=device)
    phase = start + frequency.cumsum(0)
    return (0.5 + 0.5 * torch.sin(2 * math.pi * phase)).float()


class Explorer:
    """Gives an agent its first actions.

    Args:
        agent: whose ``exploration``, ``exploration_hold``, ``exploration_beta`` and ``first_controller`` are meant.

    Raises:
        TypeError, ValueError: one of these is not what it may be.
    """

    def __init__(self, agent: "MPCAgent"):
        if agent.exploration not in get_args(ExplorationName):
            known = ", ".join(get_args(ExplorationName))
            raise ValueError(f"exploration must be one of {known}, got {agent.exploration!r}")
        check_counts(exploration_hold=agent.exploration_hold)
        check_reals("[0, 10]", exploration_beta=agent.exploration_beta)
        if agent.first_controller is not None and not callable(agent.first_controller):
            raise TypeError(
                f"first_controller must be a function of an observation, or None, got {agent.first_controller!r}"
            )
        self._agent = agent

    @property
    def has_seen_enough(self) -> bool:
        """Whether there are transitions enough for the first training."""
        agent = self._agent
        if agent.learning_starts is not None:
            return len(agent.store) >= agent.learning_starts
        # An episode that never ends must not put off the first training beyond the others.
        is_due = agent.train_freq is not None and len(agent.store) >= agent.train_freq
        return is_due or agent.collector.all_explored or self._has_explored_in_pieces

    @property
    def _has_explored_in_pieces(self) -> bool:
        """Whether there are as many steps as an episode may have, of episodes of which none was let end."""
        agent = self._agent
        if agent.collector.num_given_up == 0:
            return False
        limit = time_limit(agent.env)
        return limit is not None and len(agent.store) >= limit * agent.n_envs

    def endless_beginning(self) -> str | None:
        """What is to be said when exploration goes on for suspiciously long; None if it does not."""
        agent = self._agent
        if agent.learning_starts is None and agent.collector.num_given_up > 1:
            limit = time_limit(agent.env)
            if limit is None or agent.collector.num_given_up >= MANY_GIVEN_UP:
                when = "one does" if limit is None else f"one does, or there are {limit * agent.n_envs} random steps"
                return (
                    "no episode has ended, because each call of learn begins a new one, and nothing is learned before "
                    f"{when}: pass reset_num_timesteps=False to learn, which then goes on in the running episode, or "
                    "learning_starts=... to the agent"
                )
        is_late = len(agent.store) == ENDLESS * agent.n_envs and not agent.collector.any_explored
        if agent.learning_starts is None and is_late:
            return (
                f"after {ENDLESS} random steps no episode has ended, and nothing is learned before one does: give the "
                "environment a time limit (gymnasium.wrappers.TimeLimit), or pass learning_starts=... and, if episodes "
                "never end, train_freq=..."
            )
        return None

    def actions(self, observations: Float[np.ndarray, "n S"]) -> Float[np.ndarray, "n A"]:
        """The next action of each environment's running episode.

        Raises:
            ValueError: the user's controller returned no action.
        """
        if self._agent.first_controller is not None:
            return np.stack([self._controlled(observation) for observation in observations])
        return np.stack([self._explored(index) for index in range(len(observations))])

    def _controlled(self, observation: Float[np.ndarray, " S"]) -> Float[np.ndarray, " A"]:
        """The action of the user's controller; beyond the bounds it is clipped when it is performed."""
        agent, parts = self._agent, layout(self._agent.env)
        assert agent.first_controller is not None
        given = {key: observation[part].copy() for key, part in parts.items()} if parts else observation.copy()
        returned = agent.first_controller(given)
        try:
            action = np.asarray(returned, dtype=np.float32)
        except (TypeError, ValueError):
            action = np.empty(0, dtype=np.float32)
        if action.shape != agent.action_space.shape or not np.isfinite(action).all():
            raise ValueError(
                f"first_controller must return an action of shape {agent.action_space.shape}, finite numbers, got "
                f"{returned!r}"
            )
        return action.flatten()

    def _explored(self, index: int) -> Float[np.ndarray, " A"]:
        agent = self._agent
        control, running = agent.controller, agent.collector.running[index]
        if agent.exploration == "uniform":
            return control.uniform(agent.generators.exploration)
        length = agent.exploration_hold if agent.exploration == "held" else self._period()
        part, step = divmod(len(running.record.rewards), length)
        generator = episode_generator(agent.seed, running.index, part, control.device)
        size = math.prod(agent.action_space.shape)
        if agent.exploration == "held":
            return control.uniform(generator)
        if agent.exploration == "coloured":
            shares = coloured_shares(length, size, agent.exploration_beta, generator, control.device)
        else:
            shares = chirp_shares(length, size, generator, control.device)
        return control.within(shares[step])

    def _period(self) -> int:
        """Steps of an episode of exploration, as far as they are known before it has ended."""
        agent = self._agent
        total = agent.train_freq if agent.learning_starts is None else agent.learning_starts
        known = [time_limit(agent.env), None if total is None else math.ceil(total / agent.n_envs)]
        return min([LONGEST, *filter(None, known)])
