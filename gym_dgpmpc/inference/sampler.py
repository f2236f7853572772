"""C chains side by side: SG-HMC over inducing outputs, Metropolis moves of the latents, steps of hyperparameters.

The target is the joint posterior of everything that is not observed,

    p(v, e, theta | y)  ~  p(theta) N(v; 0, I) N(e; 0, I) prod_n p(y_n | v, e_n, theta),

with v the whitened inducing outputs of all layers, e_n the latents of the inner layers at datum n (`gradients.py`), and
theta the hyperparameters and inducing inputs. Integrating over e is the likelihood of Havasi et al. (2018) for a given
v; they draw e afresh from its prior at every step, which follows the mean of log p(y | v, e) instead, a narrower law.
Given v and theta the data are independent, so each e_n is moved by a Metropolis step of its own. Now and then the last
layer is drawn exactly (`last_layer.py`), given all else. `training.py` decides how long; `dynamics/deep_gp/` keeps what
comes out.

With ``hyperparameters="optimised"``, the default, theta follows the moving-window Monte Carlo EM of the paper instead:
Adam steps under positions of the latest SG-HMC steps.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.data.standardised import Data, DataSource
from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.inference import adam, sghmc
from gym_dgpmpc.inference.adam import AdamState
from gym_dgpmpc.inference.gradients import Gradients, forward, gradients, likelihood, pass_first, prepare
from gym_dgpmpc.inference.last_layer import last_layer_evidence
from gym_dgpmpc.inference.latents import move_latents, with_latents
from gym_dgpmpc.inference.layers import Passed, Seen, see
from gym_dgpmpc.inference.priors import log_prior_gradient
from gym_dgpmpc.inference.settings import InferenceSettings
from gym_dgpmpc.inference.sghmc import SGHMCState
from gym_dgpmpc.randomness import quick_normals

LAST_LEARNING_RATE = 1 / 6
"""Adam's learning rate at the end of its iterations, as a share of that at their start; it falls geometrically."""

MOST_TURNED, MOST_HEATED = 0.03, 0.1
"""See `step_sizes`: of the squared angle that a step turns, and of the variance that minibatches add."""


class ChainState(NamedTuple):
    """Where C chains are."""

    whitened: SGHMCState  # "C V"
    parameters: SGHMCState  # "C H": all of `DeepGP.parameters`, one after the other
    latents: list[Float[Tensor, "C N D"]]  # of each inner layer

    @property
    def num_chains(self) -> int:
        return len(self.whitened.position)


def flatten(parameters: list[Tensor]) -> Float[Tensor, "C H"]:
    """The tensors of each chain in one row."""
    return torch.cat([tensor.reshape(len(tensor), -1) for tensor in parameters], dim=1)


def with_flat(model: DeepGP, flat: Float[Tensor, "C H"]) -> DeepGP:
    """The model with the hyperparameters of `flatten`, as views."""
    shapes = [tensor.shape for tensor in model.parameters()]
    parts = flat.split([shape[1:].numel() for shape in shapes], dim=1)
    return model.with_parameters([part.view(shape) for part, shape in zip(parts, shapes, strict=True)])


def initial_state(model: DeepGP, whitened: SGHMCState, num_data: int, generator: torch.Generator) -> ChainState:
    """Chains that begin with these hyperparameters and inducing outputs, their latents drawn from the prior."""
    start = whitened.position
    none = [start.new_empty(len(start), 0, layer.inducing_inputs.shape[-1]) for layer in model.layers[:-1]]
    parameters = sghmc.init(flatten(model.parameters()))
    return ChainState(whitened, parameters, with_latents(none, num_data, generator))


