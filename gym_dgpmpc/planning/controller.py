"""From an observation to an action: draw worlds from the model, plan in them, carry the plan on.

Owns the model, the planner and how they are used; knows nothing of learning or of the environment. The agent asks it
both while it learns and when it predicts.
"""

import math
import numbers
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.forks import compute_on_one_thread_in_children
from gym_dgpmpc.planning.plan_state import PlanState
from gym_dgpmpc.planning.registry import action_bounds
from gym_dgpmpc.planning.risk import RiskMeasure
from gym_dgpmpc.planning.rollout import EXPECTED, Tail, rollout_objective
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import DynamicsModel, Plan, PlanInfo, Planner, TransitionSampler


class Acted(NamedTuple):
    """An action, and how it came about.

    Attributes:
        action: [A], float32, finite and within its bounds.
        carried: what to pass to the next step of the same episode.
        info: what the planner found; None if the carried plan had an action left, and none was made.
        seconds: wall-clock time it took, from the drawing of the worlds to the action.
        late: whether a plan was made, and took longer than the time budget.
    """

    action: np.ndarray
    carried: PlanState
    info: PlanInfo | None
    seconds: float
    late: bool


def _of_risk(name: str) -> property:
    """An attribute of a controller's measure of risk, checked when it is set."""
    return property(
        lambda control: getattr(control.measure, name),
        lambda control, value: setattr(control, "measure", replace(control.measure, **{name: value})),
        doc=f"See `RiskMeasure.{name}`; may be set.",
    )


