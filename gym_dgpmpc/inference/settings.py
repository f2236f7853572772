"""Settings of the sampler; `dynamics/deep_gp/` offers them to users.

`sampler.py` reads most of them, `training.py` those that say when to stop.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from gym_dgpmpc.checks import check_counts

Hyperparameters = Literal["sampled", "optimised"]
HYPERPARAMETERS: tuple[Hyperparameters, ...] = get_args(Hyperparameters)


@dataclass(frozen=True)
class InferenceSettings:
    """Settings of the sampler; `DeepGPDynamics` takes them as keyword arguments.

    Attributes:
        step_size: step size of SG-HMC for inducing outputs, epsilon, wherever that is short enough (see
            `sampler.step_sizes`); ten times the value of Havasi et al., see docs/deviations.md.
        decay: friction of SG-HMC, m, in [0, 1].
        hyperparameters: "optimised", as in the paper: one value for each chain, without a prior; or "sampled" with the
            inducing outputs, under wide priors, after a burn-in that optimises them.
        hyperparameter_step_size: step size of SG-HMC for hyperparameters and inducing inputs.
        learning_rate: learning rate of Adam, for hyperparameters and inducing inputs, at the start of the first
            training; it falls to a sixth, where later ones begin.
        hyperparameters_every: iterations for each step of the hyperparameters.
        window_size: latest SG-HMC positions, one of which is drawn for each Adam step.
        batch_size: transitions in a minibatch; all of them where there are fewer.
        gibbs_every: training iterations between two exact draws of the last layer, which each sample of the pool gets
            too; 0 leaves everything to SG-HMC.
        gibbs_rows: transitions that an exact draw is conditioned on; all of them where there are fewer.
        patience: looks in a row without a better held-out log likelihood, after which training stops early; None trains
            to the end, on all data.
        look_every: iterations between two looks at how training goes.

    Raises:
        ValueError: a setting is out of its range.
    """

    step_size: float = 0.1
    decay: float = 0.05
    hyperparameters: Hyperparameters = "optimised"
    hyperparameter_step_size: float = 0.02
    learning_rate: float = 0.1
    hyperparameters_every: int = 1
    window_size: int = 1
    batch_size: int = 256
    gibbs_every: int = 20
    gibbs_rows: int = 4096
    patience: int | None = None
    look_every: int = 100

    def __post_init__(self) -> None:
        names = ("hyperparameters_every", "window_size", "batch_size", "gibbs_rows", "look_every")
        check_counts(**{name: getattr(self, name) for name in names})
        if self.patience is not None:
            check_counts(patience=self.patience)
        for name in ("step_size", "hyperparameter_step_size", "learning_rate"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, received {getattr(self, name)}")
        if not 0.0 <= self.decay <= 1.0:
            raise ValueError(f"decay must lie in [0, 1], received {self.decay}")
        if self.gibbs_every < 0:
            raise ValueError(f"gibbs_every must be at least 0, received {self.gibbs_every}")
        if self.hyperparameters not in HYPERPARAMETERS:
            raise ValueError(
                f"unknown hyperparameters {self.hyperparameters!r}: expected one of {', '.join(HYPERPARAMETERS)}"
            )
