"""Moving-window Monte Carlo EM: SG-HMC over inducing outputs, Adam over hyperparameters, interleaved.

Works on one batch of standardised inputs and targets; `dynamics/deep_gp.py` prepares them and keeps the results.
The E-step is one SG-HMC step; the M-step is one Adam step on the hyperparameters, inducing inputs and noise under a
sample drawn uniformly from the window of the latest SG-HMC positions (Havasi et al. 2018, algorithm 1). Now and then
the last layer is drawn exactly (`last_layer.py`), which is not in the paper.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
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
        window_size: number of latest positions the M-step draws from.
        batch_size: observations per gradient; all of them where there are fewer.
        gibbs_every: training iterations between two exact draws of the last layer, which each kept sample gets too;
            0 leaves everything to SG-HMC.
        gibbs_rows: observations that such a draw is conditioned on; all of them where there are fewer.

    Raises:
        ValueError: a setting is out of its range.
    """

    step_size: float = 0.02
    decay: float = 0.05
    learning_rate: float = 0.01
    window_size: int = 100
    batch_size: int = 256
    gibbs_every: int = 20
    gibbs_rows: int = 4096

    def __post_init__(self) -> None:
        for name in ("step_size", "learning_rate", "window_size", "batch_size", "gibbs_rows"):
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

    def minibatch(self, size: int, generator: torch.Generator) -> "Data":
        """``size`` rows drawn uniformly with replacement; everything if there are no more than that."""
        if self.x.shape[0] <= size:
            return self
        rows = torch.randint(self.x.shape[0], (size,), generator=generator, device=self.x.device)
        return Data(self.x[rows], self.y[rows])


class Trained(NamedTuple):
    """The outcome of `train`: hyperparameters, the chain at its last position, and the last negative log joint."""

    model: DeepGP
    chain: SGHMCState
    negative_log_joint: float


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


def train(
    kernel: Kernel,
    model: DeepGP,
    chain: SGHMCState,
    data: Data,
    num_iterations: int,
    generator: torch.Generator,
    settings: InferenceSettings,
    progress: Callable[[int, Tensor], None] | None = None,
) -> Trained:
    """Alternate SG-HMC steps (burn-in, preconditioner adapting) and Adam steps ``num_iterations`` times.

    Args:
        chain: where to start; its preconditioner is kept.
        progress: called with the iteration and the negative log joint (a tensor, not synchronised).
    """
    num_data = data.x.shape[0]
    parameters = [p.detach().clone().requires_grad_() for p in model.parameters()]
    live = _rebuild(model, parameters)
    optimiser = torch.optim.Adam(parameters, lr=settings.learning_rate)
    window = chain.position.new_empty(settings.window_size, chain.position.numel())
    value = chain.position.new_zeros(())
    for iteration in range(num_iterations):
        batch = data.minibatch(settings.batch_size, generator)
        with torch.no_grad():  # gradients do not need it: see `layer.project`
            factors = factorise_all(kernel, live)

        # E-step: move the inducing outputs under the current hyperparameters.
        value, gradient = _gradient(kernel, live.detach(), factors, chain, batch, num_data, generator)
        chain = sghmc.step(
            chain, gradient, num_data, generator, step_size=settings.step_size, decay=settings.decay, burn_in=True
        )
        if settings.gibbs_every and iteration % settings.gibbs_every == 0:
            chain = gibbs_step(kernel, live.detach(), factors, chain, data, generator, settings)
        window[iteration % settings.window_size] = chain.position

        # M-step: move the hyperparameters under a sample from the window.
        held = min(iteration + 1, settings.window_size)
        pick = int(torch.randint(held, (), generator=generator, device=generator.device))
        optimiser.zero_grad()
        negative_log_joint(kernel, live, factors, window[pick], batch, num_data, generator).backward()
        optimiser.step()
        if progress is not None:
            progress(iteration, value)
    return Trained(live.detach(), chain, float(value))


def sample(
    kernel: Kernel,
    model: DeepGP,
    chain: SGHMCState,
    data: Data,
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
    num_data = data.x.shape[0]
    model = model.detach()
    factors = factorise_all(kernel, model) if factors is None else factors
    for _ in range(num_samples):
        for _ in range(spacing):
            batch = data.minibatch(settings.batch_size, generator)
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
    data: Data,
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
    data: Data,
    num_samples: int,
    generator: torch.Generator,
    settings: InferenceSettings,
) -> Float[Tensor, "n V"]:
    """Positions that share the chain's inner layers, each with its own exact draw of the last layer."""
    rows = data.minibatch(settings.gibbs_rows, generator)
    weight = len(data.x) / len(rows.x)
    posterior = last_layer_posterior(kernel, model, factors, chain.position, rows.x, rows.y, generator, weight)
    drawn = posterior.sample(num_samples, generator).flatten(1)
    return torch.cat([chain.position[: model.num_inner()].expand(num_samples, -1), drawn], dim=1)


def _rebuild(model: DeepGP, parameters: list[Tensor]) -> DeepGP:
    """``model`` with its tensors replaced, in the order of `DeepGP.parameters`."""
    layers = tuple(type(layer)(*parameters[3 * i : 3 * i + 3]) for i, layer in enumerate(model.layers))
    return DeepGP(layers, parameters[-1])
