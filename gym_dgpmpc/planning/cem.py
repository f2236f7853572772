"""The cross-entropy method over action sequences: the planner of the paper, in the variant that PETS runs.

Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models"; the
truncation and the variance cap are in their published code rather than in the text.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.planning.search import (
    check_bounds,
    check_plan,
    iterations,
    midpoints,
    no_finite_score,
    scored,
    shifted,
    with_proposals,
)
from gym_dgpmpc.types import Objective, PlanInfo

TRUNCATION = 2.0  # candidates lie within this many standard deviations of the mean


def truncated_normal(
    shape: tuple[int, ...], generator: torch.Generator, *, device: torch.device, dtype: torch.dtype
) -> Float[Tensor, "..."]:
    """Standard normal draws conditioned on |z| <= 2, by the inverse distribution function.

    With U uniform on [-1, 1), z = sqrt(2) erfinv(U erf(2 / sqrt 2)). The argument of erfinv stays within +-0.9545, so
    no draw is infinite in any precision.
    """
    within = math.erf(TRUNCATION / math.sqrt(2.0))
    uniform = torch.rand(shape, generator=generator, device=device, dtype=dtype)
    noise = uniform.mul_(2.0 * within).sub_(within).erfinv_().mul_(math.sqrt(2.0))
    return noise.clamp_(-TRUNCATION, TRUNCATION)


def elite_shares(scores: Float[Tensor, " K"], num_elites: int) -> Float[Tensor, " K"]:
    """How much each candidate counts among the elites; the shares sum to one, or to zero if no score is finite.

    The best ``num_elites`` count alike. Those that tie for the last places share them: where a score counts steps
    survived most candidates tie, and any few picked among them would drag the mean about and narrow the spread where
    the objective says nothing. A score that is not finite has no share.
    """
    # topk ranks NaN highest, hence the replacement before it.
    ranked = scores.where(scores.isfinite(), -math.inf)
    best = ranked.topk(num_elites).values
    valid = best > -math.inf
    last = best.where(valid, math.inf).min()
    above, tied = ranked > last, ranked == last
    num_valid, num_above, num_tied = valid.sum(), above.sum(), tied.sum()
    share = above + tied * ((num_valid - num_above) / num_tied.clamp(min=1)).to(scores.dtype)
    return share / num_valid.clamp(min=1)


def checked_elites(num_elites: int | None, num_candidates: int) -> int:
    """The number of elites: as given, or a tenth of the candidates.

    Raises:
        TypeError, ValueError: it is not positive, or there are fewer candidates.
    """
    if num_elites is None:
        return max(1, num_candidates // 10)
    check_counts(num_elites=num_elites)
    if num_elites > num_candidates:
        raise ValueError(f"num_elites must not exceed num_candidates, got {num_elites} of {num_candidates}")
    return num_elites


def refitted(
    mean: Float[Tensor, "H A"],
    variance: Float[Tensor, "H A"],
    candidates: Float[Tensor, "K H A"],
    share: Float[Tensor, " K"],
    smoothing: float,
) -> tuple[Float[Tensor, "H A"], Float[Tensor, "H A"]]:
    """The Gaussian of the elites, of which each candidate counts its share, joined with the one before.

    m <- a m + (1 - a) mean(elites), v <- a v + (1 - a) var(elites), with the population variance.
    """
    weight = share.to(mean.dtype)
    elite_mean = torch.tensordot(weight, candidates, 1)
    elite_variance = torch.tensordot(weight, (candidates - elite_mean).square_(), 1)
    return elite_mean.lerp(mean, smoothing), elite_variance.lerp(variance, smoothing)


class GaussianPlan(NamedTuple):
    """A diagonal Gaussian over action sequences."""

    mean: Float[Tensor, "H A"]
    std: Float[Tensor, "H A"]

    @property
    def actions(self) -> Float[Tensor, "H A"]:
        """The mean."""
        return self.mean


class CEM:
    """Cross-entropy method: sample sequences, keep the best, fit a diagonal Gaussian to them, repeat.

    Every plan starts with the standard deviation (high - low) / 4, whatever the plan before it ended with; only the
    mean is carried from one control step to the next. The result is the mean, not the best sequence sampled.

    PETS stops at the variance 0.001 in the units of the action: the default of ``min_std`` on a range of 6, and before
    the first iteration on a range of 0.1. A fraction of the range does not depend on the units.

    Args:
        action_low: lower bounds of the action, [A], finite; their dtype and device are those of the plans.
        action_high: upper bounds, with the same dtype and device.
        horizon: actions in a plan, H; the time a plan takes grows with it.
        num_candidates: action sequences sampled in each iteration, K.
        num_elites: best sequences of an iteration, to which the Gaussian is fitted; default: a tenth of the candidates,
            at least one.
        num_iterations: iterations of a plan, at most.
        smoothing: weight of the old mean and variance in the new ones, in [0, 1).
        min_std: stop early once every action's standard deviation is below this fraction of its range.

    Raises:
        TypeError, ValueError: naming the argument, what was expected and what was received.
    """

    largest: ClassVar[Mapping[str, int]] = MappingProxyType({"horizon": 10**4, "num_candidates": 10**5})
    """What a file may claim; see `settings.settings_of`."""

    def __init__(
        self,
        action_low: Float[Tensor, " A"],
        action_high: Float[Tensor, " A"],
        *,
        horizon: int = 30,
        num_candidates: int = 300,
        num_elites: int | None = None,
        num_iterations: int = 5,
        smoothing: float = 0.1,
        min_std: float = 0.005,
    ):
        check_bounds(action_low, action_high)
        check_counts(horizon=horizon, num_candidates=num_candidates, num_iterations=num_iterations)
        check_reals("[0, 1)", smoothing=smoothing)
        check_reals("[0, inf]", min_std=min_std)
        self.action_low = action_low.detach().clone()
        self.action_high = action_high.detach().clone()
        self.horizon = horizon
        self.num_candidates = num_candidates
        self.num_elites = checked_elites(num_elites, num_candidates)
        self.num_iterations = num_iterations
        self.smoothing = smoothing
        self.min_std = min_std

    def initial_plan(self) -> GaussianPlan:
        """The middle of the action range at every step, with the start's standard deviation."""
        return self._widened(midpoints(self.action_low, self.action_high, self.horizon))

    def shift(self, plan: GaussianPlan, num_actions: int) -> GaussianPlan:
        """Drop the first ``num_actions`` of the mean, fill its end with the midpoint and widen it again.

        Raises:
            ValueError: the plan is not of this planner's shape, or has fewer than ``num_actions`` actions.
        """
        check_plan(plan, self.initial_plan())
        return self._widened(shifted(plan.mean, num_actions, midpoints(self.action_low, self.action_high, 1)))

    @torch.no_grad()
    def plan(
        self,
        objective: Objective,
        plan: GaussianPlan,
        generator: torch.Generator,
        deadline: float | None = None,
        proposals: Float[Tensor, "n H A"] | None = None,
    ) -> tuple[GaussianPlan, PlanInfo]:
        """Maximise ``objective`` from ``plan``.

        A score that is not finite counts as minus infinity and is never an elite; with fewer finite scores than
        elites, the finite ones alone are fitted. Candidates that tie for the last places share them.

        Args:
            deadline: a time of `time.perf_counter`; see `iterations`. With no time for a single iteration the result
                is ``plan`` within the bounds.
            proposals: sequences to try too, within the bounds, in the place of some of the planner's own.

        Raises:
            PlanningError: no candidate of an iteration had a finite score.
            ValueError: ``plan`` or the objective's result has the wrong shape.
        """
        check_plan(plan, self.initial_plan())
        low, high = self.action_low, self.action_high
        mean, variance = plan.mean.clamp(low, high), plan.std.square()
        shape = (self.num_candidates, self.horizon, low.shape[0])
        narrowest = torch.where(low == high, math.inf, self.min_std * (high - low))
        num_nonfinite, iterations_done, expected_return = 0, 0, math.nan
        for iteration in iterations(self.num_iterations, deadline):
            # Sample candidates from the truncated normal; the cap on its std keeps +-2 std within the bounds, so the
            # clamp only removes rounding. The cap is for sampling alone and does not enter the recursion below.
            room = torch.minimum(mean - low, high - mean)
            std = torch.minimum(variance.sqrt(), room / TRUNCATION)
            noise = truncated_normal(shape, generator, device=low.device, dtype=low.dtype)
            candidates = with_proposals((mean + std * noise).clamp_(low, high), proposals)

            # Score them, select the elites and refit.
            scores = scored(objective, candidates)
            share = elite_shares(scores, self.num_elites)
            mean, variance = refitted(mean, variance, candidates, share, self.smoothing)

            # All that the host must know, in its one synchronisation of the iteration.
            finite = scores.isfinite()
            narrow = (variance.sqrt() < narrowest).all()
            value = share @ scores.where(finite, 0.0)
            num_finite, is_narrow, expected_return = torch.stack([finite.sum(), narrow, value]).tolist()
            num_nonfinite += self.num_candidates - int(num_finite)
            if num_finite == 0:
                raise no_finite_score(self.num_candidates, iteration, num_nonfinite)
            iterations_done = iteration
            if is_narrow:
                break
        plan = GaussianPlan(mean.clamp(low, high), variance.sqrt())
        return plan, PlanInfo(expected_return, num_nonfinite, {"num_iterations": iterations_done})

    def _widened(self, mean: Float[Tensor, "H A"]) -> GaussianPlan:
        return GaussianPlan(mean, ((self.action_high - self.action_low) / 4).expand_as(mean).clone())
