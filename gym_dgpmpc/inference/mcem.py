"""Moving-window Monte Carlo EM: SG-HMC over inducing outputs, Adam over hyperparameters, interleaved.

Works on one batch of standardised inputs and targets; `training.py` decides how long, `dynamics/deep_gp/` prepares the
data and keeps the results. The E-step is one SG-HMC step; the M-step is one Adam step on the hyperparameters,
inducing inputs and noise under a sample drawn uniformly from the window of the latest SG-HMC positions (Havasi et al.
2018, algorithm 1). Now and then the last layer is drawn exactly (`last_layer.py`), which is not in the paper.
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.gp.deep_gp import DeepGP, factorise_all, log_likelihood, propagate
from gym_dgpmpc.gp.kernels import Kernel
from gym_dgpmpc.inference import sghmc
from gym_dgpmpc.inference.last_layer import last_layer_posterior
from gym_dgpmpc.inference.sghmc import SGHMCState


@dataclass(frozen=True)
class InferenceSettings:
    """Settings of the sampler and the hyperparameter optimiser.

    Attributes:
        step_size: epsilon of SG-HMC; twice the value of Havasi et al., see docs/deviations.md.
        decay: m, the friction of SG-HMC.
        learning_rate: of Adam.
        hyperparameters_every: SG-HMC steps for each Adam step.
        window_size: number of latest positions the M-step draws from.
        batch_size: observations per gradient; all of them where there are fewer.
        gibbs_every: training iterations between two exact draws of the last layer, which each kept sample gets too;
            0 leaves everything to SG-HMC.
        gibbs_rows: observations that such a draw is conditioned on; all of them where there are fewer.
        patience: training stops early once the held-out log likelihood has not improved over this many looks at it,
            which are ``look_every`` iterations apart; None trains to the end, on all data.
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
        positive = ("step_size", "learning_rate", "window_size", "batch_size", "gibbs_rows", "hyperparameters_every")
        for name in (*positive, "look_every", *(["patience"] if self.patience is not None else [])):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, received {getattr(self, name)}")
        if not 0.0 <= self.decay <= 1.0:
            raise ValueError(f"decay must lie in [0, 1], received {self.decay}")
        if self.gibbs_every < 0:
            raise ValueError(f"gibbs_every must be at least 0, received {self.gibbs_every}")


class Data(NamedTuple):
    """Standardised inputs and targets, float64."""

    x: Float[Tensor, "N D"]
    y: Float[Tensor, "N T"]

    @property
    def num_rows(self) -> int:
        """N."""
        return self.x.shape[0]

    def rows(self, index: Int[Tensor, "n"]) -> "Data":
        """Some of the rows."""
        return Data(self.x[index], self.y[index])


@runtime_checkable
class DataSource(Protocol):
    """Where minibatches come from: `Data`, or something that standardises only the rows that are asked for."""

    @property
    def num_rows(self) -> int: ...

    def rows(self, index: Int[Tensor, "n"]) -> Data: ...


def minibatch(data: DataSource, size: int, generator: torch.Generator) -> Data:
    """``size`` rows drawn uniformly with replacement; everything if there are no more than that."""
    num_rows = data.num_rows
    if num_rows <= size:
        return data if isinstance(data, Data) else data.rows(torch.arange(num_rows, device=generator.device))
    return data.rows(torch.randint(num_rows, (size,), generator=generator, device=generator.device))


