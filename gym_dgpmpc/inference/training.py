"""How long to train, and what to do when training goes wrong: the loop around `sampler.Chains.step`.

Every so many iterations it looks at the run. If the run has diverged, it goes back to the last look with half the step
size. If the likelihood of held-out data no longer improves, it stops. `dynamics/deep_gp/` calls it once a fit.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.errors import FactorisationError, TrainingError
from gym_dgpmpc.gp.deep_gp import DeepGP, Factorised, log_likelihood, propagate
from gym_dgpmpc.inference import priors, sampler
from gym_dgpmpc.inference.latents import with_latents
from gym_dgpmpc.inference.sampler import Chains, ChainState
from gym_dgpmpc.inference.settings import InferenceSettings
from gym_dgpmpc.inference.sghmc import SGHMCState

MAX_ROLLBACKS = 5
"""The most rollbacks in one training; after the last of them the step sizes are 1/32 of the settings."""

EXPLODED = 1e3
"""A run whose negative log likelihood per observation is this far above the lowest seen has diverged."""

MOST_WHITENED = 1e4
"""A chain with a whitened inducing output beyond this has diverged."""

HELD_OUT = 0.1, 256
"""The share of the data that early stopping holds out, and the most rows of it."""

MIN_HELD_OUT = 10
"""With fewer rows their likelihood is too noisy to stop on, and nothing is held out."""

BURN_IN, LATER_BURN_IN = 0.5, 0.25
"""The share of a first and of a later training that serves to get to where the posterior is."""


class Trained(NamedTuple):
    """The outcome of `train`."""

    model: DeepGP
    state: ChainState
    negative_log_likelihood: float
    """The last one, per observation, on a minibatch; the mean over the chains."""
    num_iterations: int
    num_rollbacks: int
    scale: float
    """What steps had to be multiplied by: one half for each rollback."""


class Sampled(NamedTuple):
    """The outcome of `sample_pool`."""

    pool: Float[Tensor, "n C V"]
    state: ChainState
    """At the last of the samples."""
    scale: float
    """What steps had to be multiplied by."""


def train(
    model: DeepGP,
    whitened: SGHMCState,
    data: Data,
    num_iterations: int,
    generator: torch.Generator,
    settings: InferenceSettings,
    *,
    settled: bool = False,
    compile: bool = True,
    on_look: Callable[[int, float], None] | None = None,
) -> Trained:
    """Train for ``num_iterations`` iterations at most.

    Args:
        model: hyperparameters to start from; left as they are.
        whitened: inducing outputs to start from, and their preconditioner.
        data: standardised; with early stopping a tenth of it serves to see when to stop.
        settled: hyperparameters and preconditioners come from a training before, which makes for a shorter burn-in.
        compile: see `gradients.prepare`.
        on_look: is told the iterations done and the negative log likelihood, at the start and at every look.

    Raises:
        TrainingError: training diverged again and again, with ever smaller steps.
    """
    held_out, order, num_rows = None, None, data.num_rows
    if settings.patience is not None:
        data, held_out, order = _split_off_held_out(data, generator)
    state = sampler.initial_state(model, whitened, data.num_rows, generator)
    burn_in = LATER_BURN_IN if settled else BURN_IN
    run = Chains(model, state, data, settings, round(burn_in * num_iterations), settled=settled, compile=compile)
    good, best, rollbacks = run.snapshot(), run.evaluate(_copy_of(generator)), 0
    best_likelihood, looks_since = -math.inf, 0
    if on_look is not None:
        on_look(0, best)
    while run.iteration < num_iterations:
        trouble = _advance(run, min(settings.look_every, num_iterations - run.iteration), generator, best)
        if trouble is not None:
            rollbacks += 1
            if rollbacks > MAX_ROLLBACKS:
                step_size = run.scale * settings.step_size
                raise TrainingError(
                    f"training diverged {rollbacks} times, the last time after iteration {good.iteration} with the "
                    f"step size {step_size:g}: {trouble}. Check whether the values of the {data.num_rows} "
                    "transitions are plausible, or train with a smaller step_size"
                )
            run.restore(good, scale=0.5)
            continue
        value = float(run.value.mean())
        good, best = run.snapshot(), min(best, value)
        if on_look is not None:
            on_look(run.iteration, value)
        if held_out is not None:
            likelihood = predictive_log_likelihood(
                run.prepared.factorised, run.state.whitened.position, held_out, generator
            )
            improved = likelihood > best_likelihood
            best_likelihood = max(best_likelihood, likelihood)
            looks_since = 0 if improved else looks_since + 1
            if looks_since == settings.patience:
                break
    value, state = float(run.value.mean()), run.state
    if order is not None:
        state = state._replace(latents=[_in_order(latent, order, num_rows, generator) for latent in state.latents])
    return Trained(run.model, state, value, run.iteration, rollbacks, run.scale)


def sample_pool(
    model: DeepGP,
    state: ChainState,
    data: Data,
    num_samples: int,
    spacing: int,
    generator: torch.Generator,
    settings: InferenceSettings,
    scale: float = 1.0,
    on_sample: Callable[[int], None] | None = None,
    *,
    compile: bool = True,
) -> Sampled:
    """Posterior samples of each chain, ``spacing`` steps apart.

    Begins anew from rest with half the steps if a chain leaves what is plausible. After each sample ``on_sample`` is
    told how many there are.

    Args:
        scale: what training had to multiply steps by.
        compile: see `gradients.prepare`.

    Raises:
        TrainingError: it did so again and again, with ever smaller steps.
    """
    for _ in range(MAX_ROLLBACKS + 1):
        start = state._replace(latents=[latent.clone() for latent in state.latents])
        chains, positions = Chains(model, start, data, settings, 0, scale=scale, compile=compile), []
        with suppress(FactorisationError):  # in an exact draw: the steps before it left values that are not finite
            for position in sampler.sample(chains, num_samples, spacing, generator):
                positions.append(position)
                if on_sample is not None:
                    on_sample(len(positions))
        if len(positions) == num_samples and is_plausible(pool := torch.stack(positions)):
            return Sampled(pool, chains.state, scale)
        # Where training has left a chain too fast, no step is short enough to stop it.
        state, scale = state._replace(whitened=sampler.at_rest(state.whitened)), 0.5 * scale
    raise TrainingError(
        f"sampling the posterior diverged {MAX_ROLLBACKS + 1} times, the last time with the step size "
        f"{2 * scale * settings.step_size:g}: train with a smaller step_size"
    )


def is_plausible(positions: Float[Tensor, "*n V"]) -> bool:
    """Whether whitened inducing outputs, which are standard normal before there are data, are finite and not absurd."""
    return bool((positions.abs() < MOST_WHITENED).all())


def predictive_log_likelihood(
    factorised: Factorised, positions: Float[Tensor, "C V"], data: Data, generator: torch.Generator
) -> float:
    """Mean log density of the data under the mixture over the chains."""
    model, x = factorised.model, data.x.expand(len(positions), -1, -1)
    with torch.no_grad():
        mean, variance = propagate(factorised, model.split(positions), x, generator)
        density = log_likelihood(model, mean, variance, data.y).logsumexp(0) - math.log(len(positions))
    return float(density.mean())


def _advance(run: Chains, num_iterations: int, generator: torch.Generator, best: float) -> str | None:
    """Take the steps; return what went wrong, or None. The host reads the run's values once, at the end."""
    try:
        for _ in range(num_iterations):
            run.step(generator)
    except FactorisationError as error:
        return str(error)
    value, position = float(run.value.max()), run.state.whitened.position
    if not math.isfinite(value) or not is_plausible(position):
        largest = float(position.abs().max())
        return f"the negative log likelihood is {value:g}, the largest whitened inducing output {largest:g}"
    if not priors.are_plausible(run.model):
        return "a hyperparameter left the range of its prior by far"
    if value > best + EXPLODED:
        return f"the negative log likelihood rose from {best:g} to {value:g} per transition"
    return None


def _split_off_held_out(data: Data, generator: torch.Generator) -> tuple[Data, Data | None, Int[Tensor, "n"] | None]:
    """Training data, held-out data, and which rows the former are; None where there are too few to hold any out."""
    share, most = HELD_OUT
    count = min(int(share * data.num_rows), most)
    if count < MIN_HELD_OUT:
        return data, None, None
    order = torch.randperm(data.num_rows, generator=generator, device=data.x.device)
    return data.rows(order[count:]), data.rows(order[:count]), order[count:]


def _in_order(
    latent: Float[Tensor, "C n D"], rows: Int[Tensor, "n"], num_rows: int, generator: torch.Generator
) -> Float[Tensor, "C N D"]:
    """Latents of some rows where they belong among all rows; those of the others are drawn from the prior."""
    (ordered,) = with_latents([latent[:, :0]], num_rows, generator)
    ordered[:, rows] = latent
    return ordered


def _copy_of(generator: torch.Generator) -> torch.Generator:
    """A generator that gives the same numbers and leaves the given one where it is."""
    return torch.Generator(generator.device).set_state(generator.get_state())