class Controller:
    """Acts by planning through a dynamics model.

    Everything but ``planner`` and the action space may be set anew, and holds from the next plan on.

    Args:
        dynamics: the model that worlds are drawn from.
        planner: optimises action sequences; its horizon is the plan's.
        action_space: bounds of the actions.
        num_particles: P, worlds per plan.
        actions_per_plan: actions of a plan to perform before the next plan is made.
        time_budget: seconds that a plan may take, or None; see `act`.
        measure: what the returns in the worlds are worth together.
        device: where dynamics and planner compute.

    Raises:
        TypeError, ValueError: a number is out of its range, the planner's plans are not NamedTuples of tensors, or
            their actions do not fit ``action_space``.
    """

    risk = _of_risk("risk")
    risk_aversion = _of_risk("risk_aversion")
    cvar_share = _of_risk("cvar_share")

    def __init__(
        self,
        dynamics: DynamicsModel,
        planner: Planner,
        action_space: spaces.Box,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        time_budget: float | None = None,
        measure: RiskMeasure = EXPECTED,
        *,
        device: torch.device | str = "cpu",
    ):
        self.dynamics, self.planner, self.device = dynamics, planner, torch.device(device)
        self.num_late = 0
        """Plans that took longer than the budget, since this object was made."""
        self.cold = PlanState(_checked_fields(planner))
        """Where the first plan of an episode starts from."""
        self.horizon, planned = self.cold.plan.actions.shape
        needed = math.prod(action_space.shape)
        if planned != needed:
            raise ValueError(f"the planner plans actions of {planned} numbers, the action space has {needed}")
        self._low, self._high = action_bounds(action_space, self.device)
        self.num_particles = num_particles
        self.actions_per_plan = actions_per_plan
        self.time_budget = time_budget
        self.measure = measure
        compute_on_one_thread_in_children()

    @property
    def num_particles(self) -> int:
        """P, worlds per plan."""
        return self._num_particles

    @num_particles.setter
    def num_particles(self, num_particles: int) -> None:
        check_counts(num_particles=num_particles)
        self._num_particles = num_particles

    @property
    def actions_per_plan(self) -> int:
        """Actions of a plan to perform before the next plan is made."""
        return self._actions_per_plan

    @actions_per_plan.setter
    def actions_per_plan(self, actions_per_plan: int) -> None:
        check_counts(actions_per_plan=actions_per_plan)
        if actions_per_plan > self.horizon:
            raise ValueError(
                f"actions_per_plan must lie in 1 to the planner's horizon {self.horizon}, got {actions_per_plan}"
            )
        self._actions_per_plan = actions_per_plan

    @property
    def time_budget(self) -> float | None:
        """Seconds that a plan may take, or None."""
        return self._time_budget

    @time_budget.setter
    def time_budget(self, time_budget: float | None) -> None:
        is_number = isinstance(time_budget, numbers.Real)
        if time_budget is not None and not (is_number and math.isfinite(time_budget) and time_budget > 0):
            raise ValueError(f"time_budget must be a positive number of seconds, or None, got {time_budget!r}")
        self._time_budget = time_budget

    def worlds(self, generator: torch.Generator) -> Callable[[], TransitionSampler]:
        """One draw of the worlds, made when it is first asked for; plans made together may share it."""
        return cache(lambda: self.dynamics.draw(self.num_particles, self.horizon, generator))

    @torch.inference_mode(False)  # what is made in it has no gradients, which a planner may ask for
    @torch.no_grad()
    def act(
        self,
        task: Task,
        observation: np.ndarray,
        carried: PlanState,
        generator: torch.Generator,
        worlds: Callable[[], TransitionSampler] | None = None,
    ) -> Acted:
        """One action from the carried plan; if none of its actions are left, optimise it first.

        With a time budget the planner gets a deadline, and returns the best plan that it has found by then. Drawing
        the worlds is part of the budget; a plan that is late all the same is counted.

        Args:
            task: what to plan for, and how the model sees an observation.
            observation: [S].
            carried: what the last step of the same episode returned, or `cold`.
            generator: for the worlds and the planner.
            worlds: what `worlds` returned; None draws some for this plan alone.

        Raises:
            PlanningError: no candidate had a finite return, or the planner returned something other than a plan of its
                own with finite actions.
        """
        started = time.perf_counter()
        plan, age = carried
        info, late = None, False
        if age >= self.actions_per_plan:  # it has become smaller since the plan was made
            plan, age = self.planner.shift(plan, age), 0
        if age == 0:
            deadline = None if self.time_budget is None else started + self.time_budget
            drawn = self.worlds(generator)() if worlds is None else worlds()
            start = task.start(observation).to(self.device)
            reward_fn, terminated_fn = task.planned[:2]
            assert reward_fn is not None
            objective = rollout_objective(
                drawn, reward_fn, start, self.num_particles, terminated_fn, measure=self.measure, tail=self.tail(task)
            )
            proposals = self.proposals(task, drawn, start)
            offered = {} if proposals is None else {"proposals": proposals.to(self._low).clamp(self._low, self._high)}
            try:
                plan, info = self.planner.plan(objective, plan, generator, deadline=deadline, **offered)
                late = deadline is not None and time.perf_counter() > deadline
                self._check_planned(plan)
            except PlanningError as error:
                raise PlanningError(f"{error}; planning started from the observation {observation}") from error
            self.num_late += late
        # In the precision in which it is stored, so that it can be performed again exactly.
        action = plan.actions[age].float().clamp(self._low, self._high).cpu().numpy()
        age += 1
        after = PlanState(plan, age) if age < self.actions_per_plan else PlanState(self.planner.shift(plan, age))
        return Acted(action, after, info, time.perf_counter() - started, late)

    def tail(self, task: Task) -> Tail | None:
        """What follows a plan's last step; nothing, unless a subclass knows better."""
        return None

    def proposals(
        self, task: Task, sampler: TransitionSampler, start: Float[torch.Tensor, " S_all"]
    ) -> Float[torch.Tensor, "n H A"] | None:
        """Sequences for the planner to try among its own; none, unless a subclass has some."""
        return None

    def midpoint(self) -> np.ndarray:
        """The middle of the action range, [A]."""
        return (self._low / 2 + self._high / 2).cpu().numpy()

    def uniform(self, generator: torch.Generator) -> np.ndarray:
        """A uniformly random action, [A]."""
        return self.within(torch.rand(self._low.shape, generator=generator, dtype=torch.float32, device=self.device))

    def within(self, share: Float[torch.Tensor, " A"]) -> np.ndarray:
        """The action that lies at these shares of the range, from 0, the lower bounds, to 1, [A]."""
        return (self._low + (self._high - self._low) * share).clamp(self._low, self._high).cpu().numpy()

    def _check_planned(self, plan: Plan) -> None:
        """Raise PlanningError unless a plan can be performed, carried on and saved.

        Here rather than in the planners, so that no planner of any kind can have a value performed that is not finite.
        """
        name = type(self.planner).__name__
        expected = {field: (tuple(value.shape), value.dtype) for field, value in self.cold.plan._asdict().items()}
        received = {field: (tuple(value.shape), value.dtype) for field, value in plan._asdict().items()}
        if received != expected or plan.actions.shape != self.cold.plan.actions.shape:
            raise PlanningError(f"{name} must return a plan of the fields {expected}, got {received}")
        if not plan.actions.isfinite().all():
            raise PlanningError(f"{name} returned actions that are not finite: {plan.actions.tolist()}")


def _checked_fields(planner: Planner) -> Plan:
    """A planner's initial plan, if it can be carried and saved by its fields."""
    plan, name = planner.initial_plan(), type(planner).__name__
    if not isinstance(plan, Plan) or not all(isinstance(value, torch.Tensor) for value in plan._asdict().values()):
        raise TypeError(f"the plans of {name} must be NamedTuples of tensors that have `actions`, got {plan!r}")
    if "age" in plan._asdict():
        raise ValueError(f"the plans of {name} have a field 'age', which a carried plan has itself: rename it")
    return plan