def negative_log_joint(
    kernel: Kernel,
    model: DeepGP,
    factors: list[Tensor],
    whitened: Float[Tensor, "V"],
    batch: Data,
    num_data: int,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """-log p(y, v) / N, unbiased by a minibatch: -mean log p(y | v) + |v|^2 / (2 N)."""
    mean, variance = propagate(kernel, model, factors, model.split(whitened), batch.x, generator)
    likelihood = log_likelihood(model, mean, variance, batch.y).mean()
    return -likelihood + 0.5 * whitened.square().sum() / num_data


def _gradient(
    kernel: Kernel,
    model: DeepGP,
    factors: list[Tensor],
    chain: SGHMCState,
    batch: Data,
    num_data: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """The negative log joint at the chain's position and its gradient there, hyperparameters held fixed."""
    position = chain.position.detach().requires_grad_()
    value = negative_log_joint(kernel, model, factors, position, batch, num_data, generator)
    (gradient,) = torch.autograd.grad(value, position)
    return value.detach(), gradient


class MCEM:
    """The state of a training run, moved on by `step`: hyperparameters, chain, window and optimiser.

    Args:
        kernel: of every layer.
        model: hyperparameters to start from; left as they are.
        chain: where to start; its preconditioner is kept.
        data: what to train on.
        settings: of sampler and optimiser.
    """

    def __init__(
        self,
        kernel: Kernel,
        model: DeepGP,
        chain: SGHMCState,
        data: Data,
        settings: InferenceSettings,
    ):
        self.kernel, self.chain, self.data, self.settings = kernel, chain, data, settings
        self._parameters = [p.detach().clone().requires_grad_() for p in model.parameters()]
        self._live = _rebuild(model, self._parameters)
        self._optimiser = torch.optim.Adam(self._parameters, lr=settings.learning_rate)
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
            factors, position = factorise_all(self.kernel, self._live), self.chain.position
            num_data = self.data.num_rows
            return float(negative_log_joint(self.kernel, self._live, factors, position, batch, num_data, generator))

    def step(self, generator: torch.Generator) -> None:
        """One SG-HMC step (burn-in, preconditioner adapting), and now and then one Adam step and one exact draw.

        Raises:
            FactorisationError: the hyperparameters have become such that a K_zz cannot be factorised.
        """
        settings, num_data = self.settings, self.data.num_rows
        batch = minibatch(self.data, settings.batch_size, generator)
        with torch.no_grad():  # gradients do not need it: see `layer.project`
            factors = factorise_all(self.kernel, self._live)

        # E-step: move the inducing outputs under the current hyperparameters.
        fixed = self._live.detach()
        self.value, gradient = _gradient(self.kernel, fixed, factors, self.chain, batch, num_data, generator)
        self.chain = sghmc.step(
            self.chain, gradient, num_data, generator, step_size=settings.step_size, decay=settings.decay, burn_in=True
        )
        if settings.gibbs_every and self.iteration % settings.gibbs_every == 0:
            self.chain = gibbs_step(self.kernel, fixed, factors, self.chain, self.data, generator, settings)
        self._window[self.iteration % settings.window_size] = self.chain.position
        self.iteration += 1

        # M-step: move the hyperparameters under a sample from the window.
        if self.iteration % settings.hyperparameters_every == 0:
            held = self.window
            pick = torch.randint(len(held), (1,), generator=generator, device=generator.device)
            sample = held.index_select(0, pick).squeeze(0)
            self._optimiser.zero_grad()
            negative_log_joint(self.kernel, self._live, factors, sample, batch, num_data, generator).backward()
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
    kernel: Kernel,
    model: DeepGP,
    chain: SGHMCState,
    data: DataSource,
    num_samples: int,
    spacing: int,
    generator: torch.Generator,
    settings: InferenceSettings,
    factors: list[Tensor] | None = None,
) -> Iterator[SGHMCState]:
    """Run the chain with frozen hyperparameters and preconditioner; yield it every ``spacing`` steps.

    Args:
        factors: L_z of every layer, if the caller has them already.
    """
    num_data = data.num_rows
    model = model.detach()
    factors = factorise_all(kernel, model) if factors is None else factors
    for _ in range(num_samples):
        for _ in range(spacing):
            batch = minibatch(data, settings.batch_size, generator)
            _, gradient = _gradient(kernel, model, factors, chain, batch, num_data, generator)
            chain = sghmc.step(
                chain, gradient, num_data, generator, step_size=settings.step_size, decay=settings.decay, burn_in=False
            )
        if settings.gibbs_every:
            chain = gibbs_step(kernel, model, factors, chain, data, generator, settings)
        yield chain


def gibbs_step(
    kernel: Kernel,
    model: DeepGP,
    factors: list[Tensor],
    chain: SGHMCState,
    data: DataSource,
    generator: torch.Generator,
    settings: InferenceSettings,
) -> SGHMCState:
    """Draw the last layer's inducing outputs exactly, given the inner layers', and bring them to rest there."""
    (position,) = gibbs_positions(kernel, model, factors, chain, data, 1, generator, settings)
    at_rest = chain.momentum.clone()
    at_rest[model.num_inner() :] = 0.0
    return chain._replace(position=position, momentum=at_rest)


def gibbs_positions(
    kernel: Kernel,
    model: DeepGP,
    factors: list[Tensor],
    chain: SGHMCState,
    data: DataSource,
    num_samples: int,
    generator: torch.Generator,
    settings: InferenceSettings,
) -> Float[Tensor, "n V"]:
    """Positions that share the chain's inner layers, each with its own exact draw of the last layer."""
    rows = minibatch(data, settings.gibbs_rows, generator)
    weight = data.num_rows / rows.num_rows
    posterior = last_layer_posterior(kernel, model, factors, chain.position, rows.x, rows.y, generator, weight)
    drawn = posterior.sample(num_samples, generator).flatten(1)
    return torch.cat([chain.position[: model.num_inner()].expand(num_samples, -1), drawn], dim=1)


def _rebuild(model: DeepGP, parameters: list[Tensor]) -> DeepGP:
    """``model`` with its tensors replaced, in the order of `DeepGP.parameters`."""
    layers = tuple(type(layer)(*parameters[3 * i : 3 * i + 3]) for i, layer in enumerate(model.layers))
    return DeepGP(layers, parameters[-1])
