"""An arm of seven joints that reaches for a target: the task with PETS's targets, and with those of the paper."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import utils
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from gym_dgpmpc.envs.mujoco_task import MujocoTask, not_negative, point, whole
from gym_dgpmpc.envs.simulator import SimulatorLayout
from gym_dgpmpc.types import ObservationSpec

MAX_ACTION = 20.0
"""Largest magnitude of a torque, in N m."""

BASE = (0.0, -0.188, 0.0)
"""Where the first joint is, in m."""

CHAIN = ((2, 0.1), (1, 0.0), (0, 0.4), (1, 0.0), (0, 0.321), (1, 0.16828))
"""The joints from the base on: axis of rotation (0, 1, 2 for x, y, z), and the way along x to the next one, in m.

The last way leads to the fingertip. The seventh joint turns the hand about the line to it and does not move it.
"""

CAMERA: dict[str, Any] = {"lookat": np.array([0.35, 0.0, 0.0]), "distance": 2.6, "azimuth": 90.0, "elevation": -35.0}

THREE = "three finite numbers, x, y and z in m"


def fingertip(joint_angles: Float[Tensor, "*b 7"]) -> Float[Tensor, "*b 3"]:
    """Place of the fingertip, the middle between the two fingers' last links, in m; batched.

    tip = base + R_z(q_1) (l_1 + R_y(q_2) R_x(q_3) (l_2 + R_y(q_4) R_x(q_5) (l_3 + R_y(q_6) l_4))), each l along x.
    """
    tip = [torch.zeros_like(joint_angles[..., 0])] * 3
    for (axis, length), angle in reversed(tuple(zip(CHAIN, joint_angles.unbind(-1), strict=False))):
        tip[0] = tip[0] + length
        first, second = (axis + 1) % 3, (axis + 2) % 3
        cosine, sine = angle.cos(), angle.sin()
        tip[first], tip[second] = tip[first] * cosine - tip[second] * sine, tip[first] * sine + tip[second] * cosine
    return torch.stack([coordinate + base for coordinate, base in zip(tip, BASE, strict=True)], dim=-1)


class ReacherRewardTerms(NamedTuple):
    """The two parts of the reward, which is ``-(squared_distance + control_cost)``."""

    squared_distance: Float[Tensor, "*b"]
    control_cost: Float[Tensor, "*b"]


@dataclass(frozen=True)
class ReacherReward:
    """The reacher's reward: closeness of the fingertip to the target, less a cost of the action.

    r = -(||tip(q') - target||^2 + ctrl_cost_weight * sum clip(a, -20, 20)^2), the target being part of s'.

    Batched over any leading dimensions and free of the simulator, so a planner may keep it.

    Attributes:
        ctrl_cost_weight: cost of a unit torque on one joint.
    """

    ctrl_cost_weight: float = 0.01

    def terms(self, action: Float[Tensor, "*b 7"], next_observation: Float[Tensor, "*b 17"]) -> ReacherRewardTerms:
        """The parts of the reward, each of the batch's shape, in the precision of ``next_observation``."""
        offset = fingertip(next_observation[..., :7]) - next_observation[..., 7:10]
        effort = action.to(next_observation.dtype).clamp(-MAX_ACTION, MAX_ACTION)
        return ReacherRewardTerms(offset.square().sum(-1), self.ctrl_cost_weight * effort.square().sum(-1))

    def __call__(
        self,
        observation: Float[Tensor, "*b 17"],
        action: Float[Tensor, "*b 7"],
        next_observation: Float[Tensor, "*b 17"],
    ) -> Float[Tensor, "*b"]:
        """The reward of each step; ``observation`` plays no part and is there for the common interface."""
        squared_distance, control_cost = self.terms(action, next_observation)
        return -(squared_distance + control_cost)


class Reacher7DoFEnv(MujocoTask, utils.EzPickle):
    """Bring the tip of an arm with seven joints to a target.

    ## Description
    An arm of 46.2 kg, of the proportions of a human one, hangs on a column in a world without gravity. Torques on its
    seven joints should bring the tip of its hand to a target and keep it there. The target is a point that the arm
    does not touch; it stays where it is for an episode. Nothing collides with anything.

    Five of the joints have a limited range, a stiff spring with damping at either end; the rolls of forearm and wrist
    turn freely and count full turns. The axes of the joints are, from the base on, z, y, x, y, x, y and x.

    ## Action space
    `Box(-20.0, 20.0, (7,), float32)`. Actions outside the bounds are clipped, before the dynamics and before the
    reward.

    | Num | Action                              | Min | Max | Joint (name in the model) | Unit         |
    |-----|-------------------------------------|-----|-----|---------------------------|--------------|
    | 0   | Torque that pans the shoulder       | -20 | 20  | hinge (shoulder_pan)      | torque, N m  |
    | 1   | Torque that lifts the shoulder      | -20 | 20  | hinge (shoulder_lift)     | torque, N m  |
    | 2   | Torque that rolls the upper arm     | -20 | 20  | hinge (upper_arm_roll)    | torque, N m  |
    | 3   | Torque that bends the elbow         | -20 | 20  | hinge (elbow_flex)        | torque, N m  |
    | 4   | Torque that rolls the forearm       | -20 | 20  | hinge (forearm_roll)      | torque, N m  |
    | 5   | Torque that bends the wrist         | -20 | 20  | hinge (wrist_flex)        | torque, N m  |
    | 6   | Torque that rolls the wrist         | -20 | 20  | hinge (wrist_roll)        | torque, N m  |

    ## Observation space
    `Box(-inf, inf, (17,), float64)`. The angles of the rolls of forearm and wrist are not wrapped.

    | Num | Observation                         | Min  | Max | Joint (name in the model) | Range              | Unit  |
    |-----|-------------------------------------|------|-----|---------------------------|--------------------|-------|
    | 0   | Angle of the shoulder's pan         | -inf | inf | hinge (shoulder_pan)      | -2.2854 to 1.7146  | rad   |
    | 1   | Angle of the shoulder's lift        | -inf | inf | hinge (shoulder_lift)     | -0.5236 to 1.3963  | rad   |
    | 2   | Angle of the upper arm's roll       | -inf | inf | hinge (upper_arm_roll)    | -3.9 to 0.8        | rad   |
    | 3   | Angle of the elbow                  | -inf | inf | hinge (elbow_flex)        | -2.3213 to 0       | rad   |
    | 4   | Angle of the forearm's roll         | -inf | inf | hinge (forearm_roll)      | free               | rad   |
    | 5   | Angle of the wrist                  | -inf | inf | hinge (wrist_flex)        | -2.094 to 0        | rad   |
    | 6   | Angle of the wrist's roll           | -inf | inf | hinge (wrist_roll)        | free               | rad   |
    | 7   | Target x                            | -inf | inf | none                      | fixed              | m     |
    | 8   | Target y                            | -inf | inf | none                      | fixed              | m     |
    | 9   | Target z                            | -inf | inf | none                      | fixed              | m     |
    | 10  | Rate of the shoulder's pan          | -inf | inf | hinge (shoulder_pan)      |                    | rad/s |
    | 11  | Rate of the shoulder's lift         | -inf | inf | hinge (shoulder_lift)     |                    | rad/s |
    | 12  | Rate of the upper arm's roll        | -inf | inf | hinge (upper_arm_roll)    |                    | rad/s |
    | 13  | Rate of the elbow                   | -inf | inf | hinge (elbow_flex)        |                    | rad/s |
    | 14  | Rate of the forearm's roll          | -inf | inf | hinge (forearm_roll)      |                    | rad/s |
    | 15  | Rate of the wrist                   | -inf | inf | hinge (wrist_flex)        |                    | rad/s |
    | 16  | Rate of the wrist's roll            | -inf | inf | hinge (wrist_roll)        |                    | rad/s |

    The ends of a joint's range are soft. For a model (`observation_spec`) the free rolls are angles, and the target is
    constant and not an input, because the arm does not feel it.

    ## Reward
    The reward of a step is *-(squared_distance + control_cost)*, evaluated on the state that the step leads to:

    - *squared_distance* = ||tip - target||^2, in m^2, where `fingertip` computes the tip from the joints' angles;
    - *control_cost* = ctrl_cost_weight * the sum of the squared torques.

    `reward_fn(observation, action, next_observation)` computes it for batches of PyTorch tensors and is what `step`
    uses; `info` holds both parts, negative, as `reward_distance` and `reward_control`, and `distance_to_target` in m.

    ## Starting state
    The arm is stretched along x and at rest: all angles and rates are 0, the tip is at (0.98928, -0.188, 0). The
    target is drawn from a normal distribution with mean `target_mean` and standard deviation `target_std`.

    With `target_seed=None` targets come from the environment's own random numbers, which `reset(seed=...)` seeds. With
    a number they form a sequence of their own: the target of episode k depends on `target_seed` and k alone, so that
    every agent, whatever its own seed, meets the same targets in the same order. Episodes count from 0. A seeded reset
    begins the sequence again; a reset after at least one step goes on to the next episode; a reset before the first
    step repeats it, so that it does not matter how often an agent resets at its start. `reset(options={"episode": k})`
    begins episode k, also where a seed is given: so an interrupted run goes on where it was. The copies in a vector
    environment have a sequence each, all the same one; give them a `target_seed` each if they should differ. To seed
    every reset and still meet different targets, use `target_seed=None` or the option. Without a `target_seed` the
    option has no effect.

    ## Episode end
    An episode never terminates; it is truncated after 150 steps of 0.02 s.

    ## Arguments

    | Parameter           | Type                | Default           | Description                                     |
    |---------------------|---------------------|-------------------|-------------------------------------------------|
    | `target_mean`       | three floats        | `(0.0, 0.25, 0.0)`| Mean of the target's distribution, m            |
    | `target_std`        | three floats        | `(0.1, 0.1, 0.1)` | Its standard deviation in each coordinate, m    |
    | `target_seed`       | int or None         | `None`            | Seed of a sequence of targets, see above        |
    | `ctrl_cost_weight`  | float               | `0.01`            | Weight of the squared torques                   |
    | `frame_skip`        | int                 | `2`               | Simulator steps of 0.01 s in an environment step|
    | `render_mode`       | str or None         | `None`            | One of `metadata["render_modes"]`, or None      |
    | `width`             | int                 | `480`             | Width of rendered images, pixels                |
    | `height`            | int                 | `480`             | Height of rendered images, pixels               |

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        target_mean: Sequence[float] | NDArray[Any] = (0.0, 0.25, 0.0),
        target_std: Sequence[float] | NDArray[Any] = (0.1, 0.1, 0.1),
        target_seed: int | None = None,
        ctrl_cost_weight: float = 0.01,
        frame_skip: int = 2,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
    ) -> None:
        utils.EzPickle.__init__(
            self, target_mean, target_std, target_seed, ctrl_cost_weight, frame_skip, render_mode, width, height
        )
        self._target_mean = point("target_mean", target_mean, THREE, 3)
        self._target_std = point("target_std", target_std, THREE, 3)
        for std in self._target_std:
            not_negative("target_std", std)
        self._target_seed = None if target_seed is None else whole("target_seed", target_seed, least=0)
        self._episode, self._has_stepped = 0, False
        self.reward_fn = ReacherReward(not_negative("ctrl_cost_weight", ctrl_cost_weight))
        """The batched reward, a `gym_dgpmpc.types.RewardFn`."""

        super().__init__(
            "reacher7dof.xml",
            17,
            frame_skip=frame_skip,
            render_mode=render_mode,
            width=width,
            height=height,
            camera=CAMERA,
        )

    simulator_layout = SimulatorLayout(tuple(range(7)), tuple(range(10, 17)))
    """Where the observation holds the simulator's state."""

    @property
    def observation_spec(self) -> ObservationSpec:
        """How a model should read the observation: free rolls are angles, the target is fixed and not felt."""
        return ObservationSpec(angles=(4, 6), not_inputs=(7, 8, 9), constant=(7, 8, 9))

    def step(  # type: ignore[override]  # a plain float as reward, as Gymnasium's Env says
        self, action: NDArray[Any]
    ) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, float]]:
        """Apply the torques, shape (7,) in N m, for ``frame_skip`` simulator steps."""
        action = self.perform(action)
        self._has_stepped = True
        observation = self._get_obs()

        terms = self.reward_fn.terms(torch.from_numpy(action), torch.from_numpy(observation))
        info = {
            "distance_to_target": float(terms.squared_distance.sqrt()),
            "reward_distance": -float(terms.squared_distance),
            "reward_control": -float(terms.control_cost),
        }
        if self.render_mode == "human":
            self.render()
        return observation, -float(terms.squared_distance + terms.control_cost), False, False, info

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, float]]:
        """Begin an episode; ``options={"episode": k}`` begins number k of the sequence of targets."""
        number = (options or {}).get("episode")
        if number is not None:
            self._episode = whole('options["episode"]', number, least=0)
        elif seed is not None:
            self._episode = 0
        elif self._has_stepped:
            self._episode += 1
        self._has_stepped = False
        return super().reset(seed=seed, options=options)

    def options_to_reset(self, again: bool) -> dict[str, int]:
        """The options with which `reset` begins the present episode again, or the one that would come next."""
        return {"episode": self._episode if again else self._episode + self._has_stepped}

    def reset_model(self) -> NDArray[np.float64]:
        """Stretch the arm and draw a target; see the class's description for its distribution."""
        generator = self.np_random
        if self._target_seed is not None:
            generator = np.random.default_rng([self._target_seed, self._episode])
        self.data.mocap_pos[0] = generator.normal(self._target_mean, self._target_std)
        self.set_state(np.zeros(7), np.zeros(7))
        return self._get_obs()

    def _get_obs(self) -> NDArray[np.float64]:
        return np.concatenate([self.data.qpos, self.data.mocap_pos[0], self.data.qvel])

    def _get_reset_info(self) -> dict[str, float]:
        action = torch.zeros(7, dtype=torch.float32, device="cpu")
        terms = self.reward_fn.terms(action, torch.from_numpy(self._get_obs()))
        return {"distance_to_target": float(terms.squared_distance.sqrt())}


