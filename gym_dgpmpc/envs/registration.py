"""Registers this package's environments with Gymnasium, by name only, so that nothing heavy is imported."""

import gymnasium

ENVIRONMENTS: dict[str, tuple[str, int]] = {
    "ModCartPole-v0": ("gym_dgpmpc.envs.mod_cartpole:ModCartPoleEnv", 200),
    "SwingUpCartPole-v0": ("gym_dgpmpc.envs.mod_cartpole:SwingUpCartPoleEnv", 200),
    "Reacher7DoF-v0": ("gym_dgpmpc.envs.reacher7dof:Reacher7DoFEnv", 150),
    "BiasedReacher-v0": ("gym_dgpmpc.envs.reacher7dof:BiasedReacherEnv", 150),
    "VelocityHalfCheetah-v0": ("gym_dgpmpc.envs.half_cheetah:VelocityHalfCheetahEnv", 1000),
    "RiskSensitiveHalfCheetah-v0": ("gym_dgpmpc.envs.half_cheetah:make_risk_sensitive_half_cheetah", 1000),
}
"""Environment id -> (entry point, steps after which an episode is truncated)."""


def register_environments() -> None:
    """Add every environment of ``ENVIRONMENTS`` to Gymnasium's registry; those already there are left alone."""
    for env_id, (entry_point, max_episode_steps) in ENVIRONMENTS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(id=env_id, entry_point=entry_point, max_episode_steps=max_episode_steps)
