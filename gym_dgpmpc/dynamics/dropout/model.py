"""The dynamics model of DeepPILCO: a Bayesian network by dropout, whose draws are functions.

Gal, McAllister and Rasmussen (2016), "Improving PILCO with Bayesian Neural Network Dynamics Models". The network is in
`network.py`, the draws in `draws.py`; what differs is in docs/deviations.md.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.bounds import SeenTargets, take_seen
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.dropout.draws import DropoutSampler
from gym_dgpmpc.dynamics.dropout.network import (
    DropoutNetwork,
    decays,
    draw_kept,
    initial_network,
    mean_kept,
    misfit,
    predict,
)
from gym_dgpmpc.dynamics.learner import Learner
from gym_dgpmpc.dynamics.networks import Epochs, Learning, Parameters, Trained, layer_sizes, take_trained
from gym_dgpmpc.dynamics.noise import NoiseSplit, PathNoise, take_noise_split
from gym_dgpmpc.dynamics.predictive import Mixture
from gym_dgpmpc.dynamics.state import normalisers_state, take_normaliser
from gym_dgpmpc.types import ObservationSpec, StateDict, Transitions, TransitionSampler

FIRST_NOISE = 0.1
"""Variance of the noise that is learned, before the first training, in units of the targets' own."""

NOISE_LEARNS_FASTER = 10.0
"""The log of the noise's variance has a long way to go, which Adam goes in steps of its learning rate."""

NUM_FUNCTIONS = 50
"""Functions that a predictive density, and a training's report, are averaged over."""


class _Fitted(NamedTuple):
    trained: Trained
    normalisers: tuple[Normaliser, Normaliser]
    seen: SeenTargets
    noise: NoiseSplit | None = None  # None: not told apart

    @property
    def network(self) -> DropoutNetwork:
        return DropoutNetwork.from_parameters(self.trained.parameters)


