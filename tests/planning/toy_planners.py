"""Planners that share nothing with CEM but the interface, so that what is tested of planners holds for any."""

import math
import time
from typing import NamedTuple

import torch
from torch import Tensor

from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.types import PlanInfo


class Sequence(NamedTuple):
    """One sequence of actions and nothing else, [H, A]."""

    actions: Tensor


class SequenceWithElites(NamedTuple):
    """A sequence [H, A], and the best ones found so far [E, H, A]; E is not the number of actions."""

    elites: Tensor
    actions: Tensor


class RandomShooting:
    """The best of uniformly random sequences and of the one that is carried."""

    def __init__(self, action_low, action_high, *, horizon=30, num_candidates=100):
        self.low, self.high = action_low.clone(), action_high.clone()
        self.horizon, self.num_candidates = horizon, num_candidates

    def initial_plan(self):
        return Sequence(self._middle(self.horizon))

    @torch.no_grad()
    def plan(self, objective, plan, generator, deadline=None):
        actions = plan.actions.clamp(self.low, self.high)
        if deadline is not None and time.perf_counter() >= deadline:
            return Sequence(actions), PlanInfo(math.nan, metrics={"gain": math.nan})
        candidates = torch.cat([actions[None], self._uniform(self.num_candidates - 1, generator)])
        scores, num_nonfinite = finite_scores(objective, candidates)
        info = PlanInfo(scores.max().item(), num_nonfinite, {"gain": (scores.max() - scores[0]).item()})
        if not math.isfinite(info.metrics["gain"]):
            info = info._replace(metrics={"gain": math.nan})
        return Sequence(candidates[scores.argmax()]), info

    def shift(self, plan, num_actions):
        return Sequence(self._shifted(plan.actions, num_actions))

    def _middle(self, length):
        return (self.low / 2 + self.high / 2).expand(length, -1).clone()

    def _uniform(self, count, generator):
        uniform = torch.rand(
            count, self.horizon, len(self.low), generator=generator, dtype=self.low.dtype, device=self.low.device
        )
        return (self.low * (1 - uniform) + self.high * uniform).clamp(self.low, self.high)

    def _shifted(self, actions, num_actions):
        if not 0 <= num_actions <= self.horizon:
            raise ValueError(f"num_actions must lie in 0 to {self.horizon}, got {num_actions}")
        return torch.cat([actions[num_actions:], self._middle(num_actions)])


class ElitesKept(RandomShooting):
    """Rounds of random sequences, half of them mixed with elites, which live on in the next plan."""

    num_elites = 3

    def __init__(self, action_low, action_high, *, horizon=30, num_candidates=100, num_rounds=3):
        super().__init__(action_low, action_high, horizon=horizon, num_candidates=num_candidates)
        self.num_rounds = num_rounds

    def initial_plan(self):
        middle = self._middle(self.horizon)
        return SequenceWithElites(middle.expand(self.num_elites, -1, -1).clone(), middle)

    @torch.no_grad()
    def plan(self, objective, plan, generator, deadline=None):
        elites, actions = (each.clamp(self.low, self.high) for each in plan)
        best, num_nonfinite, slowest, now = math.nan, 0, 0.0, time.perf_counter()
        for _ in range(self.num_rounds):
            if deadline is not None and now + slowest >= deadline:
                break
            fresh = self._uniform(self.num_candidates - self.num_elites, generator)
            fresh[::2] = (fresh[::2] / 4 + elites[0] * 0.75).clamp(self.low, self.high)
            candidates = torch.cat([elites, fresh])
            scores, nonfinite = finite_scores(objective, candidates)
            num_nonfinite += nonfinite
            order = scores.argsort(descending=True, stable=True)[: self.num_elites]
            # With fewer finite scores than elites the best one fills their places.
            elites = candidates[torch.where(scores[order].isfinite(), order, order[0])]
            actions, best = elites[0].clone(), scores.max().item()
            slowest, now = max(slowest, time.perf_counter() - now), time.perf_counter()
        return SequenceWithElites(elites, actions), PlanInfo(best, num_nonfinite)

    def shift(self, plan, num_actions):
        actions = self._shifted(plan.actions, num_actions)
        return SequenceWithElites(torch.stack([self._shifted(each, num_actions) for each in plan.elites]), actions)


def finite_scores(objective, candidates):
    """Scores with minus infinity for those that are not finite, and how many those are."""
    scores = objective(candidates)
    finite = scores.isfinite()
    if not finite.any():
        raise PlanningError(f"none of {len(candidates)} candidates had a finite score")
    return scores.masked_fill(~finite, -math.inf), int((~finite).sum())