class Chains:
    """C chains on their way through the posterior, moved on by `step`.

    Args:
        model: the kernels, and hyperparameters to start from; left as they are.
        state: where to start; preconditioners are kept.
        data: what is conditioned on.
        settings: of the sampler.
        num_burn_in: iterations in which Adam moves the hyperparameters, and the preconditioner of the inducing outputs
            adapts. After them that stays, since one that follows the chain makes it wander too far, and "sampled"
            hyperparameters are moved by SG-HMC, "optimised" ones by Adam as before.
        settled: the hyperparameters come from a training before, so that Adam begins with its last learning rate.
        scale: what all steps of ``settings``, and their bounds, are multiplied by; below one after a divergence.
        compile: see `gradients.prepare`.
    """

    def __init__(
        self,
        model: DeepGP,
        state: ChainState,
        data: DataSource,
        settings: InferenceSettings,
        num_burn_in: int,
        *,
        settled: bool = False,
        scale: float = 1.0,
        compile: bool = True,
    ):
        self._kernels, self.data, self.settings, self._num_burn_in = model, data, settings, num_burn_in
        self._settled, self.scale, self._compile = settled, scale, compile
        self.state = state
        self._adam = adam.init(state.parameters.position)
        position = state.whitened.position
        self._window = position.new_empty(settings.window_size, *position.shape)
        self.iteration = 0
        self.value = position.new_zeros(state.num_chains)
        """The last negative log likelihood per observation, on a minibatch, of each chain."""
        self._refactorise()

    @property
    def model(self) -> DeepGP:
        """The present hyperparameters."""
        return self.prepared.model

    def _refactorise(self) -> None:
        model = with_flat(self._kernels, self.state.parameters.position)
        self.prepared = prepare(model, compile=self._compile)
        self._seen: Seen | None = None

    def evaluate(self, generator: torch.Generator) -> float:
        """The negative log likelihood per observation where the chains are, on a minibatch; moves nothing."""
        batch, index = self._batch(self.settings.batch_size, generator)
        passed, _ = self._pass(self.state.whitened.position, batch, index, generator, move=False)
        return -float(likelihood(self.prepared, passed, batch.y).mean())

    def step(self, generator: torch.Generator, *, frozen: bool = False) -> None:
        """One SG-HMC step of the inducing outputs; now and then one of the hyperparameters, and one exact draw.

        Args:
            frozen: leave the hyperparameters, and the exact draws, out.

        Raises:
            FactorisationError: with the present hyperparameters a K_zz cannot be factorised.
        """
        settings, num_data, state = self.settings, self.data.num_rows, self.state
        moves_parameters = not frozen and (self.iteration + 1) % settings.hyperparameters_every == 0
        batch, index = self._batch(settings.batch_size, generator)
        passed, latents = self._pass(state.whitened.position, batch, index, generator, move=self.iteration % 2 == 0)
        self.value = -likelihood(self.prepared, passed, batch.y).mean(-1)
        # Of the hyperparameters here, unless a position of the window serves for them.
        here = moves_parameters and settings.window_size == 1
        current = self._gradients(state.whitened.position, passed, latents, batch, of_parameters=here)
        whitened = sghmc.step(
            state.whitened,
            state.whitened.position / num_data - current.whitened,
            num_data,
            generator,
            step_size=self._step_sizes(state.whitened, settings.step_size, batch.num_rows),
            decay=settings.decay,
            burn_in=self.iteration < self._num_burn_in,
        )
        self.state = self.state._replace(whitened=whitened)
        if not frozen and settings.gibbs_every and self.iteration % settings.gibbs_every == 0:
            self.draw_last_layer(generator)
        self._window[self.iteration % settings.window_size] = self.state.whitened.position
        self.iteration += 1
        if moves_parameters:
            if settings.window_size > 1:
                current = self._at_window(batch, index, generator)
            assert current.parameters is not None
            self._move_parameters(flatten(current.parameters), batch.num_rows, generator)

    def draw_last_layer(self, generator: torch.Generator) -> None:
        """Draw the last layer's inducing outputs exactly, given all else, and a momentum from its own law."""
        whitened, inner, num_data = self.state.whitened, self.model.num_inner(), self.data.num_rows
        size = self._step_sizes(whitened, self.settings.step_size, min(self.settings.batch_size, num_data))
        momentum = quick_normals(size.shape, size, generator) * size * (whitened.inverse_mass() / num_data).sqrt()
        momentum[:, :inner] = whitened.momentum[:, :inner]
        position = self.last_layer_draws(1, generator)[0]
        self.state = self.state._replace(whitened=whitened._replace(position=position, momentum=momentum))

    def _step_sizes(self, state: SGHMCState, step_size: float, batch_size: int) -> Float[Tensor, "C V"]:
        return self.scale * step_sizes(state, step_size, self.settings.decay, batch_size, self.data.num_rows)

    def last_layer_draws(self, num_samples: int, generator: torch.Generator) -> Float[Tensor, "n C V"]:
        """Positions that share the chains' inner layers, each with its own exact draw of the last layer."""
        batch, index = self._batch(self.settings.gibbs_rows, generator)
        position, inner = self.state.whitened.position, self.model.num_inner()
        passed, _ = self._pass(position, batch, index, generator, move=False)
        weight = self.data.num_rows / batch.num_rows
        evidence = last_layer_evidence(self.prepared, passed[-1], batch.y, weight)
        return evidence.posterior(self.prepared.factorise).positions(position[:, :inner], num_samples, generator)

    def _batch(self, size: int, generator: torch.Generator) -> tuple[Data, Int[Tensor, "n"] | None]:
        """Rows of the data, drawn uniformly with replacement, and which they are; None stands for all of them."""
        num_rows, device = self.data.num_rows, self._window.device
        if num_rows > size:
            index = torch.randint(num_rows, (size,), generator=generator, device=device)
            return self.data.rows(index), index
        if isinstance(self.data, Data):
            return self.data, None
        return self.data.rows(torch.arange(num_rows, dtype=torch.int64, device=device)), None

    def _pass(
        self,
        position: Float[Tensor, "C V"],
        batch: Data,
        index: Int[Tensor, "n"] | None,
        generator: torch.Generator,
        *,
        move: bool,
    ) -> tuple[list[Passed], list[Tensor]]:
        """The rows through all layers with their latents, which are moved before if ``move`` says so."""
        whitened = self.model.split(position)
        latents = [latent if index is None else latent.index_select(1, index) for latent in self.state.latents]
        x = batch.x.expand(len(position), -1, -1)
        if index is not None:
            seen = see(self.prepared.layers[0], x)
        else:  # always the same rows, until the hyperparameters move
            seen = self._seen = self._seen or see(self.prepared.layers[0], x)
        first = pass_first(self.prepared, whitened[0], seen)
        if not move:
            return forward(self.prepared, whitened, x, latents, first), latents
        passed, latents = move_latents(self.prepared, whitened, batch, latents, generator, first)
        for held, moved in zip(self.state.latents, latents, strict=True):
            # In place: only `snapshot` keeps a state beyond a step, and it copies them.
            if index is None:
                held.copy_(moved)
            else:
                held.index_copy_(1, index, moved)
        return passed, latents

    def _gradients(
        self,
        position: Float[Tensor, "C V"],
        passed: list[Passed],
        latents: list[Tensor],
        batch: Data,
        *,
        of_parameters: bool,
    ) -> Gradients:
        whitened = self.model.split(position)
        return gradients(self.prepared, whitened, passed, latents, batch.y, of_parameters=of_parameters)

    def _at_window(self, batch: Data, index: Int[Tensor, "n"] | None, generator: torch.Generator) -> Gradients:
        """Gradients at a position drawn from the window."""
        held = self._window[: min(self.iteration, len(self._window))]
        pick = int(torch.randint(len(held), (1,), generator=generator, device=generator.device))
        passed, latents = self._pass(held[pick], batch, index, generator, move=False)
        return self._gradients(held[pick], passed, latents, batch, of_parameters=True)

    def _move_parameters(self, gradient: Float[Tensor, "C H"], batch_size: int, generator: torch.Generator) -> None:
        """An Adam step, or, after the burn-in of "sampled" ones, an SG-HMC step; ``gradient`` is the likelihood's."""
        settings, parameters, num_data = self.settings, self.state.parameters, self.data.num_rows
        sampled = settings.hyperparameters == "sampled"
        if sampled:
            prior = flatten(log_prior_gradient(self.model))
            gradient = gradient + prior / num_data
        gradient = -gradient
        if sampled and self.iteration > self._num_burn_in:
            # Its preconditioner goes on adapting: where Adam ended gradients vanish, which would make steps too long.
            parameters = sghmc.step(
                parameters,
                gradient,
                num_data,
                generator,
                step_size=self._step_sizes(parameters, settings.hyperparameter_step_size, batch_size),
                decay=settings.decay,
                burn_in=True,
            )
        else:
            if sampled:  # which the preconditioner is for
                parameters = sghmc.adapt(parameters, gradient)
            done = 1.0 if self._settled else min(self.iteration / max(self._num_burn_in, 1), 1.0)
            rate = self.scale * settings.learning_rate * LAST_LEARNING_RATE**done
            self._adam, position = adam.step(self._adam, parameters.position, gradient, rate)
            parameters = parameters._replace(position=position)
        self.state = self.state._replace(parameters=parameters)
        self._refactorise()

    def snapshot(self) -> "Snapshot":
        """A copy of everything that `step` moves."""
        latents = [latent.clone() for latent in self.state.latents]
        state = self.state._replace(latents=latents)
        return Snapshot(state, self._adam, self._window.clone(), self.iteration, self.value)

    def restore(self, snapshot: "Snapshot", scale: float = 1.0) -> None:
        """Go back to a snapshot, with all further steps multiplied by ``scale``, and the chains brought to rest.

        The snapshot may be used again.
        """
        state = snapshot.state
        self.state = ChainState(
            at_rest(state.whitened), at_rest(state.parameters), [latent.clone() for latent in state.latents]
        )
        self._adam = snapshot.adam
        self._window.copy_(snapshot.window)
        self.iteration, self.value = snapshot.iteration, snapshot.value
        self.scale *= scale
        self._refactorise()


