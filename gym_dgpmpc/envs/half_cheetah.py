"""The half cheetah with its velocity first, so that the reward is a function of the observation."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium import utils
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from gym_dgpmpc.envs.mujoco_task import MujocoTask, not_negative
from gym_dgpmpc.envs.simulator import SimulatorLayout
from gym_dgpmpc.types import ObservationSpec
from gym_dgpmpc.wrappers.risk_sensitive import RiskSensitiveReward

MAX_ACTION = 1.0
"""Largest magnitude of an action."""

VELOCITY, PITCH = 0, 2
"""Where the observation has the velocity and the pitch."""

CAMERA: dict[str, Any] = {
    "type": mujoco.mjtCamera.mjCAMERA_TRACKING,
    "trackbodyid": 1,
    "distance": 3.5,
    "azimuth": 90.0,
    "elevation": -8.0,
}
"""The camera of the window. Pictures are taken by the model's own camera, which follows too."""


class HalfCheetahRewardTerms(NamedTuple):
    """The two parts of the reward, which is ``velocity - control_cost``."""

    velocity: Float[Tensor, "*b"]
    control_cost: Float[Tensor, "*b"]


@dataclass(frozen=True)
class HalfCheetahReward:
    """The half cheetah's reward: its speed forwards, less a cost of the action.

    r = velocity(s') - ctrl_cost_weight * sum clip(a, -1, 1)^2.

    Batched over any leading dimensions and free of the simulator, so a planner may keep it.

    Attributes:
        ctrl_cost_weight: cost of a unit action on one joint.
    """

    ctrl_cost_weight: float = 0.1

    def terms(self, action: Float[Tensor, "*b 6"], next_observation: Float[Tensor, "*b 18"]) -> HalfCheetahRewardTerms:
        """The parts of the reward, each of the batch's shape, in the precision of ``next_observation``."""
        effort = action.to(next_observation.dtype).clamp(-MAX_ACTION, MAX_ACTION)
        return HalfCheetahRewardTerms(
            next_observation[..., VELOCITY], self.ctrl_cost_weight * effort.square().sum(dim=-1)
        )

    def __call__(
        self,
        observation: Float[Tensor, "*b 18"],
        action: Float[Tensor, "*b 6"],
        next_observation: Float[Tensor, "*b 18"],
    ) -> Float[Tensor, "*b"]:
        """The reward of each step; ``observation`` plays no part and is there for the common interface."""
        velocity, control_cost = self.terms(action, next_observation)
        return velocity - control_cost


