"""Wrappers that change what is planned for."""

from gym_dgpmpc.wrappers.risk_sensitive import RiskSensitiveReward

__all__ = ["RiskSensitiveReward"]
