"""Rewards and terminations of Gymnasium's own tasks, as batched functions of observation, action, next observation.

Each computes what the environment's `step` does, up to rounding or to what its docstring says. Sizes in the shape
annotations: S observation, A action, any leading dimensions. The action is clipped only where the environment does so.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

POLE_LENGTH = 0.6
"""Length of either pole of the inverted double pendulum, in m."""


@dataclass(frozen=True)
class PendulumReward:
    """-(theta^2 + 0.1 rate^2 + 0.001 clip(a)^2), of the state *before* the step; theta in [-pi, pi], 0 upright."""

    max_torque: float

    def __call__(
        self, observation: Float[Tensor, "*b 3"], action: Float[Tensor, "*b 1"], next_observation: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step; ``next_observation`` plays no part."""
        cosine, sine, rate = observation.unbind(-1)
        torque = action[..., 0].to(observation.dtype).clamp(-self.max_torque, self.max_torque)
        return -(torch.atan2(sine, cosine).square() + 0.1 * rate.square() + 0.001 * torque.square())


@dataclass(frozen=True)
class GoalReached:
    """The mountain car's termination: position and velocity at least those of the goal."""

    position: float
    velocity: float

    def __call__(self, next_observation: Float[Tensor, "*b 2"]) -> Bool[Tensor, "*b"]:
        """Whether each state ends the episode."""
        return (next_observation[..., 0] >= self.position) & (next_observation[..., 1] >= self.velocity)


