"""Planning by gradients: action sequences climb the return, differentiated through the model's worlds.

What shooting methods of trajectory optimisation do, with functions drawn from a posterior in the model's place: for one
draw the return is a deterministic, smooth function of the actions, so a few steps of an optimiser take the place of
thousands of samples (the pathwise gradients of Wilson et al. 2020; planning by them, Bharadhwaj, Xie and Shkurti 2020,
"Model-Predictive Control via Cross-Entropy and Gradient-Based Optimization").
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.planning.ascent import AdamAscent, LBFGSAscent
from gym_dgpmpc.planning.cem import CEM
from gym_dgpmpc.planning.coloured_noise import coloured_noise
from gym_dgpmpc.planning.search import (
    check_bounds,
    check_plan,
    iterations,
    no_finite_score,
    scored,
    with_proposals,
)
from gym_dgpmpc.planning.sequence import CarriesSequence, Sequence
from gym_dgpmpc.types import Objective, PlanInfo

Optimiser = Literal["adam", "lbfgs"]
StartFrom = Literal["plan", "cem"]

ASCENTS: Mapping[Optimiser, type[AdamAscent] | type[LBFGSAscent]] = MappingProxyType(
    {"adam": AdamAscent, "lbfgs": LBFGSAscent}
)


class GradientAscent(CarriesSequence):
    """Climb the objective from K sequences side by side, each on its own; the plan is the best one that was scored.

    The first sequence is the one that is carried, or the mean that `CEM` found from it; the others are drawn around it.
    Actions are projected on their bounds rather than squashed into them: a plan that lies on a bound, as many do, is
    exactly there, and leaves as soon as its gradient points inwards, where the slope of a squashing function is zero.

    The objective must be differentiable: its worlds are those of a model whose draws have gradients, and its reward is
    made of PyTorch's differentiable operations. L-BFGS compares scores of different calls, and is for draws of whole
    functions (of a deep Gaussian process, "pathwise"); Adam bears noise that is fresh at each call.

    Args:
        action_low: lower bounds of the action, [A], finite; their dtype and device are those of the plans.
        action_high: upper bounds, with the same dtype and device.
        horizon: actions in a plan, H; the time a plan takes grows with it.
        num_starts: sequences that climb side by side, K.
        num_iterations: steps of a plan, at most, each with one gradient of all sequences.
        optimiser: "lbfgs", which finds the very top where the return is smooth; or "adam".
        action_step: how far the first step moves an action at most, as a fraction of its range. The steps of "adam"
            fall from that linearly to nothing.
        start_from: what the first sequence is: the "plan" that is carried, or what "cem" makes of it in a part of the
            time.
        cem_candidates: candidates of each iteration of CEM, with ``start_from="cem"``.
        cem_iterations: iterations of CEM, with ``start_from="cem"``.
        start_std: standard deviation of the other sequences about the first, as a fraction of the action's range; with
            ``start_from="cem"`` it is what CEM ended with.
        noise_beta: colour of that noise, whose power falls with the frequency f as f^-beta: 0 is white, 2 red.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what was received.
    """

    largest: ClassVar[Mapping[str, int]] = MappingProxyType(
        {"horizon": 10**4, "num_starts": 10**4, "cem_candidates": 10**5}
    )
    """What a file may claim; see `settings.settings_of`."""

    def __init__(
        self,
        action_low: Float[Tensor, " A"],
        action_high: Float[Tensor, " A"],
        *,
        horizon: int = 30,
        num_starts: int = 4,
        num_iterations: int = 10,
        optimiser: Optimiser = "lbfgs",
        action_step: float = 0.1,
        start_from: StartFrom = "plan",
        cem_candidates: int = 100,
        cem_iterations: int = 3,
        start_std: float = 0.25,
        noise_beta: float = 1.0,
    ):
        check_bounds(action_low, action_high)
        check_counts(horizon=horizon, num_starts=num_starts, num_iterations=num_iterations)
        check_counts(cem_candidates=cem_candidates, cem_iterations=cem_iterations)
        check_reals("(0, 1]", action_step=action_step, start_std=start_std)
        check_reals("[0, 10]", noise_beta=noise_beta)
        for name, value, known in (
            ("optimiser", optimiser, get_args(Optimiser)),
            ("start_from", start_from, get_args(StartFrom)),
        ):
            if value not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
        self.action_low = action_low.detach().clone()
        self.action_high = action_high.detach().clone()
        self.horizon = horizon
        self.num_starts = num_starts
        self.num_iterations = num_iterations
        self.optimiser = optimiser
        self.action_step = action_step
        self.start_from = start_from
        self.cem_candidates = cem_candidates
        self.cem_iterations = cem_iterations
        self.start_std = start_std
        self.noise_beta = noise_beta

    @torch.no_grad()
    def plan(
        self,
        objective: Objective,
        plan: Sequence,
        generator: torch.Generator,
        deadline: float | None = None,
        proposals: Float[Tensor, "n H A"] | None = None,
    ) -> tuple[Sequence, PlanInfo]:
        """Maximise ``objective`` from ``plan``; a sequence whose score or gradient is not finite goes back.

        Args:
            deadline: a time of `time.perf_counter`; see `iterations`. With no time for a single iteration the result
                is ``plan`` within the bounds, or what CEM made of it.
            proposals: sequences to try too, within the bounds, in the place of some of the planner's own.

        Raises:
            PlanningError: no sequence has had a finite score.
            NotDifferentiableError: the objective has no gradient.
            ValueError: ``plan`` or the objective's result has the wrong shape.
        """
        check_plan(plan, self.initial_plan())
        low, high, num_rows = self.action_low, self.action_high, self.num_starts
        best, std = plan.actions.clamp(low, high), (high - low) * self.start_std
        best_score, num_nonfinite, iterations_done = math.nan, 0, 0
        if self.start_from == "cem":
            search = {"num_candidates": self.cem_candidates, "num_iterations": self.cem_iterations}
            cem = CEM(low, high, horizon=self.horizon, **search)
            found, of_cem = cem.plan(objective, cem.initial_plan()._replace(mean=best), generator, deadline)
            best, std, best_score, num_nonfinite = found.mean, found.std, of_cem.expected_return, of_cem.num_nonfinite

        # The first sequence, and others around it, in units of the action's range.
        width = high - low
        noise = coloured_noise(
            (num_rows, self.horizon, len(low)), self.noise_beta, generator, device=low.device, dtype=low.dtype
        )
        noise[0] = 0.0
        around = (best + std * noise).clamp(low, high)
        around = torch.cat([around[:1], with_proposals(around[1:], proposals)])
        start = (around - low) / torch.where(width > 0, width, 1.0)
        ascent = ASCENTS[self.optimiser].init(start.flatten(1), self.action_step, self.num_iterations)
        first_score = math.nan
        for iteration in iterations(self.num_iterations, deadline):
            # Score them with gradients.
            actions = (low + width * ascent.position.view(start.shape)).clamp(low, high)
            scores, gradient = scores_and_gradients(objective, actions)

            # Keep the best; all that the host must know, in its one synchronisation of the iteration.
            finite = scores.isfinite()
            ranked = scores.masked_fill(~finite, -math.inf)
            place = ranked.argmax()
            top, num_finite, of_first = torch.stack([ranked[place], finite.sum(), scores[0]]).tolist()
            num_nonfinite += num_rows - int(num_finite)
            if iteration == 1:
                first_score, best_score = of_first, -math.inf
            if top > best_score:
                best, best_score = actions[place], top
            if best_score == -math.inf:
                raise no_finite_score(num_rows, iteration, num_nonfinite)
            iterations_done = iteration
            ascent = ascent.step(scores.to(low.dtype), (gradient * width).flatten(1))
        climbed = best_score - first_score if math.isfinite(first_score) else math.nan
        return Sequence(best), PlanInfo(
            best_score, num_nonfinite, {"num_iterations": iterations_done, "climbed": climbed}
        )


def scores_and_gradients(
    objective: Objective, actions: Float[Tensor, "K H A"]
) -> tuple[Float[Tensor, " K"], Float[Tensor, "K H A"]]:
    """The objective's scores, and the gradient of each by its own actions; zero if no score is finite.

    Raises:
        NotDifferentiableError: there is none.
        ValueError: there is not one score for each sequence.
    """
    with torch.enable_grad():
        variable = actions.clone().requires_grad_()
        scores = scored(objective, variable)
        found = scores.detach()
        if not bool(found.isfinite().any()):
            return found, torch.zeros_like(actions)
        gradient = torch.autograd.grad(scores.sum(), variable, allow_unused=True)[0] if scores.requires_grad else None
    if gradient is None:
        raise NotDifferentiableError(
            "the objective has no gradient by the actions: its reward must be made of differentiable operations of "
            "PyTorch, and depend on states or actions; plan by a planner that asks for no gradients (cem, icem or mppi)"
        )
    return found, gradient
