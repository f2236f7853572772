"""The cart-pole with continuous force: the modified task beside the rail's end, and the plain swing-up."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import utils
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from gym_dgpmpc.envs.mujoco_task import MujocoTask, finite, not_negative, point
from gym_dgpmpc.types import ObservationSpec

POLE_LENGTH = 0.6
"""Distance from the hinge to the pole's tip, in m."""

RAIL_LIMIT = 2.5
"""Largest distance of the cart's centre from the middle of the rail, in m; the limit is soft."""

MAX_ACTION = 3.0
"""Largest magnitude of an action; one unit is 100 N."""

CAMERA: dict[str, Any] = {"lookat": np.zeros(3), "distance": 6.3, "azimuth": 90.0, "elevation": -6.0}


class CartPoleRewardTerms(NamedTuple):
    """The two parts of the reward, which is ``closeness - control_cost``."""

    closeness: Float[Tensor, "*b"]
    control_cost: Float[Tensor, "*b"]


@dataclass(frozen=True)
class CartPoleReward:
    """The cart-pole's reward: nearness of the pole's tip to a target, less a cost of the action.

    r = exp(-||tip(s') - target||^2 / scale^2) - ctrl_cost_weight * clip(a, -3, 3)^2,
    tip(s) = (x - 0.6 sin(theta), -0.6 cos(theta)).

    Batched over any leading dimensions and free of the simulator, so a planner may keep it.

    Attributes:
        target: where the tip should be, (x, z) in m.
        scale: distance from the target at which the first term has fallen to 1/e, in m.
        ctrl_cost_weight: cost of a unit action.
    """

    target: tuple[float, float]
    scale: float = 0.6
    ctrl_cost_weight: float = 0.01

    def terms(self, action: Float[Tensor, "*b 1"], next_observation: Float[Tensor, "*b 4"]) -> CartPoleRewardTerms:
        """The parts of the reward, each of the batch's shape, in the precision of ``next_observation``."""
        position, angle = next_observation[..., 0], next_observation[..., 1]
        offset_x = position - POLE_LENGTH * angle.sin() - self.target[0]
        offset_z = -POLE_LENGTH * angle.cos() - self.target[1]
        closeness = torch.exp(-(offset_x.square() + offset_z.square()) / self.scale**2)
        effort = action[..., 0].to(next_observation.dtype).clamp(-MAX_ACTION, MAX_ACTION)
        return CartPoleRewardTerms(closeness, self.ctrl_cost_weight * effort.square())

    def __call__(
        self,
        observation: Float[Tensor, "*b 4"],
        action: Float[Tensor, "*b 1"],
        next_observation: Float[Tensor, "*b 4"],
    ) -> Float[Tensor, "*b"]:
        """The reward of each step; ``observation`` plays no part and is there for the common interface."""
        closeness, control_cost = self.terms(action, next_observation)
        return closeness - control_cost


