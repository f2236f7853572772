"""How far an agent has come, and where its random streams are: what a checkpoint keeps of the algorithm itself."""

import warnings
from typing import TYPE_CHECKING

import numpy as np
import torch

from gym_dgpmpc.checks import saved_count
from gym_dgpmpc.errors import ReliabilityWarning
from gym_dgpmpc.randomness import derive_seed, split_seed
from gym_dgpmpc.tasks.environment import flat_size
from gym_dgpmpc.types import StateDict

if TYPE_CHECKING:
    from gym_dgpmpc.agents.mpc import MPCAgent


MISSING_CONTROLLER = (
    "the saved agent began with a controller of the user's, which no file holds, and this one goes on with random "
    "actions until it has a model: pass first_controller=... to load"
)


class Progress:
    """The counters of an agent, and the present observations if episodes are running."""

    def __init__(self, agent: "MPCAgent"):
        self._agent = agent

    def state_dict(self) -> StateDict:
        agent = self._agent
        state: StateDict = {"num_timesteps": agent.num_timesteps, "num_fitted": agent.num_fitted}
        state["num_episodes"] = agent._episode_num
        state["has_first_controller"] = agent.first_controller is not None
        if agent._last_obs is not None:
            state["last_observation"] = torch.from_numpy(agent._last_obs.copy())
            state["last_episode_starts"] = torch.from_numpy(np.array(agent._last_episode_starts))
        return state

    def load_state_dict(self, state: StateDict) -> None:
        """Go on from `state_dict`; with another number of environments, new episodes begin.

        Warns, before the first training, if the agent lacks the first controller that the saved one had.

        Raises:
            KeyError, ValueError: a counter is missing or out of its range.
        """
        agent = self._agent
        agent.num_timesteps, agent.num_fitted, agent._episode_num = (
            saved_count(name, state[name]) for name in ("num_timesteps", "num_fitted", "num_episodes")
        )
        if state.get("has_first_controller", False) and agent.first_controller is None and not agent.is_fitted:
            warnings.warn(MISSING_CONTROLLER, stacklevel=2)
        agent.begin_at(None)
        if "last_observation" not in state:
            return
        observation, starts = state["last_observation"].numpy(), state["last_episode_starts"].numpy()
        num_envs = len(observation)
        if observation.shape != (num_envs, flat_size(agent.observation_space)) or starts.shape != (num_envs,):
            raise ValueError(f"the last observation has the shape {observation.shape}, starts {starts.shape}")
        if num_envs == agent.n_envs:
            agent.begin_at(observation, starts)


class RandomStreams:
    """The generators of an agent, which belong to a kind of device, and whether its seed is the environment's too."""

    def __init__(self, agent: "MPCAgent"):
        self._agent = agent

    def state_dict(self) -> StateDict:
        agent = self._agent
        about = {"device": agent.device.type, "seeds_environment": agent.seeds_environment}
        return {**about, **agent.generators.state_dict()}

    def load_state_dict(self, state: StateDict) -> None:
        """Go on from `state_dict`; on another kind of device with new streams that the seed decides, and a warning.

        Raises:
            KeyError, RuntimeError: see `Generators.load_state_dict`.
        """
        agent = self._agent
        agent.seeds_environment = bool(state["seeds_environment"])
        saved_on, device = state.get("device", agent.device.type), agent.device.type
        if saved_on == device:
            agent.generators.load_state_dict(state)
            return
        warnings.warn(
            f"the agent was saved on the device {saved_on!r}, whose random numbers {device!r} cannot go on with: it "
            "begins new ones, and goes on otherwise than it would have there",
            ReliabilityWarning,
            stacklevel=2,
        )
        agent.generators = split_seed(derive_seed(agent.seed, "other_device", agent.num_timesteps), agent.device)