class DropoutDynamics(Learner[_Fitted]):
    """Implements `DynamicsModel` with one network with dropout, whose functions are drawn by drawing masks.

    Inputs and targets are standardised at each training; the network and Adam go on from where the last training left
    them. Within an episode nothing is learned. Layers, sigmoids, dropout and minibatches are as a public
    reimplementation of DeepPILCO has them; the noise that is learned, the prior's lengthscale, and how fast and how
    long it is trained, are this package's.

    Args:
        observation_size: numbers in an observation, S.
        action_size: numbers in an action, A.
        observation_spec: how to read the observation.
        num_hidden_layers: hidden layers of the network.
        hidden_size: units of each hidden layer.
        dropout: chance that a hidden unit is left out of a function.
        prior_lengthscale: l of the prior N(0, 1 / l^2) on weights and biases, from which their decay follows: the
            longer, the smoother are the functions.
        model_noise_std: standard deviation of the noise, in those of the targets; None learns it, one for each target.
        learning_rate: learning rate of Adam.
        batch_size: transitions in a minibatch.
        num_epochs: passes over the data in each training; with ``patience`` the most of them.
        patience: epochs in a row without a better likelihood of held-out transitions, a tenth of all, after which
            training stops and the network of the best epoch is taken; None trains all epochs on all data.
        add_noise: draw the noise too; otherwise functions alone.
        split_noise: where ``add_noise`` is on, tell the sensors' noise, which only blurs what is observed, from the
            process's, which adds up over a plan, as far as the data show it; otherwise all of it adds up.
        dtype: precision of rollouts; the network is trained in float32.
        device: where tensors live.

    Attributes:
        epochs: how the network is trained.

    Raises:
        TypeError, ValueError: a setting is out of its range.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        observation_spec: ObservationSpec | None = None,
        *,
        num_hidden_layers: int = 2,
        hidden_size: int = 200,
        dropout: float = 0.05,
        prior_lengthscale: float = 1.0,
        model_noise_std: float | None = None,
        learning_rate: float = 1e-3,
        batch_size: int = 100,
        num_epochs: int = 1000,
        patience: int | None = None,
        add_noise: bool = True,
        split_noise: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ):
        check_counts(num_hidden_layers=num_hidden_layers, hidden_size=hidden_size)
        check_reals("[0, 1)", dropout=dropout)
        check_reals("[0, inf)", prior_lengthscale=prior_lengthscale)
        if model_noise_std is not None:
            check_reals("(0, inf)", model_noise_std=model_noise_std)
        self.epochs = Epochs(learning_rate, batch_size, num_epochs, patience)
        self.epochs.check()
        noise = {"add_noise": add_noise, "split_noise": split_noise}
        super().__init__(observation_size, action_size, observation_spec, dtype, device, **noise)
        self.dropout, self.prior_lengthscale, self.model_noise_std = dropout, prior_lengthscale, model_noise_std
        self.sizes = layer_sizes(self.encoder.input_size, num_hidden_layers, hidden_size, self.encoder.target_size)

    def fit(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Train the network, with fresh masks for every row of every minibatch.

        Raises:
            ValueError: there are no transitions.
        """
        normalisers, standardised = self._standardised(data)
        if self._fitted is None:
            first = math.log(FIRST_NOISE) if self.model_noise_std is None else 2.0 * math.log(self.model_noise_std)
            start = Trained.untrained(initial_network(self.sizes, first, generator, self.device).parameters())
        else:
            start = self._fitted.trained
        learning = self._train(start, standardised, generator)
        fitted = _Fitted(learning.trained, normalisers, SeenTargets.of(standardised.y))
        network = fitted.network
        kept = mean_kept(network, self.dropout)

        @torch.no_grad()
        def mean(x: Tensor) -> Tensor:
            return predict(network, kept, x.float()).double()

        variance = network.noise_variance
        noise = self._split_noise(data, normalisers, mean, variance)
        self._fitted = fitted._replace(noise=noise)
        return {
            "loss": learning.last_loss,
            "iterations": float(learning.num_steps),
            "rmse": float((mean(standardised.x) - standardised.y).square().mean().sqrt()),
            "noise_std": float(variance.sqrt().mean()),
            "disagreement": float(self._functions(network, standardised.x, generator).std(0, correction=0).mean()),
        } | self._noise_metrics(noise, normalisers[1], variance)

    def resample(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Do nothing: the network is trained between episodes only.

        Raises:
            RuntimeError: the model was not fitted.
        """
        self._require_fit("resample")
        return {}

    def draw(self, num_particles: int, horizon: int, generator: torch.Generator) -> TransitionSampler:
        """One function, and a sequence of noise, per particle for plans of ``horizon`` steps.

        Raises:
            RuntimeError: the model was not fitted.
        """
        fitted = self._require_fit("draw")
        parameters = {name: value.to(self.dtype) for name, value in fitted.trained.parameters.items()}
        network = DropoutNetwork.from_parameters(parameters)
        # Drawn in single precision, as noise is, so that the precision of a rollout does not change its functions.
        kept = draw_kept(fitted.network, self.dropout, generator, num_particles, 1)
        drawn = self._drawn_noise(fitted.noise)
        std = (fitted.network.noise_variance * drawn.process_share).sqrt().expand(num_particles, -1)
        blur = drawn.observation(self.encoder)
        noise = PathNoise.draw(std, blur, horizon, num_particles, self.dtype, generator)
        coordinates = Coordinates(self.encoder, *fitted.normalisers, self.dtype, fitted.seen)
        return DropoutSampler(network, [mask.to(self.dtype) for mask in kept], coordinates, noise)

    @torch.no_grad()
    def _functions(
        self, network: DropoutNetwork, x: Float[Tensor, "n D"], generator: torch.Generator
    ) -> Float[Tensor, "F n T"]:
        """Some functions at standardised inputs."""
        kept = draw_kept(network, self.dropout, generator, NUM_FUNCTIONS, 1)
        return predict(network, kept, x.float().expand(NUM_FUNCTIONS, -1, -1)).double()

    def _mixture(self, x: Float[Tensor, "n D"], generator: torch.Generator) -> Mixture:
        fitted = self._require_fit("predict")
        inputs, targets = fitted.normalisers
        mean = targets.inverse(self._functions(fitted.network, inputs(x), generator))
        variance = fitted.network.noise_variance.double() * targets.std.square()
        return Mixture(mean, variance.expand_as(mean))

    def state_dict(self) -> StateDict:
        """Network, normalisers and what Adam remembers; empty before the first fit."""
        if self._fitted is None:
            return {}
        trained, normalisers, seen, noise = self._fitted
        state = trained.state() | normalisers_state(*normalisers) | seen.state()
        return state if noise is None else state | noise.state()

    def load_state_dict(self, state: StateDict) -> None:
        """Restore `state_dict` of a model with the same settings.

        Raises:
            ValueError: an entry is missing or is not what these settings give it; the model stays as it was.
        """
        if not state:
            self._fitted = None
            return
        sizes, device = (self.encoder.input_size, self.encoder.target_size), self.device
        layers = list(enumerate(self.sizes))
        shapes: dict[str, tuple[int, ...]] = {f"layers.{i}.weight": size for i, size in layers}
        shapes |= {f"layers.{i}.bias": size[1:] for i, size in layers} | {"log_noise": sizes[1:]}
        normalisers = (
            take_normaliser(state, "inputs", sizes[0], device),
            take_normaliser(state, "targets", sizes[1], device),
        )
        seen, noise = take_seen(state, sizes[1], device), take_noise_split(state, sizes[1], device)
        self._fitted = _Fitted(take_trained(state, shapes, device), normalisers, seen, noise)

    def _train(self, start: Trained, data: Data, generator: torch.Generator) -> Learning:
        x, y = data.x.float(), data.y.float()
        learned, held_out = self.epochs.split(len(x), generator, self.device)

        def of_batch(parameters: Parameters, batch: Int[Tensor, "1 m"]) -> Float[Tensor, ""]:
            network, (rows,) = DropoutNetwork.from_parameters(parameters), batch
            return misfit(network, draw_kept(network, self.dropout, generator, len(rows)), x[rows], y[rows])

        def of_held_out(parameters: Parameters) -> float:
            network = DropoutNetwork.from_parameters(parameters)
            return float(misfit(network, mean_kept(network, self.dropout), x[held_out], y[held_out]))

        noise_rate = self.epochs.learning_rate * NOISE_LEARNS_FASTER if self.model_noise_std is None else 0.0
        return self.epochs.train(
            start,
            learned.unsqueeze(0),
            of_batch,
            None if held_out is None else of_held_out,
            generator,
            options={
                **decays(len(self.sizes), self.dropout, self.prior_lengthscale, len(learned)),
                "log_noise": {"lr": noise_rate},
            },
            on_progress=self.on_progress,
        )
