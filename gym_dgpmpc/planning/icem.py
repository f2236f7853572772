"""The improved cross-entropy method: fewer samples, spent where they tell more.

Pinneri et al. (2020), "Sample-efficient Cross-Entropy Method for Real-time Planning". What it adds to CEM: candidates
whose noise is correlated in time, elites that live on within a plan and from plan to plan, a population that shrinks,
the mean among the last candidates, and the best sequence as the result.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.planning.cem import checked_elites, elite_shares, refitted
from gym_dgpmpc.planning.coloured_noise import coloured_noise
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


class PlanWithElites(NamedTuple):
    """The mean of the candidates, and the best ones.

    Attributes:
        mean: what the next plan's candidates are drawn around.
        actions: the best sequence.
        elites: the best sequences, of which the first ``num_kept`` mean something.
        num_kept: how many there are; none before the first plan.
        num_open: actions at the end of each elite that took no part in its score, and are to be drawn anew.
    """

    mean: Float[Tensor, "H A"]
    actions: Float[Tensor, "H A"]
    elites: Float[Tensor, "E H A"]
    num_kept: Int[Tensor, ""]
    num_open: Int[Tensor, ""]


class ICEM:
    """Improved cross-entropy method: as `CEM`, with what the authors found to need fewer samples.

    Iteration i samples max(K factor_decrease_num^-i, 2 num_elites) sequences, clipped to the bounds, around the mean;
    the last one has the mean itself among them. A part of the elites is kept for the next iteration with their scores,
    and for the next plan, where they lose their first action and get a sampled last one. Every plan starts with the
    standard deviation ``start_std``, and its result is the best sequence found.

    With ``noise_beta=0``, ``fraction_elites_reused=0`` and ``factor_decrease_num=1`` the mean follows the recursion of
    `CEM`, of normal candidates that are clipped instead of truncated.

    Args:
        action_low: lower bounds of the action, [A], finite; their dtype and device are those of the plans.
        action_high: upper bounds, with the same dtype and device.
        horizon: actions in a plan, H; the time a plan takes grows with it.
        num_candidates: action sequences sampled in the first iteration, K.
        num_elites: best sequences of an iteration, to which the Gaussian is fitted; default: a tenth of the candidates,
            at least one.
        num_iterations: iterations of a plan, at most.
        smoothing: weight of the old mean and variance in the new ones, in [0, 1).
        noise_beta: colour of the candidates' noise, whose power falls with the frequency f as f^-beta: 0 is white, 1
            pink, 2 red. The authors take 0.25 for the half-cheetah, and 2 to 3.5 where a movement takes the whole
            horizon.
        fraction_elites_reused: share of the elites that are kept, in [0, 1].
        factor_decrease_num: by how much the population shrinks from iteration to iteration, at least 1.
        start_std: standard deviation that each plan starts with, as a fraction of the action's range.

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
        noise_beta: float = 0.25,
        fraction_elites_reused: float = 0.3,
        factor_decrease_num: float = 1.25,
        start_std: float = 0.25,
    ):
        check_bounds(action_low, action_high)
        check_counts(horizon=horizon, num_candidates=num_candidates, num_iterations=num_iterations)
        check_reals("[0, 1)", smoothing=smoothing)
        check_reals("[0, 10]", noise_beta=noise_beta)
        check_reals("[0, 1]", fraction_elites_reused=fraction_elites_reused)
        check_reals("[1, inf)", factor_decrease_num=factor_decrease_num)
        check_reals("(0, 1]", start_std=start_std)
        self.action_low = action_low.detach().clone()
        self.action_high = action_high.detach().clone()
        self.horizon = horizon
        self.num_candidates = num_candidates
        self.num_elites = checked_elites(num_elites, num_candidates)
        self.num_iterations = num_iterations
        self.smoothing = smoothing
        self.noise_beta = noise_beta
        self.num_reused = int(fraction_elites_reused * self.num_elites)
        self.factor_decrease_num = factor_decrease_num
        self.start_std = start_std

    def initial_plan(self) -> PlanWithElites:
        """The middle of the action range at every step, without elites."""
        middle = midpoints(self.action_low, self.action_high, self.horizon)
        none = torch.zeros((), dtype=torch.int64, device=middle.device)
        return PlanWithElites(middle, middle.clone(), middle.repeat(self.num_reused, 1, 1), none, none.clone())

    def shift(self, plan: PlanWithElites, num_actions: int) -> PlanWithElites:
        """Drop the first ``num_actions`` of all sequences, and repeat the mean's last action at their ends.

        Those at the ends of the elites are open: `plan` draws others in their place.

        Raises:
            ValueError: the plan is not of this planner's shape, or has fewer than ``num_actions`` actions.
        """
        self._check(plan)
        last = plan.mean[-1:]
        mean, actions, elites = (shifted(each, num_actions, last) for each in plan[:3])
        return PlanWithElites(
            mean, actions, elites, plan.num_kept, (plan.num_open + num_actions).clamp(max=self.horizon)
        )

    @torch.no_grad()
    def plan(
        self,
        objective: Objective,
        plan: PlanWithElites,
        generator: torch.Generator,
        deadline: float | None = None,
        proposals: Float[Tensor, "n H A"] | None = None,
    ) -> tuple[PlanWithElites, PlanInfo]:
        """Maximise ``objective`` from ``plan``.

        A score that is not finite is never an elite; with fewer finite scores than elites, the finite ones alone are
        fitted. Candidates that tie for the last places share them.

        Args:
            deadline: a time of `time.perf_counter`; see `iterations`. With no time for a single iteration the result
                is ``plan`` within the bounds.
            proposals: sequences to try too, within the bounds, in the place of some of the planner's own.

        Raises:
            PlanningError: no candidate of an iteration had a finite score.
            ValueError: ``plan`` or the objective's result has the wrong shape.
        """
        self._check(plan)
        low, high = self.action_low, self.action_high
        mean, best = plan.mean.clamp(low, high), plan.actions.clamp(low, high)
        variance = ((high - low) * self.start_std).square().expand_as(mean)
        elites, elite_scores = plan.elites[:0], low.new_empty(0)  # of this plan
        population, num_nonfinite, iterations_done, expected_return = self.num_candidates, 0, 0, math.nan
        for iteration in iterations(self.num_iterations, deadline):
            # Sample around the mean; the elites of the plan before join the first, the mean itself the last candidates.
            candidates = self._sample(population, mean, variance, generator)
            if iteration == self.num_iterations:
                candidates[0] = mean.clamp(low, high)
            if iteration == 1:
                candidates = with_proposals(candidates, proposals)
                candidates = torch.cat([candidates, self._completed(plan, mean, variance, generator)])

            # Score them; the elites of the iteration before have been scored.
            scores = scored(objective, candidates)
            num_nonfinite += len(scores) - int(scores.isfinite().sum())
            candidates, scores = torch.cat([candidates, elites]), torch.cat([scores, elite_scores])
            ranked = scores.masked_fill(~scores.isfinite(), -math.inf)
            order = ranked.argsort(descending=True, stable=True)[: max(1, self.num_reused)]
            expected_return = float(scores[order[0]])
            if not math.isfinite(expected_return):
                raise no_finite_score(len(scores), iteration, num_nonfinite)

            # Keep the elites, and refit.
            best = candidates[order[0]]
            kept = order[: self.num_reused]
            kept = kept[scores[kept].isfinite()]
            elites, elite_scores = candidates[kept], scores[kept]
            share = elite_shares(scores, self.num_elites)
            mean, variance = refitted(mean, variance, candidates, share, self.smoothing)
            fewest = min(2 * self.num_elites, self.num_candidates)
            population = max(int(population / self.factor_decrease_num), fewest)
            iterations_done = iteration
        info = PlanInfo(expected_return, num_nonfinite, {"num_iterations": iterations_done})
        if iterations_done == 0:
            return plan._replace(mean=mean, actions=best), info
        # With fewer finite candidates than places the best one fills them, and does not count.
        places = torch.cat([elites, best.expand(self.num_reused - len(elites), -1, -1)])
        num_kept = torch.full_like(plan.num_kept, len(elites))
        return PlanWithElites(mean.clamp(low, high), best, places, num_kept, torch.zeros_like(plan.num_open)), info

    def _sample(
        self, count: int, mean: Float[Tensor, "H A"], variance: Float[Tensor, "H A"], generator: torch.Generator
    ) -> Float[Tensor, "K H A"]:
        """Sequences of coloured noise around the mean, within the bounds."""
        low, high = self.action_low, self.action_high
        shape = (count, self.horizon, len(low))
        noise = coloured_noise(shape, self.noise_beta, generator, device=low.device, dtype=low.dtype)
        return (mean + variance.sqrt() * noise).clamp(low, high)

    def _completed(
        self,
        plan: PlanWithElites,
        mean: Float[Tensor, "H A"],
        variance: Float[Tensor, "H A"],
        generator: torch.Generator,
    ) -> Float[Tensor, "E H A"]:
        """The elites that the plan carries, with sampled actions where theirs are open."""
        elites = plan.elites[: int(plan.num_kept)].clamp(self.action_low, self.action_high)
        if not len(elites):
            return elites
        start = self.horizon - int(plan.num_open)
        ends = self._sample(len(elites), mean, variance, generator)[:, start:]
        return torch.cat([elites[:, :start], ends], dim=1)

    def _check(self, plan: PlanWithElites) -> None:
        check_plan(plan, self.initial_plan())
        for name, most in (("num_kept", self.num_reused), ("num_open", self.horizon)):
            count = int(getattr(plan, name))
            if not 0 <= count <= most:
                raise ValueError(f"plan.{name} must lie in 0 to {most}, got {count}")
