"""From a drawn world and a reward to the planner's objective: action sequences in, scores out.

The return of H actions from the present observation in the world of particle p is

    R[p](a) = sum_{t<H} alive[t, p] r(s[t, p], a[t], s[t+1, p]),

where a particle is alive until, and including, the step in which it terminates. The score is a measure of the returns:
their mean, the Monte Carlo estimate of the expected return, or another one of `risk.py`.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gym_dgpmpc.autograd import grad_if_asked, not_differentiable
from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.planning.risk import RiskMeasure
from gym_dgpmpc.types import Objective, RewardFn, TerminatedFn, TrajectorySampler, TransitionSampler

EXPECTED = RiskMeasure()


class Tail(NamedTuple):
    """What follows a plan's last step: the return is sum_{t<h} g^t r_t + g^h V(s_h), averaged over the last depths h.

    Attributes:
        value: V, of states, batched over any leading dimensions.
        discount: g, with which V was learned, in (0, 1].
        depths: of how many depths h = H, H - 1, ... the mean is taken; values are rough, and their errors differ.
    """

    value: Callable[[Float[Tensor, "*b S"]], Float[Tensor, "*b"]]
    discount: float
    depths: int = 1


@grad_if_asked
def rollout(
    sampler: TransitionSampler,
    observation: Float[Tensor, " S"],
    actions: Float[Tensor, "K H A"],
    num_particles: int,
) -> Float[Tensor, "H_plus_1 P K S"]:
    """The states that K action sequences lead to from one observation, for each of P particles.

    Differentiable where the observation or the actions require gradients.

    Returns:
        ``states``, of the observation's dtype and device: ``states[0]`` is the observation, ``states[t + 1]`` the
        state after action t. With the axes in this order every step writes one contiguous block.

    Raises:
        ValueError: the sampler's result has the wrong shape (it would be broadcast silently).
        NotDifferentiableError: a gradient is required, and the sampler has none.
    """
    num_candidates, horizon, _ = actions.shape
    expected = (horizon + 1, num_particles, num_candidates, *observation.shape)
    if isinstance(sampler, TrajectorySampler):
        trajectories = _recorded(sampler, sampler.trajectories(observation, actions))
        if trajectories.shape != expected:
            raise ValueError(
                f"the sampler's trajectories must have the shape [H + 1, P, K, S] = {expected}, "
                f"got {tuple(trajectories.shape)}"
            )
        return trajectories.to(observation)
    states = [observation.expand(expected[1:]).contiguous()]
    for step, action in enumerate(actions.to(observation).transpose(0, 1).contiguous()):
        next_state = _recorded(sampler, sampler(states[step], action, step))
        if next_state.shape != expected[1:]:
            raise ValueError(
                f"the transition sampler must return [P, K, S] = {expected[1:]}, got {tuple(next_state.shape)}"
            )
        states.append(next_state.to(observation).contiguous())
    return torch.stack(states)


@grad_if_asked
def particle_returns(
    states: Float[Tensor, "H_plus_1 P K S"],
    actions: Float[Tensor, "K H A"],
    reward_fn: RewardFn,
    terminated_fn: TerminatedFn | None = None,
    tail: Tail | None = None,
) -> Float[Tensor, "P K"]:
    """The return of every particle of every candidate, with the reward evaluated in one call over [H, P, K].

    The step that terminates earns its reward; whatever the model predicts after it counts for nothing. A particle
    whose state is not finite while it is alive has the return NaN, even where the reward function would hide that
    (a comparison with NaN is simply false), so that a diverged particle cannot pass for a good one.

    With a ``tail`` rewards are discounted, and what follows counts, for particles that are alive at its depths.

    Differentiable where the states require gradients; that the reward is, is up to its function. When a particle
    terminates has no gradient.

    Raises:
        ValueError: the reward or the termination has the wrong shape or dtype.
        TypeError: either is not a tensor.
    """
    observation, next_observation = states[:-1], states[1:]
    batch = next_observation.shape[:-1]
    action = actions.to(states).transpose(0, 1).unsqueeze(1).expand(*batch, -1)
    reward = reward_fn(observation, action, next_observation)
    _check_output("reward_fn", reward, batch, "floating-point")
    reward = reward.to(states.dtype)
    # As a rule one pass tells that all states are finite, as their sum is; a GPU would have to be waited for.
    if states.device.type != "cpu" or not bool(next_observation.sum().isfinite()):
        # Zero where the whole state is finite and NaN elsewhere, in two passes over the states.
        reward = reward + (next_observation * 0.0).sum(dim=-1)
    terminated = None
    if terminated_fn is not None:
        terminated = terminated_fn(next_observation)
        _check_output("terminated_fn", terminated, batch, "boolean")
        reward = reward.masked_fill(~_alive(terminated), 0.0)
    return reward.sum(dim=0) if tail is None else _with_tail(reward, next_observation, terminated, tail)


def _with_tail(
    reward: Float[Tensor, "H P K"],
    next_observation: Float[Tensor, "H P K S"],
    terminated: Bool[Tensor, "H P K"] | None,
    tail: Tail,
) -> Float[Tensor, "P K"]:
    """The discounted rewards and the value of what follows them, the mean over the last depths."""
    horizon = len(reward)
    steps = torch.arange(horizon + 1, dtype=reward.dtype, device=reward.device)
    discount = (tail.discount**steps).view(-1, 1, 1)
    so_far = (discount[:-1] * reward).cumsum(dim=0)
    depths = min(tail.depths, horizon)
    value = tail.value(next_observation[-depths:]).to(reward)
    _check_output("value", value, next_observation[-depths:].shape[:-1], "floating-point")
    if terminated is not None:
        over = terminated.to(torch.uint8).cummax(dim=0).values[-depths:].bool()
        value = value.masked_fill(over, 0.0)
    return (so_far[-depths:] + discount[-depths:] * value).mean(dim=0)


def rollout_objective(
    sampler: TransitionSampler,
    reward_fn: RewardFn,
    observation: Float[Tensor, " S"],
    num_particles: int,
    terminated_fn: TerminatedFn | None = None,
    measure: RiskMeasure = EXPECTED,
    tail: Tail | None = None,
) -> Objective:
    """The planner's objective: what ``measure`` makes of the particles' returns from ``observation``.

    It is differentiable exactly where the actions that it is given, or the observation, require gradients, and then
    has the same value as otherwise; see `rollout`.

    One particle that is not finite makes its candidate's score not finite; no measure leaves such a one out.

    Raises:
        ValueError: ``num_particles`` is not positive or ``observation`` not a floating-point vector.
    """
    check_counts(num_particles=num_particles)
    if observation.ndim != 1 or not observation.is_floating_point():
        raise ValueError(
            f"observation must be a floating-point vector, got shape {tuple(observation.shape)}, {observation.dtype}"
        )

    def score(actions: Float[Tensor, "K H A"]) -> Float[Tensor, " K"]:
        states = rollout(sampler, observation, actions, num_particles)
        return measure(particle_returns(states, actions, reward_fn, terminated_fn, tail))

    return score


def _recorded(sampler: TransitionSampler, states: Tensor) -> Tensor:
    """The states, if their gradient was recorded where it is required."""
    if torch.is_grad_enabled() and not states.requires_grad:
        raise not_differentiable(sampler)
    return states


def _alive(terminated: Bool[Tensor, "H *b"]) -> Bool[Tensor, "H *b"]:
    """Whether no *earlier* step terminated: the exclusive cumulative product of its negation over the steps."""
    survived = (~terminated).to(torch.uint8).cumprod(dim=0, dtype=torch.uint8)
    return torch.cat([torch.ones_like(survived[:1]), survived[:-1]]).bool()


def _check_output(name: str, value: object, batch: torch.Size, kind: Literal["floating-point", "boolean"]) -> None:
    """Check what a user's function returned for a batch of states."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must return a tensor, got {type(value).__name__}")
    right_kind = value.dtype == torch.bool if kind == "boolean" else value.is_floating_point()
    if value.shape != batch or not right_kind:
        raise ValueError(
            f"{name} must return a {kind} tensor of the batch shape [H, P, K] = {tuple(batch)}, "
            f"got shape {tuple(value.shape)}, {value.dtype}"
        )
