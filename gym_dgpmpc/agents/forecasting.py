"""What an agent's model says of action sequences: the states that its worlds go through."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.planning.rollout import rollout
from gym_dgpmpc.randomness import derive_seed
from gym_dgpmpc.types import TransitionSampler

if TYPE_CHECKING:
    from gym_dgpmpc.agents.mpc import MPCAgent


def draw_worlds(agent: "MPCAgent", num_particles: int, horizon: int, key: int) -> TransitionSampler:
    """Worlds that depend on the agent's model, its seed and ``key`` alone, and move none of its random streams."""
    generator = torch.Generator(agent.device).manual_seed(derive_seed(agent.seed, "forecast", key))
    with torch.no_grad():
        return agent.dynamics.draw(num_particles, horizon, generator)


def states_along(
    agent: "MPCAgent",
    worlds: TransitionSampler,
    observation: Float[ndarray, " S"],
    actions: Float[ndarray, "H A"],
    num_particles: int,
) -> Float[Tensor, "H_plus_1 P S_all"]:
    """The states that actions lead to in worlds, with what else the model predicts behind the S observed numbers."""
    start = agent.task.start(observation)
    along = torch.as_tensor(actions, dtype=torch.float32, device=agent.device).unsqueeze(0)
    with torch.no_grad():
        return rollout(worlds, start, along, num_particles)[:, :, 0]


def forecast(
    agent: "MPCAgent", observation: Any, actions: Any, num_particles: int, seed: int
) -> Float[ndarray, "P H_plus_1 S"]:
    """See `MPCAgent.forecast`."""
    check_counts(num_particles=num_particles)
    if not agent.is_fitted:
        raise ValueError("the agent has not learned yet, so there is no model to forecast with: call learn first")
    observations, is_batch = agent.policy.checked(observation)
    if is_batch:
        raise ValueError(f"forecast takes one observation, got {len(observations)}: call it for each of them")
    size = int(np.prod(agent.action_space.shape))
    along = np.asarray(actions, dtype=np.float32)
    if along.shape[1:] not in ((size,), agent.action_space.shape) or len(along) == 0:
        raise ValueError(f"expected actions of shape (H, {size}), H of them, got {along.shape}")
    along = along.reshape(-1, size)
    low, high = (bound.reshape(-1) for bound in (agent.action_space.low, agent.action_space.high))
    if not ((low <= along) & (along <= high)).all():
        raise ValueError(f"actions must be finite and lie within {low} to {high}, got {along.min(0)} to {along.max(0)}")
    worlds = draw_worlds(agent, num_particles, len(along), seed)
    states = states_along(agent, worlds, observations[0], along, num_particles)
    return states[..., : agent.task.modelled.observation_size].transpose(0, 1).cpu().numpy()
