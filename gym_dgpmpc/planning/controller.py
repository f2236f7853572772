"""From an observation to an action: draw worlds from the model, plan in them, carry the plan on.

Knows nothing of learning or of the environment; the agent asks it both while it learns and when it predicts.
"""

import math
import numbers
import time
from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from gymnasium import spaces

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.planning.plan_state import PlanState
from gym_dgpmpc.planning.rollout import rollout_objective
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import DynamicsModel, PlanInfo, Planner, TransitionSampler


class PlanningPolicy:
    """Acts by planning through a dynamics model.

    Args:
        dynamics: the model that worlds are drawn from.
        planner: optimises action sequences; its horizon is the plan's.
        action_space: bounds of the actions.
        num_particles: P, worlds per plan.
        actions_per_plan: actions performed of each plan before the next one is made.
        device: where dynamics and planner compute.
        time_budget: seconds that a plan may take, or None; see `plan`.

    Raises:
        ValueError: a number is out of its range, or the planner's actions are not those of ``action_space``.
    """

    def __init__(
        self,
        dynamics: DynamicsModel,
        planner: Planner,
        action_space: spaces.Box,
        num_particles: int,
        actions_per_plan: int,
        device: torch.device,
        time_budget: float | None = None,
    ):
        is_number = isinstance(time_budget, numbers.Real)
        if time_budget is not None and not (is_number and math.isfinite(time_budget) and time_budget > 0):
            raise ValueError(f"time_budget must be a positive number of seconds, or None, got {time_budget!r}")
        self.time_budget = time_budget
        self.num_late = 0
        """Plans that took longer than the budget, since this object was made."""
        self.dynamics, self.planner = dynamics, planner
        self.num_particles, self.actions_per_plan, self.device = num_particles, actions_per_plan, device
        self.cold = PlanState(planner.initial_plan())
        """Where the first plan of an episode starts from."""
        self.horizon = self.cold.plan.mean.shape[0]
        planned, needed = self.cold.plan.mean.shape[1], math.prod(action_space.shape)
        if planned != needed:
            raise ValueError(f"the planner plans actions of {planned} numbers, the action space has {needed}")
        check_counts(num_particles=num_particles)
        if not 1 <= actions_per_plan <= self.horizon:
            raise ValueError(
                f"actions_per_plan must lie in 1 to the planner's horizon {self.horizon}, got {actions_per_plan}"
            )
        self._low, self._high = (
            torch.as_tensor(bound, dtype=torch.float32, device=device).flatten()
            for bound in (action_space.low, action_space.high)
        )

    def worlds(self, generator: torch.Generator) -> Callable[[], TransitionSampler]:
        """One draw of the worlds, made when it is first asked for; plans made together may share it."""
        return cache(lambda: self.dynamics.draw(self.num_particles, self.horizon, generator))

    @torch.no_grad()
    def plan(
        self,
        task: Task,
        observation: np.ndarray,
        state: PlanState,
        generator: torch.Generator,
        worlds: Callable[[], TransitionSampler] | None = None,
    ) -> tuple[np.ndarray, PlanState, PlanInfo | None]:
        """One action from the carried plan; if none of its actions are left, optimise it first.

        With a time budget the planner is told until when it may go on, and returns the best plan so far. Drawing the
        worlds is part of the budget; a plan that was late all the same is counted.

        Args:
            task: the reward and termination to plan with, as functions of what the model predicts.
            observation: [S_all], as the model sees it (see `modelled.py`).
            state: what the last step of the same episode returned, or `cold`.
            generator: for the worlds and the planner.
            worlds: of `worlds`; None draws some for this plan alone.

        Returns:
            The action [A], the state to carry to the next step, and what the planner found (None if no plan was made).

        Raises:
            PlanningError: no candidate had a finite return.
        """
        plan, age, info = *state, None
        if age == 0:
            deadline = math.inf if self.time_budget is None else time.perf_counter() + self.time_budget
            # A planner need not know of deadlines as long as none is asked for.
            limit = {} if self.time_budget is None else {"deadline": deadline}
            drawn = self.worlds(generator)() if worlds is None else worlds()
            start = torch.as_tensor(observation, dtype=torch.float32, device=self.device)
            assert task.reward_fn is not None
            objective = rollout_objective(drawn, task.reward_fn, start, self.num_particles, task.terminated_fn)
            try:
                plan, info = self.planner.plan(objective, plan, generator, **limit)
            except PlanningError as error:
                raise PlanningError(f"{error}; planning started from the observation {observation}") from error
            self.num_late += time.perf_counter() > deadline
        # In the precision in which it is stored, so that performing it again is the same.
        action = plan.mean[age].float().clamp(self._low, self._high).cpu().numpy()
        age += 1
        carried = PlanState(plan, age) if age < self.actions_per_plan else PlanState(self.planner.shift(plan, age))
        return action, carried, info

    def midpoint(self) -> np.ndarray:
        """The middle of the action range, [A]."""
        return (self._low / 2 + self._high / 2).cpu().numpy()

    def uniform(self, generator: torch.Generator) -> np.ndarray:
        """A uniformly random action, [A]."""
        uniform = torch.rand(self._low.shape, generator=generator, device=self.device)
        return (self._low + (self._high - self._low) * uniform).cpu().numpy()
