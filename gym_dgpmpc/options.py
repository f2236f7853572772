"""The options of `dgpmpc train` that set the agent's arguments: name, help, limit and what holds if one is not given.

They are None unless given, so that the environment's preset or the agent's own default takes effect; the text shown as
default is compared with both by a test.
"""

from enum import Enum
from typing import Annotated, Any

import typer


class KernelName(str, Enum):
    rbf = "rbf"
    matern72 = "matern72"
    matern52 = "matern52"
    matern32 = "matern32"
    matern12 = "matern12"


class DrawName(str, Enum):
    pathwise = "pathwise"
    joint = "joint"
    marginal = "marginal"


class RefreshName(str, Enum):
    step = "step"
    plan = "plan"


class SourceName(str, Enum):
    learned = "learned"


def _option(name: str, text: str, default: str, panel: str, minimum: int | None = None) -> Any:
    return typer.Option(name, help=text, show_default=default, rich_help_panel=panel, min=minimum)


def _model(name: str, text: str, default: str, minimum: int | None = 1) -> Any:
    return _option(name, text, default, "Model", minimum)


def _planner(name: str, text: str, default: str) -> Any:
    return _option(name, text, default, "Planner", 1)


def _training(name: str, text: str, default: str, minimum: int = 1) -> Any:
    return _option(name, text, default, "Training", minimum)


_DRAW = (
    "How worlds are drawn from the posterior: as functions; as values, jointly across the candidate sequences (the "
    "paper's way); or as values, independently."
)
_REFRESH = "With pathwise draws: new functions at each step of a plan, or one for the whole plan."

NumLayers = Annotated[int | None, _model("--layers", "Layers of the deep GP.", "2")]
Kernel = Annotated[KernelName | None, _model("--kernel", "Covariance function of every layer.", "matern32", None)]
NumInducing = Annotated[
    int | None, _model("--inducing", "Inducing points per layer.", "200, or the preset's for ENV_ID")
]
Draw = Annotated[DrawName | None, _model("--draw", _DRAW, "pathwise", None)]
Refresh = Annotated[RefreshName | None, _model("--refresh", _REFRESH, "step", None)]
NumFeatures = Annotated[int | None, _model("--features", "Random features of a pathwise draw.", "128")]

NumParticles = Annotated[int | None, _planner("--particles", "Worlds that a plan's return is averaged over.", "5")]
Horizon = Annotated[
    int | None, _planner("--horizon", "Environment steps that a plan looks ahead.", "30, or the preset's for ENV_ID")
]
NumCandidates = Annotated[
    int | None, _planner("--candidates", "Action sequences tried in each iteration.", "300, or the preset's for ENV_ID")
]
NumElites = Annotated[
    int | None,
    _planner("--elites", "The best of them, which the next iteration starts from.", "a tenth of the candidates"),
]
NumIterations = Annotated[
    int | None, _planner("--iterations", "Iterations of a plan, at most.", "5, or the preset's for ENV_ID")
]
ActionsPerPlan = Annotated[
    int | None, _planner("--actions-per-plan", "Actions performed of each plan.", "1, or the preset's for ENV_ID")
]

TimeBudget = Annotated[
    float | None,
    typer.Option(
        "--time-budget",
        help="Seconds that a plan may take; the best one found by then is used. Runs do not repeat exactly with it.",
        show_default="as long as it takes",
        rich_help_panel="Planner",
    ),
]

LearningStarts = Annotated[
    int | None,
    _training(
        "--random-steps",
        "Environment steps of random actions at first.",
        "those of one episode, or the preset's for ENV_ID",
    ),
]
TrainFreq = Annotated[
    int | None, _training("--train-freq", "Environment steps between two trainings.", "one at every episode's start")
]
FirstTraining = Annotated[
    int | None,
    _training("--first-training", "Iterations of the first training.", "4000, or the preset's for ENV_ID"),
]
Training = Annotated[
    int | None,
    _training(
        "--training", "Iterations of each later training, at every episode's start.", "1000, or the preset's for ENV_ID"
    ),
]
NumSamples = Annotated[
    int | None,
    _training(
        "--samples", "Posterior samples kept, from which a plan's worlds are drawn.", "100, or the preset's for ENV_ID"
    ),
]
SampleSpacing = Annotated[
    int | None, _training("--spacing", "Sampler steps between two kept samples.", "10, or the preset's for ENV_ID")
]
Resample = Annotated[
    int | None,
    _training(
        "--resample", "Sampler steps on the grown data after each control step.", "10, or the preset's for ENV_ID", 0
    ),
]

_REWARD = "Whether the model learns to predict the reward, even where it is known."
_TERMINATION = "Whether the model learns to predict an episode's end, even where it is known."

Reward = Annotated[SourceName | None, _option("--reward", _REWARD, "what is known; else learned", "Task")]
Termination = Annotated[
    SourceName | None, _option("--termination", _TERMINATION, "what is known; else learned", "Task")
]
