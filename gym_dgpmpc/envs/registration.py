"""The package's environments in one table: it registers them with Gymnasium and makes their classes public.

Nothing heavy is imported here. Environments are registered by the name of what makes them, and their classes are
imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:  # for type checkers and editors, which cannot read the tables below
    from gym_dgpmpc.envs.half_cheetah import HalfCheetahReward as HalfCheetahReward
    from gym_dgpmpc.envs.half_cheetah import VelocityHalfCheetahEnv as VelocityHalfCheetahEnv
    from gym_dgpmpc.envs.mod_cartpole import CartPoleReward as CartPoleReward
    from gym_dgpmpc.envs.mod_cartpole import ModCartPoleEnv as ModCartPoleEnv
    from gym_dgpmpc.envs.mod_cartpole import SwingUpCartPoleEnv as SwingUpCartPoleEnv
    from gym_dgpmpc.envs.reacher7dof import BiasedReacherEnv as BiasedReacherEnv
    from gym_dgpmpc.envs.reacher7dof import Reacher7DoFEnv as Reacher7DoFEnv
    from gym_dgpmpc.envs.reacher7dof import ReacherReward as ReacherReward

ENVIRONMENTS: dict[str, tuple[str, int]] = {
    "ModCartPole-v0": ("gym_dgpmpc.envs.mod_cartpole:ModCartPoleEnv", 200),
    "SwingUpCartPole-v0": ("gym_dgpmpc.envs.mod_cartpole:SwingUpCartPoleEnv", 200),
    "Reacher7DoF-v0": ("gym_dgpmpc.envs.reacher7dof:Reacher7DoFEnv", 150),
    "BiasedReacher-v0": ("gym_dgpmpc.envs.reacher7dof:BiasedReacherEnv", 150),
    "VelocityHalfCheetah-v0": ("gym_dgpmpc.envs.half_cheetah:VelocityHalfCheetahEnv", 1000),
    "RiskSensitiveHalfCheetah-v0": ("gym_dgpmpc.envs.half_cheetah:make_risk_sensitive_half_cheetah", 1000),
}
"""Environment id -> (entry point, steps after which an episode is truncated). A new environment is one more entry; the
public names of `gym_dgpmpc` and `gym_dgpmpc.envs`, and the tasks of the benchmarks, are made from these."""

REWARDS = {
    "CartPoleReward": "gym_dgpmpc.envs.mod_cartpole",
    "HalfCheetahReward": "gym_dgpmpc.envs.half_cheetah",
    "ReacherReward": "gym_dgpmpc.envs.reacher7dof",
}
"""Rewards that `gym_dgpmpc.envs` makes public too, with their modules."""

CLASSES = {
    name: module
    for module, _, name in (entry_point.partition(":") for entry_point, _ in ENVIRONMENTS.values())
    if name.endswith("Env")  # and not a function that makes one
}
"""The environments' classes, with their modules."""


def register_environments() -> None:
    """Add every environment of ``ENVIRONMENTS`` to Gymnasium's registry; those already there are left alone."""
    for env_id, (entry_point, max_episode_steps) in ENVIRONMENTS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(id=env_id, entry_point=entry_point, max_episode_steps=max_episode_steps)


def import_public(package: str, module_of: dict[str, str], name: str) -> Any:
    """The object of a public name, imported now: what `__getattr__` of a package returns.

    Raises:
        AttributeError: the package has no public name of this kind.
    """
    if name not in module_of:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    return getattr(import_module(module_of[name]), name)