class BiasedReacherEnv(Reacher7DoFEnv):
    """Bring the tip of an arm with seven joints to the targets of the paper.

    The arm of `Reacher7DoF-v0`, with the same spaces, dynamics, reward and arguments. The targets are those of Gadd
    et al. (2020), whose distribution has another mean, nearer to the arm's tip, and another spread, and which are the
    same for every agent and run: see `Reacher7DoF-v0` on `target_seed`.

    ## Arguments
    Those of `Reacher7DoF-v0`, with these defaults instead:

    | Parameter           | Type                | Default             | Description                                   |
    |---------------------|---------------------|---------------------|-----------------------------------------------|
    | `target_mean`       | three floats        | `(0.35, 0.05, 0.0)` | Mean of the target's distribution, m          |
    | `target_std`        | three floats        | `(0.05, 0.05, 0.1)` | Its standard deviation in each coordinate, m  |
    | `target_seed`       | int or None         | `0`                 | Seed of a sequence of targets                 |

    ## Version history
    * v0: first version.
    """

    def __init__(
        self,
        target_mean: Sequence[float] | NDArray[Any] = (0.35, 0.05, 0.0),
        target_std: Sequence[float] | NDArray[Any] = (0.05, 0.05, 0.1),
        target_seed: int | None = 0,
        **kwargs: Any,
    ) -> None:
        super().__init__(target_mean, target_std, target_seed, **kwargs)
        utils.EzPickle.__init__(self, target_mean, target_std, target_seed, **kwargs)
