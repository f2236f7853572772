"""The policy of an agent as Stable-Baselines3 has it: what `predict` does, with the plan as the recurrent state."""

import warnings
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from gymnasium import spaces
from numpy import ndarray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.errors import EnvironmentDataError
from gym_dgpmpc.planning.controller import Controller
from gym_dgpmpc.planning.plan_state import PackedPlans, PlanState, pack, unpack
from gym_dgpmpc.randomness import Generators, observation_generator
from gym_dgpmpc.tasks.actions import performed
from gym_dgpmpc.tasks.dict_observations import check_parts, flatten, layout
from gym_dgpmpc.tasks.environment import flat_size
from gym_dgpmpc.tasks.task import Task


@runtime_checkable
class Planning(Protocol):
    """What the policy asks of its agent, which may exchange any of it."""

    @property
    def task(self) -> Task: ...
    @property
    def controller(self) -> Controller: ...
    @property
    def generators(self) -> Generators: ...
    @property
    def env(self) -> VecEnv | None: ...
    @property
    def is_fitted(self) -> bool: ...
    @property
    def seed(self) -> int: ...


class MPCPolicy(BasePolicy):
    """Plans through the agent's model; has no parameters of its own.

    Args:
        observation_space, action_space: of the agent.
        agent: whose task, controller and random streams to plan with.
    """

    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(self, observation_space: spaces.Box, action_space: spaces.Box, agent: Planning):
        super().__init__(observation_space, action_space)
        self._agent = agent
        self._warned: set[str] = set()

    def predict(
        self,
        observation: ndarray | dict[str, ndarray],
        state: PackedPlans | None = None,
        episode_start: ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[ndarray, PackedPlans]:
        """See `MPCAgent.predict`."""
        controller = self._agent.controller
        observations, is_batch = self.checked(observation)
        num_envs, cold = len(observations), controller.cold
        carried = [cold] * num_envs if state is None else unpack(state, cold, num_envs, controller.actions_per_plan)
        starts = np.broadcast_to(False if episode_start is None else episode_start, num_envs)

        actions = []
        for i, row in enumerate(observations):
            action, carried[i] = self._act(row, cold if starts[i] else carried[i], deterministic)
            actions.append(performed(action[None], self.action_space)[0])
        return np.stack(actions) if is_batch else actions[0], pack(carried)

    def _act(self, observation: ndarray, carried: PlanState, deterministic: bool) -> tuple[ndarray, PlanState]:
        agent = self._agent
        controller, generator = agent.controller, agent.generators.prediction
        if deterministic:
            generator = observation_generator(agent.seed, observation.astype(np.float32), controller.device)
        if not agent.is_fitted:
            self._warn_once("predict was called before the agent has learned: there is no model to plan with")
            return controller.midpoint() if deterministic else controller.uniform(generator), controller.cold
        acted = controller.act(agent.task, observation, carried, generator)
        if acted.late:
            budget = controller.time_budget
            self._warn_once(f"a plan took longer than the time_budget of {budget} s: see num_late_plans")
        return acted.action, acted.carried

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        """Actions for a batch of observations, each planned from scratch; `predict` carries plans on."""
        rows = (
            {name: part.cpu().numpy() for name, part in observation.items()}
            if isinstance(observation, dict)
            else (observation.cpu().numpy())
        )
        actions, _ = self.predict(rows, deterministic=deterministic)
        return torch.from_numpy(actions).to(self._agent.controller.device)

    def checked(self, observation: Any) -> tuple[ndarray, bool]:
        """Observations [n, S], float32 unless their space is float64, and whether they came with that dimension."""
        if isinstance(observation, tuple):
            raise ValueError(
                f"predict takes an observation, got a tuple of {len(observation)}: Gymnasium's reset returns "
                "(observation, info), of which the first is meant"
            )
        check_parts(observation, layout(self._agent.env))
        dtype = np.float64 if self.observation_space.dtype == np.float64 else np.float32
        array = np.array(flatten(observation), dtype=dtype)
        size = flat_size(self.observation_space)
        if array.ndim not in (1, 2) or array.shape[-1] != size:
            raise ValueError(f"expected an observation of shape ({size},) or (n, {size}), got {array.shape}")
        with np.errstate(over="ignore"):
            is_finite = np.isfinite(array.astype(np.float32))
        if not np.all(is_finite):
            raise EnvironmentDataError(f"cannot plan from an observation that is not finite: {observation}")
        return array.reshape(-1, size), array.ndim == 2

    def _warn_once(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, stacklevel=5)

    def save(self, path: str) -> None:
        """Not offered, because Stable-Baselines3's own would pickle: an agent's file holds all of it.

        Raises:
            NotImplementedError: always; use `MPCAgent.save`.
        """
        raise NotImplementedError("a planning policy is its agent's model and planner: use agent.save(path)")

    @classmethod
    def load(cls, path: str, device: torch.device | str = "auto") -> "MPCPolicy":
        """Not offered, because Stable-Baselines3's own would unpickle the file.

        Raises:
            NotImplementedError: always; use `MPCAgent.load`.
        """
        raise NotImplementedError("a planning policy is its agent's model and planner: use MPCAgent.load(path).policy")
