"""A controller that acts by a policy instead of by plans; what the policy is, and how it learns, a subclass says."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.imagination.worlds import Imagining
from gym_dgpmpc.planning.controller import Acted, Controller
from gym_dgpmpc.planning.plan_state import PlanState
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import PlanInfo, StateDict, TransitionSampler

_NOTHING_PLANNED = PlanInfo(float("nan"))


class ActingByPolicy(Controller):
    """A `Controller` with a policy that is improved after each training of the model, and is in the agent's files."""

    policy: Any = None
    """What has been learned; None before the first training."""

    def decide(self, task: Task, observation: np.ndarray) -> np.ndarray | None:
        """The policy's action, [A], or None where the planner is to act."""
        raise NotImplementedError

    def improve(self, agent: Imagining, seed: int) -> Mapping[str, float]:
        """Go on learning in the worlds of the agent's model as it is now; metrics to log."""
        raise NotImplementedError

    def state_dict(self) -> StateDict:
        """What the policy has learned; nothing before the first training."""
        raise NotImplementedError

    def load_policy(self, agent: Imagining, state: StateDict) -> None:
        """Go on from `state_dict`."""
        raise NotImplementedError

    @torch.no_grad()
    def act(
        self,
        task: Task,
        observation: np.ndarray,
        carried: PlanState,
        generator: torch.Generator,
        worlds: Callable[[], TransitionSampler] | None = None,
    ) -> Acted:
        """The policy's action, without noise; or the planner's, see `Controller.act`.

        Raises:
            PlanningError: the policy returned an action that is not finite; or see `Controller.act`.
        """
        started = time.perf_counter()
        action = self.decide(task, observation)
        if action is None:
            return super().act(task, observation, carried, generator, worlds)
        if not np.isfinite(action).all():
            raise PlanningError(f"the policy returned the action {action} at the observation {observation}")
        action = torch.from_numpy(action).to(self._low).clamp(self._low, self._high).cpu().numpy()
        return Acted(action, self.cold, _NOTHING_PLANNED, time.perf_counter() - started, False)
