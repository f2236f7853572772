"""Moving-window Monte Carlo EM: SG-HMC over inducing outputs, Adam over hyperparameters, interleaved.

Works on standardised inputs and targets; `training.py` decides how long, `dynamics/deep_gp/` prepares the data
and keeps the results. The E-step is one SG-HMC step; the M-step is one Adam step on hyperparameters, inducing inputs
and noise under a sample drawn uniformly from the window of the latest SG-HMC positions (Havasi et al. 2018, algorithm
1). Now and then the last layer is drawn exactly (`last_layer.py`), which is not in the paper.
"""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.data.standardised import Data, DataSource, minibatch
from gym_dgpmpc.gp.deep_gp import DeepGP, Factorised, factorise_all, log_likelihood, propagate
from gym_dgpmpc.inference import sghmc
from gym_dgpmpc.inference.adam import adam_memory
from gym_dgpmpc.inference.last_layer import last_layer_posterior
from gym_dgpmpc.inference.sghmc import SGHMCState


@dataclass(frozen=True)
class InferenceSettings:
    """Settings of the sampler and the hyperparameter optimiser; `DeepGPDynamics` takes them as keyword arguments.

    Attributes:
        step_size: step size of SG-HMC, epsilon; twice the value of Havasi et al., see docs/deviations.md.
        decay: friction of SG-HMC, m, in [0, 1].
        learning_rate: learning rate of Adam, for hyperparameters and inducing inputs.
        hyperparameters_every: SG-HMC steps for each Adam step.
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

    step_size: float = 0.02
    decay: float = 0.05
    learning_rate: float = 0.01
    hyperparameters_every: int = 1
    window_size: int = 100
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
        for name in ("step_size", "learning_rate"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, received {getattr(self, name)}")
        if not 0.0 <= self.decay <= 1.0:
            raise ValueError(f"decay must lie in [0, 1], received {self.decay}")
        if self.gibbs_every < 0:
            raise ValueError(f"gibbs_every must be at least 0, received {self.gibbs_every}")


def negative_log_joint(
    factorised: Factorised,
    whitened: Float[Tensor, "V"],
    batch: Data,
    num_data: int,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """-log p(y, v) / N, unbiased by a minibatch: -mean log p(y | v) + |v|^2 / (2 N)."""
    model = factorised.model
    mean, variance = propagate(factorised, model.split(whitened), batch.x, generator)
    likelihood = log_likelihood(model, mean, variance, batch.y).mean()
    return -likelihood + 0.5 * whitened.square().sum() / num_data


def _gradient(
    factorised: Factorised,
    chain: SGHMCState,
    batch: Data,
    num_data: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """The negative log joint at the chain's position and its gradient there, hyperparameters held fixed."""
    position = chain.position.detach().requires_grad_()
    value = negative_log_joint(factorised, position, batch, num_data, generator)
    (gradient,) = torch.autograd.grad(value, position)
    return value.detach(), gradient


