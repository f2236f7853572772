"""Policy search through exact moments: the belief stays Gaussian, and the expected reward has a gradient.

Deisenroth and Rasmussen (2011), "PILCO: A Model-Based and Data-Efficient Approach to Policy Search". At each step

    (s, a) ~ N with a's moments and Cov[s, a] from the policy,        s' ~ N by the moments of the Gaussian process,

and the reward is averaged over points whose mean and covariance are the belief's. What differs is in
docs/deviations.md.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.dynamics.sparse_gp.moment_matching import orthonormal_frame
from gym_dgpmpc.errors import FactorisationError, NotDifferentiableError
from gym_dgpmpc.gp.linalg import cholesky
from gym_dgpmpc.policy_search.policies import SquashedPolicy
from gym_dgpmpc.types import RewardFn

SPREAD_JITTER = 1e-9
"""Of the mean variance, added to a belief's covariance where its points are spread: what is known has none."""


class Belief(NamedTuple):
    """A Gaussian over states, float64."""

    mean: Float[Tensor, "1 S"]
    covariance: Float[Tensor, "1 S S"]


class Bounds(NamedTuple):
    """The range of the actions, float64."""

    low: Float[Tensor, " A"]
    high: Float[Tensor, " A"]


class BeliefPath:
    """What a policy's episodes are expected to earn.

    Args:
        propagate: from mean and covariance of (s, a) to those of the next state.
        reward_fn: differentiable; of states, actions and next states.
        start: the belief that episodes begin with.
        bounds: of the actions.
        horizon: steps of an episode.
        num_points: points that a reward is averaged over, more than a state and an action have numbers.
        generator: for the directions of the points, drawn once.

    Raises:
        ValueError: there are too few points.
    """

    def __init__(
        self,
        propagate: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
        reward_fn: RewardFn,
        start: Belief,
        bounds: Bounds,
        horizon: int,
        num_points: int,
        generator: torch.Generator,
    ):
        size = start.mean.shape[1] + len(bounds.low)
        if num_points <= size:
            raise ValueError(
                f"the expected reward needs at least {size + 1} points for {size} numbers of state and action, got "
                f"num_points = {num_points}"
            )
        self._propagate, self._reward_fn, self._start = propagate, reward_fn, start
        self._bounds, self._horizon = bounds, horizon
        self._frame = orthonormal_frame(num_points, size, generator).to(start.mean)

    def expected_return(self, policy: SquashedPolicy) -> Float[Tensor, ""]:
        """The sum of the expected rewards, differentiable by the policy's parameters.

        Raises:
            FactorisationError: a belief became one that is not finite.
        """
        state, total = self._start, self._start.mean.new_zeros(())
        size = state.mean.shape[1]
        for _ in range(self._horizon):
            joint = self.with_action(policy, state)
            after = Belief(*self._propagate(*joint))
            both, ahead = self._points(joint), self._points(after)
            action = both[:, size:].clamp(self._bounds.low, self._bounds.high)
            total = total + self._reward_fn(both[:, :size], action, ahead).mean()
            state = after
        return total

    def with_action(self, policy: SquashedPolicy, state: Belief) -> Belief:
        """The belief over state and action together."""
        action = policy.moments(*state)
        half, middle = (self._bounds.high - self._bounds.low) / 2, (self._bounds.high + self._bounds.low) / 2
        cross, own = action.cross * half, action.covariance * half.unsqueeze(-1) * half
        rows = [torch.cat([state.covariance, cross], 2), torch.cat([cross.mT, own], 2)]
        return Belief(torch.cat([state.mean, middle + half * action.mean], 1), torch.cat(rows, 1))

    def _points(self, belief: Belief) -> Float[Tensor, "P n"]:
        """Points with the belief's mean and, up to the jitter, its covariance."""
        scale = belief.covariance.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-12).view(-1, 1, 1)
        root = cholesky(belief.covariance, scale, jitter=SPREAD_JITTER)[0]
        return belief.mean + self._frame[:, : len(root)] @ root.mT


def search(policy: SquashedPolicy, path: BeliefPath, max_iterations: int) -> dict[str, float]:
    """Let the policy climb its expected return by L-BFGS.

    Parameters at which a belief is not finite count as worse than any that were seen.

    Raises:
        NotDifferentiableError: no gradient comes through the reward.
    """
    from scipy.optimize import minimize  # here, for it takes long to import

    parameters = list(policy.parameters())
    start = torch.nn.utils.parameters_to_vector(parameters).detach().cpu().numpy().copy()
    best, worst = (math.inf, start), 0.0  # of the negative returns

    def negative_return(flat: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best, worst
        _take(flat, parameters)
        found = _value_and_slope(policy, path, parameters)
        if found is None:
            return worst + 1.0, np.zeros_like(flat)
        best, worst = min(best, (found[0], flat.copy()), key=lambda seen: seen[0]), max(worst, found[0])
        return found

    with torch.enable_grad():
        found = minimize(negative_return, start, jac=True, method="L-BFGS-B", options={"maxiter": max_iterations})
    _take(best[1], parameters)  # a line search that fails ends elsewhere
    return {"imagined_return": -best[0], "search_iterations": float(found.nit)}


def _take(flat: np.ndarray, parameters: list[torch.nn.Parameter]) -> None:
    torch.nn.utils.vector_to_parameters(torch.from_numpy(flat).to(parameters[0]), parameters)


def _value_and_slope(
    policy: SquashedPolicy, path: BeliefPath, parameters: list[torch.nn.Parameter]
) -> tuple[float, np.ndarray] | None:
    """The negative expected return and its gradient; None where one of them is not finite."""
    try:
        expected = path.expected_return(policy)
    except FactorisationError:
        return None
    if not expected.requires_grad:
        raise NotDifferentiableError(
            "no gradient comes through the reward: it must follow from its arguments by differentiable operations of "
            "PyTorch"
        )
    gradients = torch.autograd.grad(-expected, parameters, materialize_grads=True, allow_unused=True)
    gradient = torch.nn.utils.parameters_to_vector(gradients)
    if not (expected.isfinite() and gradient.isfinite().all()):
        return None
    return -expected.item(), gradient.cpu().numpy()