class VelocityHalfCheetahEnv(MujocoTask, utils.EzPickle):
    """Run as fast as possible on two legs.

    ## Description
    A flat runner with a back leg and a front leg of three joints each moves in a vertical plane on a floor. Torques on
    its six joints, which springs draw back to their rest, should make it run forwards. It weighs 14 kg and is the one
    of Gymnasium's `HalfCheetah-v5`, whose reward is not a function of its observation. Here the observation begins with
    the velocity that is rewarded.

    ## Action space
    `Box(-1.0, 1.0, (6,), float32)`. Actions outside the bounds are clipped, before the dynamics and before the reward.

    | Num | Action                              | Min | Max | Joint (name in the model) | Unit            |
    |-----|-------------------------------------|-----|-----|---------------------------|-----------------|
    | 0   | Torque on the back thigh            | -1  | 1   | hinge (back_thigh)        | torque, 120 N m |
    | 1   | Torque on the back shin             | -1  | 1   | hinge (back_shin)         | torque, 90 N m  |
    | 2   | Torque on the back foot             | -1  | 1   | hinge (back_foot)         | torque, 60 N m  |
    | 3   | Torque on the front thigh           | -1  | 1   | hinge (front_thigh)       | torque, 120 N m |
    | 4   | Torque on the front shin            | -1  | 1   | hinge (front_shin)        | torque, 60 N m  |
    | 5   | Torque on the front foot            | -1  | 1   | hinge (front_foot)        | torque, 30 N m  |

    ## Observation space
    `Box(-inf, inf, (18,), float64)`. The pitch is not wrapped: it counts full turns.

    | Num | Observation                                        | Min  | Max | Joint (name in the model) | Unit  |
    |-----|----------------------------------------------------|------|-----|---------------------------|-------|
    | 0   | Velocity: way forwards in the step, by its time    | -inf | inf | slide (root_x)            | m/s   |
    | 1   | Height of the torso over that at the start         | -inf | inf | slide (root_z)            | m     |
    | 2   | Pitch of the torso; positive: nose down            | -inf | inf | hinge (root_pitch)        | rad   |
    | 3   | Angle of the back thigh                            | -inf | inf | hinge (back_thigh)        | rad   |
    | 4   | Angle of the back shin                             | -inf | inf | hinge (back_shin)         | rad   |
    | 5   | Angle of the back foot                             | -inf | inf | hinge (back_foot)         | rad   |
    | 6   | Angle of the front thigh                           | -inf | inf | hinge (front_thigh)       | rad   |
    | 7   | Angle of the front shin                            | -inf | inf | hinge (front_shin)        | rad   |
    | 8   | Angle of the front foot                            | -inf | inf | hinge (front_foot)        | rad   |
    | 9   | Velocity of the torso forwards, at the step's end  | -inf | inf | slide (root_x)            | m/s   |
    | 10  | Velocity of the torso upwards                      | -inf | inf | slide (root_z)            | m/s   |
    | 11  | Rate of the pitch                                  | -inf | inf | hinge (root_pitch)        | rad/s |
    | 12  | Rate of the back thigh                             | -inf | inf | hinge (back_thigh)        | rad/s |
    | 13  | Rate of the back shin                              | -inf | inf | hinge (back_shin)         | rad/s |
    | 14  | Rate of the back foot                              | -inf | inf | hinge (back_foot)         | rad/s |
    | 15  | Rate of the front thigh                            | -inf | inf | hinge (front_thigh)       | rad/s |
    | 16  | Rate of the front shin                             | -inf | inf | hinge (front_shin)        | rad/s |
    | 17  | Rate of the front foot                             | -inf | inf | hinge (front_foot)        | rad/s |

    The first number is 0 after a reset. For a model (`observation_spec`) the pitch is an angle; the first number is
    predicted as it is and is not an input, because it belongs to the step before.

    ## Reward
    The reward of a step is *velocity - control_cost*, evaluated on the state that the step leads to:

    - *velocity* is the first number of the observation, in m/s;
    - *control_cost* = ctrl_cost_weight * the sum of the squared actions.

    `reward_fn(observation, action, next_observation)` computes it for batches of PyTorch tensors and is what `step`
    uses; `info` holds both parts as `reward_forward` and `reward_control` (the latter is the negative cost), and the
    place of the torso along the floor, `x_position` in m.

    ## Starting state
    Standing at rest, up to noise: normal with standard deviation `reset_noise_scale` on each position, angle and rate.

    ## Episode end
    An episode never terminates; it is truncated after 1000 steps of 0.05 s.

    ## Arguments

    | Parameter           | Type                | Default      | Description                                           |
    |---------------------|---------------------|--------------|-------------------------------------------------------|
    | `ctrl_cost_weight`  | float               | `0.1`        | Weight of the squared actions                         |
    | `reset_noise_scale` | float               | `0.001`      | Standard deviation of the starting state              |
    | `frame_skip`        | int                 | `5`          | Simulator steps of 0.01 s in one environment step     |
    | `render_mode`       | str or None         | `None`       | One of `metadata["render_modes"]`, or None            |
    | `width`             | int                 | `480`        | Width of rendered images, pixels                      |
    | `height`            | int                 | `320`        | Height of rendered images, pixels                     |

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        ctrl_cost_weight: float = 0.1,
        reset_noise_scale: float = 0.001,
        frame_skip: int = 5,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 320,
    ) -> None:
        utils.EzPickle.__init__(self, ctrl_cost_weight, reset_noise_scale, frame_skip, render_mode, width, height)
        self._reset_noise_scale = not_negative("reset_noise_scale", reset_noise_scale)
        self.reward_fn = HalfCheetahReward(not_negative("ctrl_cost_weight", ctrl_cost_weight))
        """The batched reward, a `gym_dgpmpc.types.RewardFn`."""

        super().__init__(
            "half_cheetah.xml",
            18,
            frame_skip=frame_skip,
            render_mode=render_mode,
            width=width,
            height=height,
            camera=CAMERA,
            camera_name="follow",
        )

    simulator_layout = SimulatorLayout((None, *range(1, 9)), tuple(range(9, 18)), rates=((VELOCITY, 0),))
    """Where the observation holds the simulator's state. How far the cheetah ran is not in it and does not matter."""

    @property
    def observation_spec(self) -> ObservationSpec:
        """How a model should read the observation: the pitch is an angle, the first number the last step's speed."""
        return ObservationSpec(angles=(PITCH,), absolute=(VELOCITY,), not_inputs=(VELOCITY,))

    def step(  # type: ignore[override]  # a plain float as reward, as Gymnasium's Env says
        self, action: NDArray[Any]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, float]]:
        """Apply the action, shape (6,), for ``frame_skip`` simulator steps."""
        start = float(self.data.qpos[0])
        action = self.perform(action)
        end = float(self.data.qpos[0])
        observation = self._observe((end - start) / self.dt)

        terms = self.reward_fn.terms(torch.from_numpy(action), torch.from_numpy(observation))
        info = {
            "x_position": end,
            "reward_forward": float(terms.velocity),
            "reward_control": -float(terms.control_cost),
        }
        if self.render_mode == "human":
            self.render()
        return observation, float(terms.velocity - terms.control_cost), False, False, info

    def reset_model(self) -> NDArray[np.float64]:
        """Draw a starting state; see the class's description for its distribution."""
        noise = self.np_random.normal(scale=self._reset_noise_scale, size=18)
        self.set_state(self.init_qpos + noise[:9], self.init_qvel + noise[9:])
        return self._observe(0.0)

    def _observe(self, velocity: float) -> NDArray[np.float64]:
        return np.concatenate([[velocity], self.data.qpos[1:], self.data.qvel])

    def _get_reset_info(self) -> dict[str, float]:
        return {"x_position": float(self.data.qpos[0])}


def make_risk_sensitive_half_cheetah(penalise_step: bool = False, wrap: bool = False, **kwargs: Any) -> gym.Env:
    """`RiskSensitiveHalfCheetah-v0`: `VelocityHalfCheetahEnv` under `RiskSensitiveReward`, as in the paper.

    Plans use the reward less floor(|pitch| / 20 degrees); by default, `step` reports the reward without the penalty.

    Args:
        penalise_step: let `step` return the penalised reward too, for agents without a model.
        wrap: count the pitch from the nearest full turn; see `RiskSensitiveReward`.
        kwargs: of `VelocityHalfCheetahEnv`.
    """
    env = VelocityHalfCheetahEnv(**kwargs)
    return RiskSensitiveReward(env, angle_index=PITCH, penalise_step=penalise_step, wrap=wrap)


# As on a class: `gymnasium.make` reads here which other modes it can derive, such as "rgb_array_list".
make_risk_sensitive_half_cheetah.metadata = VelocityHalfCheetahEnv.metadata  # type: ignore[attr-defined]