class MCEM:
    """The state of a training run, moved on by `step`: hyperparameters, chain, window and optimiser.

    Args:
        model: hyperparameters to start from; left as they are.
        chain: where to start; its preconditioner is kept.
        data: what to train on.
        settings: of sampler and optimiser.
    """

    def __init__(
        self,
        model: DeepGP,
        chain: SGHMCState,
        data: Data,
        settings: InferenceSettings,
    ):
        self.chain, self.data, self.settings = chain, data, settings
        self._parameters = [p.detach().clone().requires_grad_() for p in model.parameters()]
        self._live = model.with_parameters(self._parameters)
        self._optimiser = torch.optim.Adam(self._parameters, lr=settings.learning_rate)
        self._optimiser.state.update({parameter: adam_memory(parameter) for parameter in self._parameters})
        self._window = chain.position.new_empty(settings.window_size, chain.position.numel())
        self.iteration = 0
        self.value = chain.position.new_zeros(())
        """The last negative log joint, on a minibatch."""

    @property
    def model(self) -> DeepGP:
        """The present hyperparameters, which further steps change in place."""
        return self._live.detach()

    @property
    def window(self) -> Float[Tensor, "W V"]:
        """The latest positions, W of them at most, in no particular order; further steps change them in place."""
        return self._window[: min(self.iteration, len(self._window))]

    def evaluate(self, generator: torch.Generator) -> float:
        """The negative log joint per observation at the chain's position, on a minibatch; moves nothing."""
        batch = minibatch(self.data, self.settings.batch_size, generator)
        with torch.no_grad():
            position, num_data = self.chain.position, self.data.num_rows
            return float(negative_log_joint(factorise_all(self._live), position, batch, num_data, generator))

    def step(self, generator: torch.Generator) -> None:
        """One SG-HMC step (burn-in, preconditioner adapting), and now and then one Adam step and one exact draw.

        Raises:
            FactorisationError: with the present hyperparameters a K_zz cannot be factorised.
        """
        settings, num_data = self.settings, self.data.num_rows
        batch = minibatch(self.data, settings.batch_size, generator)
        with torch.no_grad():  # gradients do not need it: see `layer.project`
            live = factorise_all(self._live)

        # E-step: move the inducing outputs under the current hyperparameters.
        fixed = live.detach()
        self.value, gradient = _gradient(fixed, self.chain, batch, num_data, generator)
        self.chain = sghmc.step(
            self.chain, gradient, num_data, generator, step_size=settings.step_size, decay=settings.decay, burn_in=True
        )
        if settings.gibbs_every and self.iteration % settings.gibbs_every == 0:
            self.chain = gibbs_step(fixed, self.chain, self.data, generator, settings)
        self._window[self.iteration % settings.window_size] = self.chain.position
        self.iteration += 1

        # M-step: move the hyperparameters under a sample from the window.
        if self.iteration % settings.hyperparameters_every == 0:
            held = self.window
            pick = torch.randint(len(held), (1,), generator=generator, device=generator.device)
            sample = held.index_select(0, pick).squeeze(0)
            self._optimiser.zero_grad()
            negative_log_joint(live, sample, batch, num_data, generator).backward()
            self._optimiser.step()

    def snapshot(self) -> "Snapshot":
        """A copy of everything that `step` moves."""
        parameters = [p.detach().clone() for p in self._parameters]
        optimiser = copy.deepcopy(self._optimiser.state_dict())
        return Snapshot(parameters, optimiser, self.chain, self._window.clone(), self.iteration, self.value)

    def restore(self, snapshot: "Snapshot", scale: float = 1.0) -> None:
        """Go back to a snapshot, with SG-HMC's step and Adam's multiplied by ``scale``, and the chain brought to rest.

        The snapshot may be used again.
        """
        with torch.no_grad():
            for parameter, kept in zip(self._parameters, snapshot.parameters, strict=True):
                parameter.copy_(kept)
        self._optimiser.load_state_dict(copy.deepcopy(snapshot.optimiser))
        self._window.copy_(snapshot.window)
        self.chain = snapshot.chain._replace(momentum=torch.zeros_like(snapshot.chain.momentum))
        self.iteration, self.value = snapshot.iteration, snapshot.value
        self.settings = replace(
            self.settings,
            step_size=scale * self.settings.step_size,
            learning_rate=scale * self.settings.learning_rate,
        )
        for group in self._optimiser.param_groups:
            group["lr"] = self.settings.learning_rate


class Snapshot(NamedTuple):
    """See `MCEM.snapshot`."""

    parameters: list[Tensor]
    optimiser: dict[str, Any]
    chain: SGHMCState
    window: Tensor
    iteration: int
    value: Tensor


def sample(
    factorised: Factorised,
    chain: SGHMCState,
    data: DataSource,
    num_samples: int,
    spacing: int,
    generator: torch.Generator,
    settings: InferenceSettings,
) -> Iterator[SGHMCState]:
    """Run the chain with frozen hyperparameters and preconditioner; yield it every ``spacing`` steps."""
    num_data = data.num_rows
    fixed = factorised.detach()
    for _ in range(num_samples):
        for _ in range(spacing):
            batch = minibatch(data, settings.batch_size, generator)
            _, gradient = _gradient(fixed, chain, batch, num_data, generator)
            chain = sghmc.step(
                chain, gradient, num_data, generator, step_size=settings.step_size, decay=settings.decay, burn_in=False
            )
        if settings.gibbs_every:
            chain = gibbs_step(fixed, chain, data, generator, settings)
        yield chain


def gibbs_step(
    factorised: Factorised,
    chain: SGHMCState,
    data: DataSource,
    generator: torch.Generator,
    settings: InferenceSettings,
) -> SGHMCState:
    """Draw the last layer's inducing outputs exactly, given the inner layers', and bring them to rest there."""
    (position,) = gibbs_positions(factorised, chain, data, 1, generator, settings)
    at_rest = chain.momentum.clone()
    at_rest[factorised.model.num_inner() :] = 0.0
    return chain._replace(position=position, momentum=at_rest)


def gibbs_positions(
    factorised: Factorised,
    chain: SGHMCState,
    data: DataSource,
    num_samples: int,
    generator: torch.Generator,
    settings: InferenceSettings,
) -> Float[Tensor, "n V"]:
    """Positions that share the chain's inner layers, each with its own exact draw of the last layer."""
    rows = minibatch(data, settings.gibbs_rows, generator)
    weight = data.num_rows / rows.num_rows
    posterior = last_layer_posterior(factorised, chain.position, rows.x, rows.y, generator, weight)
    drawn = posterior.sample(num_samples, generator).flatten(1)
    return torch.cat([chain.position[: factorised.model.num_inner()].expand(num_samples, -1), drawn], dim=1)
