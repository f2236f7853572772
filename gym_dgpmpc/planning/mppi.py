"""Model-predictive path integral control: the plan is a mean of all candidates, weighted by their returns.

Williams et al. (2017), "Information Theoretic MPC for Model-Based Reinforcement Learning", Algorithm 2. The weight of
alpha in the control cost is in its longer version, Williams et al. (2018), "Information-Theoretic Model Predictive
Control: Theory and Applications to Autonomous Driving".
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.planning.coloured_noise import coloured_noise
from gym_dgpmpc.planning.search import (
    check_bounds,
    check_plan,
    iterations,
    midpoints,
    no_finite_score,
    scored,
    with_proposals,
)
from gym_dgpmpc.planning.sequence import CarriesSequence, Sequence
from gym_dgpmpc.types import Objective, PlanInfo


def path_weights(
    scores: Float[Tensor, " K"], temperature: float, *, standardise: bool, cost: Float[Tensor, " K"] | float = 0.0
) -> Float[Tensor, " K"]:
    """w_k ~ exp(R_k / temperature - cost_k), which sum to one; float64. NaN if no score is finite.

    Args:
        scores: returns R; one that is not finite has no weight.
        temperature: lambda, in units of R; with ``standardise`` in units of the finite scores' standard deviation.
        standardise: see there. Scores that are all alike have the weights of their costs.
        cost: of the candidate beside its return, which the temperature does not divide.
    """
    finite = scores.isfinite()
    # From the best one, so that nothing overflows; that changes no weight.
    best = scores.masked_fill(~finite, -math.inf).max().double()
    below = (scores.double() - best).masked_fill(~finite, 0.0)
    scale: Tensor | float = temperature
    if standardise:
        count = finite.sum()
        variance = (below - below.sum() / count).square().masked_fill(~finite, 0.0).sum() / count
        scale = torch.where(variance > 0, temperature * variance.sqrt(), 1.0)
    return torch.softmax((below / scale - cost).masked_fill(~finite, -math.inf), dim=0)


class MPPI(CarriesSequence):
    """Model-predictive path integral control: u <- sum_k w_k v_k with w_k ~ exp(R_k / lambda) and v_k = u + e_k.

    The noise e has the same standard deviation in every iteration; candidates v are clipped to the bounds, and e_k is
    what remains of it. The paper makes one iteration of each plan (``num_iterations=1``), with returns as they are
    (``standardise=False``) and the whole control cost (``control_cost=1``); the defaults spend what those of `CEM` do,
    and their temperature needs to know nothing of the reward's units.

    Args:
        action_low: lower bounds of the action, [A], finite; their dtype and device are those of the plans.
        action_high: upper bounds, with the same dtype and device.
        horizon: actions in a plan, H; the time a plan takes grows with it.
        num_candidates: action sequences sampled in each iteration, K.
        num_iterations: iterations of a plan, at most.
        temperature: lambda: the lower, the fewer candidates count. In units of the standard deviation of a plan's
            scores, or with ``standardise=False`` of the return.
        standardise: whether the temperature is in units of the scores' standard deviation.
        noise_std: standard deviation of the candidates' noise, as a fraction of the action's range.
        noise_beta: colour of that noise, whose power falls with the frequency f as f^-beta: 0 is white, 2 red.
        control_cost: 1 - alpha of the paper, in [0, 1]: how much the sum of (u - m)^T Sigma^-1 e, with the middle m of
            the action range, counts against a candidate. It draws plans to the middle; for white noise.

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
        num_iterations: int = 5,
        temperature: float = 0.5,
        standardise: bool = True,
        noise_std: float = 0.25,
        noise_beta: float = 0.0,
        control_cost: float = 0.0,
    ):
        check_bounds(action_low, action_high)
        check_counts(horizon=horizon, num_candidates=num_candidates, num_iterations=num_iterations)
        check_reals("(0, inf)", temperature=temperature)
        check_reals("(0, 1]", noise_std=noise_std)
        check_reals("[0, 10]", noise_beta=noise_beta)
        check_reals("[0, 1]", control_cost=control_cost)
        if control_cost and noise_beta:
            raise ValueError(
                f"the control cost is that of white noise: expected noise_beta = 0 with control_cost = {control_cost}, "
                f"got {noise_beta}"
            )
        self.action_low = action_low.detach().clone()
        self.action_high = action_high.detach().clone()
        self.horizon = horizon
        self.num_candidates = num_candidates
        self.num_iterations = num_iterations
        self.temperature = temperature
        self.standardise = standardise
        self.noise_std = noise_std
        self.noise_beta = noise_beta
        self.control_cost = control_cost

    @torch.no_grad()
    def plan(
        self,
        objective: Objective,
        plan: Sequence,
        generator: torch.Generator,
        deadline: float | None = None,
        proposals: Float[Tensor, "n H A"] | None = None,
    ) -> tuple[Sequence, PlanInfo]:
        """Maximise ``objective`` from ``plan``; a score that is not finite has no weight.

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
        mean, std = plan.actions.clamp(low, high), (high - low) * self.noise_std
        shape = (self.num_candidates, self.horizon, len(low))
        num_nonfinite, iterations_done, expected_return = 0, 0, math.nan
        metrics = {"effective_candidates": math.nan}
        for iteration in iterations(self.num_iterations, deadline):
            # Sample around the mean, within the bounds, and score.
            noise = coloured_noise(shape, self.noise_beta, generator, device=low.device, dtype=low.dtype)
            candidates = with_proposals((mean + std * noise).clamp(low, high), proposals)
            scores = scored(objective, candidates)
            finite = scores.isfinite()

            # The mean of the candidates by their weights, within the bounds but for rounding.
            cost = self._control_cost(candidates, mean, std) if self.control_cost else 0.0
            weight = path_weights(scores, self.temperature, standardise=self.standardise, cost=cost)
            mean = torch.einsum("k,kha->ha", weight.to(low.dtype), candidates).clamp(low, high)

            # All that the host must know, in its one synchronisation of the iteration.
            value = (weight * scores.masked_fill(~finite, 0.0)).sum()
            num_finite, expected_return, effective = torch.stack(
                [finite.sum(), value, 1 / weight.square().sum()]
            ).tolist()
            num_nonfinite += self.num_candidates - int(num_finite)
            if num_finite == 0:
                raise no_finite_score(self.num_candidates, iteration, num_nonfinite)
            iterations_done, metrics["effective_candidates"] = iteration, effective
        return Sequence(mean), PlanInfo(expected_return, num_nonfinite, {"num_iterations": iterations_done, **metrics})

    def _control_cost(
        self, candidates: Float[Tensor, "K H A"], mean: Float[Tensor, "H A"], std: Float[Tensor, " A"]
    ) -> Float[Tensor, " K"]:
        """(1 - alpha) sum_t (u_t - m)^T Sigma^-1 e_t; an action that is fixed costs nothing."""
        push = (mean - midpoints(self.action_low, self.action_high, 1)) / std.square()
        push = push.masked_fill(std == 0, 0.0)
        return self.control_cost * torch.einsum("ha,kha->k", push, candidates - mean)
