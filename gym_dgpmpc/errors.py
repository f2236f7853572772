"""Errors by name, so that a caller can handle each kind without reading the message."""


class DGPMPCError(Exception):
    """Base class of the errors this package raises on purpose."""


class PlanningError(DGPMPCError, RuntimeError):
    """No candidate action sequence had a finite score, or a planner returned something else than a plan of its own."""


class NotDifferentiableError(DGPMPCError, TypeError):
    """A gradient was asked for of something that has none: draws of a model, or a planner's objective."""


class EnvironmentDataError(DGPMPCError, ValueError):
    """The environment returned something that cannot be learned from (for example a NaN observation)."""


class EnvironmentFailedError(DGPMPCError, RuntimeError):
    """The environment raised an exception, which is this error's cause; what it did before is kept."""


class UnknownRewardError(DGPMPCError, ValueError):
    """The environment offers no reward function and none was given."""


class CheckpointError(DGPMPCError, ValueError):
    """A file is not a checkpoint of this package, is damaged, or was made for other spaces."""


class CheckpointWriteError(DGPMPCError, OSError):
    """A checkpoint could not be written; the one before it is whole."""


class RunInUseError(DGPMPCError, RuntimeError):
    """Another process holds the run's folder."""


class FactorisationError(DGPMPCError, RuntimeError):
    """A covariance matrix could not be factorised even with the largest jitter."""


class TrainingError(DGPMPCError, RuntimeError):
    """Training diverged, and going back to the last good state with smaller steps did not help."""


class ExportError(DGPMPCError, RuntimeError):
    """A policy could not be written in the format that was asked for, or the file does not act as the policy does."""


class ReliabilityWarning(UserWarning):
    """Something was not as it should be, and was dealt with; the message says how."""