class ModCartPoleEnv(MujocoTask, utils.EzPickle):
    """Swing a pole up beside the end of its rail.

    ## Description
    A cart slides on a rail, pushed by a horizontal force; a pole hangs from it on a hinge that turns freely. The pole
    should be swung up so that its tip stays at a target. Here the cart starts at the right end of the rail and the
    target is near that end, so a positive force drives the cart into the end at once while a negative one moves it
    freely: the dynamics change abruptly just where the task begins. `SwingUpCartPole-v0` is the same task with start
    and target at the middle of the rail.

    The cart weighs 10.472 kg and the pole 5.019 kg. The cart's slide has a viscous friction of 1 N s/m and the hinge
    one of 1 N m s/rad. The end of the rail is a stiff, damped spring: at the full force of 300 N from the middle of
    the rail the cart's centre reaches 2.65 m.

    ## Action space
    `Box(-3.0, 3.0, (1,), float32)`. Actions outside the bounds are clipped, before the dynamics and before the reward.

    | Num | Action                                 | Min | Max | Joint (name in the model) | Unit         |
    |-----|----------------------------------------|-----|-----|---------------------------|--------------|
    | 0   | Force on the cart along the rail (+x)  | -3  | 3   | slide (slider)            | force, 100 N |

    ## Observation space
    `Box(-inf, inf, (4,), float64)`. The angle is not wrapped: it counts full turns.

    | Num | Observation                                           | Min  | Max | Joint (name in the model) | Unit  |
    |-----|-------------------------------------------------------|------|-----|---------------------------|-------|
    | 0   | Position x of the cart's centre along the rail        | -inf | inf | slide (slider)            | m     |
    | 1   | Angle theta of the pole; 0 hangs down, pi stands up   | -inf | inf | hinge (hinge)             | rad   |
    | 2   | Velocity of the cart                                  | -inf | inf | slide (slider)            | m/s   |
    | 3   | Angular velocity of the pole                          | -inf | inf | hinge (hinge)             | rad/s |

    The soft limit of the rail keeps the position between about -2.8 and 2.8.

    ## Reward
    The reward of a step is *closeness - control_cost*, evaluated on the state that the step leads to:

    - *closeness* = exp(-((tip_x - target_x)^2 + (tip_z - target_z)^2) / reward_scale^2), where the tip of the pole is
      at tip_x = x - 0.6 sin(theta), tip_z = -0.6 cos(theta);
    - *control_cost* = ctrl_cost_weight * action^2.

    It lies between -0.09 and 1. `reward_fn(observation, action, next_observation)` computes it for batches of PyTorch
    tensors and is what `step` uses; `info` holds both parts as `reward_closeness` and `reward_control` (the latter
    is the negative cost), and `distance_to_target`, the distance of the tip from the target in m.

    ## Starting state
    All four numbers are drawn from normal distributions with standard deviation `reset_noise_scale`: the position
    around `start_position`, clipped to the rail's limits of -2.5 and 2.5, the others around 0.

    ## Episode end
    An episode never terminates; it is truncated after 200 steps of 0.04 s.

    ## Arguments

    | Parameter           | Type                | Default      | Description                                           |
    |---------------------|---------------------|--------------|-------------------------------------------------------|
    | `start_position`    | float               | `2.4`        | Mean start position of the cart, m, in [-2.5, 2.5]    |
    | `target`            | two floats          | `(2.0, 0.6)` | Target (x, z) of the pole's tip, m                    |
    | `reset_noise_scale` | float               | `0.1`        | Standard deviation of the starting state              |
    | `reward_scale`      | float               | `0.6`        | Distance at which *closeness* is 1/e, m               |
    | `ctrl_cost_weight`  | float               | `0.01`       | Weight of the squared action                          |
    | `frame_skip`        | int                 | `2`          | Simulator steps of 0.02 s in one environment step     |
    | `render_mode`       | str or None         | `None`       | One of `metadata["render_modes"]`, or None            |
    | `width`             | int                 | `720`        | Width of rendered images, pixels                      |
    | `height`            | int                 | `240`        | Height of rendered images, pixels                     |

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        start_position: float = 2.4,
        target: Sequence[float] | NDArray[Any] = (2.0, 0.6),
        reset_noise_scale: float = 0.1,
        reward_scale: float = 0.6,
        ctrl_cost_weight: float = 0.01,
        frame_skip: int = 2,
        render_mode: str | None = None,
        width: int = 720,
        height: int = 240,
    ) -> None:
        utils.EzPickle.__init__(
            self,
            start_position,
            target,
            reset_noise_scale,
            reward_scale,
            ctrl_cost_weight,
            frame_skip,
            render_mode,
            width,
            height,
        )
        self._start_position = finite("start_position", start_position)
        if abs(self._start_position) > RAIL_LIMIT:
            raise ValueError(f"start_position must lie on the rail, in [-2.5, 2.5]; got {start_position!r}")
        self._reset_noise_scale = not_negative("reset_noise_scale", reset_noise_scale)
        if finite("reward_scale", reward_scale) <= 0:
            raise ValueError(f"reward_scale must be positive; got {reward_scale!r}")
        x, z = point("target", target, "two finite numbers, x and z in m", 2)
        self.reward_fn = CartPoleReward((x, z), float(reward_scale), not_negative("ctrl_cost_weight", ctrl_cost_weight))
        """The batched reward, a `gym_dgpmpc.types.RewardFn`."""

        super().__init__(
            "cartpole.xml",
            4,
            frame_skip=frame_skip,
            render_mode=render_mode,
            width=width,
            height=height,
            camera=CAMERA,
        )
        target_x, target_z = self.reward_fn.target
        self.model.site("target").pos[:] = target_x, 0.0, target_z

    @property
    def observation_spec(self) -> ObservationSpec:
        """How a model should read the observation: its second number is an angle."""
        return ObservationSpec(angles=(1,))

    def step(  # type: ignore[override]  # a plain float as reward, as Gymnasium's Env says
        self, action: NDArray[Any]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, float]]:
        """Apply the action, shape (1,) in units of 100 N, for ``frame_skip`` simulator steps."""
        action = self.perform(action)
        observation = self._get_obs()

        terms = self.reward_fn.terms(torch.from_numpy(action), torch.from_numpy(observation))
        info = {
            "distance_to_target": self._distance_to_target(observation),
            "reward_closeness": float(terms.closeness),
            "reward_control": -float(terms.control_cost),
        }
        if self.render_mode == "human":
            self.render()
        return observation, float(terms.closeness - terms.control_cost), False, False, info

    def reset_model(self) -> NDArray[np.float64]:
        """Draw a starting state; see the class's description for its distribution."""
        noise = self.np_random.normal(scale=self._reset_noise_scale, size=4)
        position = np.clip(self._start_position + noise[0], -RAIL_LIMIT, RAIL_LIMIT)
        self.set_state(np.array([position, noise[1]]), noise[2:])
        return self._get_obs()

    def _get_obs(self) -> NDArray[np.float64]:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def _get_reset_info(self) -> dict[str, float]:
        return {"distance_to_target": self._distance_to_target(self._get_obs())}

    def _distance_to_target(self, observation: NDArray[np.float64]) -> float:
        position, angle = float(observation[0]), float(observation[1])
        target_x, target_z = self.reward_fn.target
        return math.hypot(
            position - POLE_LENGTH * math.sin(angle) - target_x, -POLE_LENGTH * math.cos(angle) - target_z
        )


class SwingUpCartPoleEnv(ModCartPoleEnv):
    """Swing a pole up at the middle of its rail.

    The cart-pole of `ModCartPole-v0`, with the same spaces, dynamics, reward and arguments; the cart starts at the
    middle of the rail and the target is above it, far from the rail's ends.

    ## Arguments
    Those of `ModCartPole-v0`, with these defaults instead:

    | Parameter           | Type                | Default      | Description                                           |
    |---------------------|---------------------|--------------|-------------------------------------------------------|
    | `start_position`    | float               | `0.0`        | Mean start position of the cart, m, in [-2.5, 2.5]    |
    | `target`            | two floats          | `(0.0, 0.6)` | Target (x, z) of the pole's tip, m                    |

    ## Version history
    * v0: first version.
    """

    def __init__(
        self, start_position: float = 0.0, target: Sequence[float] | NDArray[Any] = (0.0, 0.6), **kwargs: Any
    ) -> None:
        super().__init__(start_position, target, **kwargs)
        utils.EzPickle.__init__(self, start_position, target, **kwargs)