@dataclass(frozen=True)
class MountainCarReward:
    """100 on reaching the goal, less 0.1 a^2."""

    goal: GoalReached

    def __call__(
        self, observation: Float[Tensor, "*b 2"], action: Float[Tensor, "*b 1"], next_observation: Float[Tensor, "*b 2"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        arrived = self.goal(next_observation).to(next_observation.dtype)
        return 100.0 * arrived - 0.1 * action[..., 0].to(next_observation.dtype).square()


@dataclass(frozen=True)
class AngleBeyond:
    """The inverted pendulum's termination: an angle's magnitude beyond a limit, or anything that is not finite."""

    index: int
    limit: float

    def __call__(self, next_observation: Float[Tensor, "*b S"]) -> Bool[Tensor, "*b"]:
        """Whether each state ends the episode."""
        return (next_observation[..., self.index].abs() > self.limit) | ~next_observation.isfinite().all(dim=-1)


@dataclass(frozen=True)
class SurvivalReward:
    """1 for each step that does not terminate."""

    terminated_fn: AngleBeyond

    def __call__(
        self, observation: Float[Tensor, "*b S"], action: Float[Tensor, "*b A"], next_observation: Float[Tensor, "*b S"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        return (~self.terminated_fn(next_observation)).to(next_observation.dtype)


@dataclass(frozen=True)
class CentredPoleReward:
    """The inverted pendulum's reward over 1 + 10 x^2 + 40 angle^2 + 0.5 speed^2 + 0.1 rate^2, to plan with.

    It is never negative, so that no plan gains by letting the pole fall. Where the pole counts as fallen, at rest, it
    is 0.4; so it is 0.4 m from the middle of a rail that ends at 1 m.
    """

    terminated_fn: AngleBeyond

    def __call__(
        self, observation: Float[Tensor, "*b 4"], action: Float[Tensor, "*b 1"], next_observation: Float[Tensor, "*b 4"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        x, angle, speed, rate = next_observation.unbind(-1)
        alive = (~self.terminated_fn(next_observation)).to(next_observation.dtype)
        cost = 10 * x.square() + 40 * angle.square() + 0.5 * speed.square() + 0.1 * rate.square()
        return alive / (1 + cost)


def _double_pendulum_angles(observation: Float[Tensor, "*b 9"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Angles of the lower and the upper pole to the vertical, in rad.

    The observation has sine and cosine of the lower pole's angle to the vertical and of the upper pole's to the lower
    one. The angles are taken from both, so that a predicted pair that is not quite on the unit circle does not make
    the poles longer.
    """
    lower = torch.atan2(observation[..., 1], observation[..., 3])
    return lower, lower + torch.atan2(observation[..., 2], observation[..., 4])


def double_pendulum_tip(observation: Float[Tensor, "*b 9"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Place (x, height) of the upper pole's tip, in m."""
    lower, upper = _double_pendulum_angles(observation)
    x = observation[..., 0] + POLE_LENGTH * (lower.sin() + upper.sin())
    return x, POLE_LENGTH * (lower.cos() + upper.cos())


@dataclass(frozen=True)
class TipBelow:
    """The inverted double pendulum's termination: the tip at or below a height, in m."""

    height: float

    def __call__(self, next_observation: Float[Tensor, "*b 9"]) -> Bool[Tensor, "*b"]:
        """Whether each state ends the episode."""
        return double_pendulum_tip(next_observation)[1] <= self.height


@dataclass(frozen=True)
class DoublePendulumReward:
    """healthy_reward if not terminated - 0.01 x^2 - (height - 2)^2 - 0.001 rate_1^2 - 0.005 rate_2^2.

    The environment takes (x, height) from where the integrator last looked, which is not quite where the step ends:
    the difference is some 1e-5 m. It takes the rates as they are, where the observation clips them to [-10, 10] rad/s.
    """

    healthy_reward: float
    terminated_fn: TipBelow

    def __call__(
        self, observation: Float[Tensor, "*b 9"], action: Float[Tensor, "*b 1"], next_observation: Float[Tensor, "*b 9"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        x, height = double_pendulum_tip(next_observation)
        alive = (~self.terminated_fn(next_observation)).to(next_observation.dtype)
        distance = 0.01 * x.square() + (height - 2).square()
        speed = 1e-3 * next_observation[..., 6].square() + 5e-3 * next_observation[..., 7].square()
        return self.healthy_reward * alive - distance - speed


@dataclass(frozen=True)
class SteadyTipReward:
    """The double pendulum's reward less 3 x^2 + 2 speed^2 of the tip along the rail, but at least 0: to plan with.

    The tip, not the cart: a cart that is drawn to the middle by itself leaves the poles behind.
    """

    reward_fn: DoublePendulumReward

    def __call__(
        self, observation: Float[Tensor, "*b 9"], action: Float[Tensor, "*b 1"], next_observation: Float[Tensor, "*b 9"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        lower, upper = _double_pendulum_angles(next_observation)
        cart_speed, lower_rate, elbow_rate = next_observation[..., 5:8].unbind(-1)
        speed = cart_speed + POLE_LENGTH * (lower.cos() * lower_rate + upper.cos() * (lower_rate + elbow_rate))
        unsteady = 3 * double_pendulum_tip(next_observation)[0].square() + 2 * speed.square()
        return (self.reward_fn(observation, action, next_observation) - unsteady).clamp_min(0.0)


@dataclass(frozen=True)
class PlanarReacherReward:
    """-dist_weight ||fingertip - target|| - control_weight sum a^2; the observation ends with fingertip - target."""

    dist_weight: float
    control_weight: float

    def __call__(
        self,
        observation: Float[Tensor, "*b 10"],
        action: Float[Tensor, "*b 2"],
        next_observation: Float[Tensor, "*b 10"],
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        distance = next_observation[..., 8:10].norm(dim=-1)
        return -self.dist_weight * distance - self.control_weight * _effort(action, next_observation)


@dataclass(frozen=True)
class PusherReward:
    """-near_weight ||object - tips|| - dist_weight ||object - goal|| - control_weight sum a^2, all three observed."""

    near_weight: float
    dist_weight: float
    control_weight: float

    def __call__(
        self,
        observation: Float[Tensor, "*b 23"],
        action: Float[Tensor, "*b 7"],
        next_observation: Float[Tensor, "*b 23"],
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        tips, thing, goal = next_observation[..., 14:].unflatten(-1, (3, 3)).unbind(-2)
        near, far = (thing - tips).norm(dim=-1), (thing - goal).norm(dim=-1)
        cost = self.control_weight * _effort(action, next_observation)
        return -self.near_weight * near - self.dist_weight * far - cost


@dataclass(frozen=True)
class Unhealthy:
    """The hopper's and the walker's termination: height, trunk angle or any other number outside its open range.

    Attributes:
        first: where the observation has the height; the trunk's angle comes next, then the rest of the state.
        z_range: healthy heights, in m.
        angle_range: healthy angles of the trunk, in rad.
        state_range: of every number from the trunk's angle on, or None. The environment compares rates as they are,
            where the observation clips them to [-10, 10]: a range wider than that is blind beyond it.
    """

    first: int
    z_range: tuple[float, float]
    angle_range: tuple[float, float]
    state_range: tuple[float, float] | None

    def __call__(self, next_observation: Float[Tensor, "*b S"]) -> Bool[Tensor, "*b"]:
        """Whether each state is unhealthy; one that is not a number is."""
        height, angle = next_observation[..., self.first], next_observation[..., self.first + 1]
        healthy = _inside(height, self.z_range) & _inside(angle, self.angle_range)
        if self.state_range is not None:
            healthy &= _inside(next_observation[..., self.first + 1 :], self.state_range).all(dim=-1)
        return ~healthy


@dataclass(frozen=True)
class ForwardReward:
    """forward_weight (x' - x) / dt + healthy_reward if healthy - ctrl_cost_weight sum a^2; x is observed first."""

    dt: float
    forward_weight: float
    ctrl_cost_weight: float
    healthy_reward: float
    unhealthy: Unhealthy | None

    def __call__(
        self, observation: Float[Tensor, "*b S"], action: Float[Tensor, "*b A"], next_observation: Float[Tensor, "*b S"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        velocity = (next_observation[..., 0] - observation[..., 0]) / self.dt
        reward = self.forward_weight * velocity - self.ctrl_cost_weight * _effort(action, next_observation)
        if self.unhealthy is not None:
            reward = reward + self.healthy_reward * (~self.unhealthy(next_observation)).to(reward.dtype)
        return reward


@dataclass(frozen=True)
class MeanVelocityReward:
    """forward_weight (v + v') / 2 - ctrl_cost_weight sum a^2, to plan with; v is number ``index`` of the observation.

    `ForwardReward` where places are not observed: a step's mean velocity by the trapezoidal rule.
    """

    index: int
    forward_weight: float
    ctrl_cost_weight: float

    def __call__(
        self, observation: Float[Tensor, "*b S"], action: Float[Tensor, "*b A"], next_observation: Float[Tensor, "*b S"]
    ) -> Float[Tensor, "*b"]:
        """The reward of each step."""
        velocity = 0.5 * (observation[..., self.index] + next_observation[..., self.index])
        return self.forward_weight * velocity - self.ctrl_cost_weight * _effort(action, next_observation)


def _effort(action: Float[Tensor, "*b A"], like: Float[Tensor, "*b S"]) -> Float[Tensor, "*b"]:
    """Sum of the squared actions, in the precision of ``like``."""
    return action.to(like.dtype).square().sum(dim=-1)


def _inside(value: Tensor, bounds: tuple[float, float]) -> Tensor:
    return (bounds[0] < value) & (value < bounds[1])