def step_sizes(
    state: SGHMCState, step_size: float, decay: float, batch_size: int, num_data: int
) -> Float[Tensor, "C V"]:
    """The step size of each coordinate: ``step_size``, or less where the posterior is stiff or minibatches are noisy.

    A coordinate's potential has the curvature (N sd(g))^2, and a mass of sd(g), so that it turns by eps^2 N sd(g) a
    step, squared; the samples' variance is too large by a quarter of that. The noise of a minibatch adds
    eps^2 N sd(g) / 2 m times the variance that SG-HMC injects (eps^4 M^-2 var(g) to 2 eps^2 m M^-1 / N). So one bound
    on eps^2 N sd(g) serves for both. Coordinates that the data say little about keep long steps, which they need to
    mix.
    """
    most = MOST_TURNED
    if batch_size < num_data:
        most = min(most, 2.0 * decay * MOST_HEATED / (1.0 - batch_size / num_data))
    return (most / num_data * state.inverse_mass()).clamp_max(step_size**2).sqrt()


class Snapshot(NamedTuple):
    """See `Chains.snapshot`."""

    state: ChainState
    adam: AdamState
    window: Tensor
    iteration: int
    value: Tensor


def sample(
    chains: Chains, num_samples: int, spacing: int, generator: torch.Generator
) -> Iterator[Float[Tensor, "C V"]]:
    """Go on with frozen hyperparameters and preconditioners; yield the positions every ``spacing`` steps."""
    for _ in range(num_samples):
        for _ in range(spacing):
            chains.step(generator, frozen=True)
        if chains.settings.gibbs_every:
            chains.draw_last_layer(generator)
        yield chains.state.whitened.position


def at_rest(state: SGHMCState) -> SGHMCState:
    """Where it is, without momentum."""
    return state._replace(momentum=torch.zeros_like(state.momentum))
