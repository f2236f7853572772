"""Gymnasium-Robotics' goal environments: importing this module registers them, in a form that works.

    gymnasium.make("gym_dgpmpc.envs.robotics:FetchReachDense-v4")

imports it by itself. Needs the extra ``robotics``.
"""

from types import SimpleNamespace
from typing import Any

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np


class IntegerJointTypes:
    """The module `mujoco` with the types of joints as integers instead of members of an enumeration."""

    mjtJoint = SimpleNamespace(
        **{
            name: int(getattr(mujoco.mjtJoint, name))
            for name in ("mjJNT_FREE", "mjJNT_BALL", "mjJNT_SLIDE", "mjJNT_HINGE")
        }
    )

    def __getattr__(self, name: str) -> Any:
        return getattr(mujoco, name)


def is_broken(utilities: Any) -> bool:
    """Whether a module compares joint types with an enumeration in which MuJoCo's numbers are not found.

    Before version 3.12 of MuJoCo they were; since then `np.int32(3) in (mjJNT_HINGE, mjJNT_SLIDE)` is false, so that
    Gymnasium-Robotics 1.4.2 does not recognise hinges and fails to make a Fetch or Hand environment.
    """
    joint = utilities.mujoco.mjtJoint
    return np.int32(int(joint.mjJNT_HINGE)) not in (joint.mjJNT_HINGE, joint.mjJNT_SLIDE)


def use_integer_joint_types(utilities: Any) -> bool:
    """Let a module of Gymnasium-Robotics compare joint types as integers, if it must; returns whether it had to."""
    if not is_broken(utilities):
        return False
    utilities.mujoco = IntegerJointTypes()
    return True


def _register() -> None:
    from gymnasium_robotics.utils import mujoco_utils

    gymnasium.register_envs(gymnasium_robotics)
    use_integer_joint_types(mujoco_utils)


_register()
