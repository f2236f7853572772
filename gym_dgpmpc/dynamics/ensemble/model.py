"""The dynamics model of PETS: an ensemble of probabilistic networks, each trained on a resampling of the data.

Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models". The
networks are in `network.py`, the draws in `draws.py`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.ensemble.draws import PROPAGATIONS, CollapsedEnsemble, EnsembleSampler, Propagation
from gym_dgpmpc.dynamics.ensemble.network import (
    Ensemble,
    Prediction,
    half_precision,
    initial_ensemble,
    loss,
    misfit,
    predict,
)
from gym_dgpmpc.dynamics.gaussian_draws import GaussianSampler
from gym_dgpmpc.dynamics.learner import Learner
from gym_dgpmpc.dynamics.networks import Epochs, Learning, Parameters, Trained, layer_sizes, take_trained
from gym_dgpmpc.dynamics.noise import NoiseSplit, observed, take_noise_split
from gym_dgpmpc.dynamics.predictive import Mixture
from gym_dgpmpc.dynamics.state import take_normaliser
from gym_dgpmpc.types import ObservationSpec, StateDict, Transitions, TransitionSampler


class _Fitted(NamedTuple):
    trained: Trained
    inputs: Normaliser
    noise: NoiseSplit | None = None  # None: not told apart

    @property
    def network(self) -> Ensemble:
        return Ensemble.from_parameters(self.trained.parameters)


class EnsembleDynamics(Learner[_Fitted]):
    """Implements `DynamicsModel` with an ensemble of B probabilistic networks.

    Inputs are standardised at each training, targets are not; the networks and Adam go on from where the last training
    left them. Within an episode nothing is learned.

    Args:
        observation_size: numbers in an observation, S.
        action_size: numbers in an action, A.
        observation_spec: how to read the observation.
        num_members: networks in the ensemble, B.
        num_hidden_layers: hidden layers of each network.
        hidden_size: units of each hidden layer.
        weight_decay: weight decay of every layer, from the first to the output layer, so one number more than there are
            hidden layers; the loss holds decay / 2 |W|^2.
        learning_rate: learning rate of Adam.
        batch_size: transitions in a minibatch of each network.
        num_epochs: passes over the data in each training; with ``patience`` the most of them.
        patience: epochs in a row without a better likelihood of held-out transitions, a tenth of all, after which
            training stops and the networks of the best epoch are taken; None trains all epochs on all data.
        draw: how particles move through the networks: "TS1", each through one drawn anew at each step; "TSinf", each
            through its own for the whole plan; "DS", each by its own draw from the mean and variance of all; "MM", as
            DS, then a candidate's particles are replaced by draws from their mean and variance; "expectation", along
            the mean.
        add_noise: draw the variance that the networks predict, as PETS does; otherwise their means alone.
        split_noise: where ``add_noise`` is on, tell the sensors' noise, which only blurs what is observed, from the
            process's, which adds up over a plan, as far as the data show it; otherwise all of it adds up.
        half_precision: compute the layers between the first and the last in bfloat16 in rollouts; several times faster
            on processors with instructions for it, and off by some 0.3 % of a prediction.
        dtype: precision of all else in rollouts; networks are trained in float32.
        device: where tensors live.

    Attributes:
        draw_kind: the setting ``draw``; `draw` is the method.
        epochs: how the networks are trained.

    Raises:
        ValueError: a setting is out of its range.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        observation_spec: ObservationSpec | None = None,
        *,
        num_members: int = 5,
        num_hidden_layers: int = 3,
        hidden_size: int = 500,
        weight_decay: Sequence[float] = (1e-4, 2.5e-4, 2.5e-4, 5e-4),
        learning_rate: float = 1e-3,
        batch_size: int = 32,
        num_epochs: int = 5,
        patience: int | None = None,
        draw: Propagation = "TSinf",
        add_noise: bool = True,
        split_noise: bool = False,
        half_precision: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ):
        check_counts(num_members=num_members, num_hidden_layers=num_hidden_layers, hidden_size=hidden_size)
        self.epochs = Epochs(learning_rate, batch_size, num_epochs, patience)
        self.epochs.check()
        if len(weight_decay) != num_hidden_layers + 1 or not all(0 <= decay < math.inf for decay in weight_decay):
            raise ValueError(
                f"weight_decay must hold one number of at least 0 for each layer: {num_hidden_layers} for the hidden "
                f"layers and one for the last, received {weight_decay}"
            )
        if draw not in PROPAGATIONS:
            raise ValueError(f"unknown draw {draw!r}: expected one of {', '.join(PROPAGATIONS)}")
        noise = {"add_noise": add_noise, "split_noise": split_noise}
        super().__init__(observation_size, action_size, observation_spec, dtype, device, **noise)
        self.num_members, self.weight_decay, self.draw_kind = num_members, tuple(weight_decay), draw
        self.sizes = layer_sizes(self.encoder.input_size, num_hidden_layers, hidden_size, 2 * self.encoder.target_size)
        self.half_precision = half_precision

    def fit(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Train every network on N transitions drawn with replacement, for some epochs.

        Raises:
            ValueError: there are no transitions.
        """
        raw, targets = self._encode(data)
        inputs = Normaliser.fit(raw, precision=data.observation.dtype)
        x, y = inputs(raw).float(), targets.float()
        if self._fitted is None:
            initial = initial_ensemble(self.num_members, self.sizes, generator, self.device)
            start = Trained.untrained(initial.parameters())
        else:
            start = self._fitted.trained
        learning = self._train(start, x, y, generator)
        trained = _Fitted(learning.trained, inputs)

        @torch.no_grad()
        def predicted(x: Tensor) -> Prediction:
            return predict(trained.network, x.float().expand(self.num_members, -1, -1))

        mean, logvar = predicted(x)
        normalisers, aleatoric = (inputs, _unit(y.shape[1], self.device)), logvar.exp().mean((0, 1))
        noise = self._split_noise(data, normalisers, lambda x: predicted(x).mean.mean(0).double(), aleatoric)
        self._fitted = trained._replace(noise=noise)
        return {
            "loss": learning.last_loss,
            "iterations": float(learning.num_steps),
            "rmse": float((mean.mean(0) - y).square().mean().sqrt()),
            "aleatoric_std": float(torch.exp(0.5 * logvar).mean()),
            "disagreement": float(mean.std(0, correction=0).mean()),
        } | self._noise_metrics(noise, normalisers[1], aleatoric)

    def resample(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Do nothing: the networks are trained between episodes only.

        Raises:
            RuntimeError: the model was not fitted.
        """
        self._require_fit("resample")
        return {}

    def draw(self, num_particles: int, horizon: int, generator: torch.Generator) -> TransitionSampler:
        """Particles for plans of ``horizon`` steps.

        Those of a "TS1" or "TSinf" draw are shared out over the networks; which of these have one more than others, if
        their number is not a multiple, is drawn once for the plan.

        Raises:
            RuntimeError: the model was not fitted.
        """
        fitted = self._require_fit("draw")
        network = Ensemble.from_parameters(
            {name: value.to(self.dtype) for name, value in fitted.network.parameters().items()}
        )
        network = half_precision(network) if self.half_precision else network
        coordinates = Coordinates(self.encoder, fitted.inputs, _unit(self.encoder.target_size, self.device), self.dtype)
        drawn = self._drawn_noise(fitted.noise)
        share, blur = drawn.process_share.to(self.dtype), drawn.observation(self.encoder)
        if self.draw_kind in ("TS1", "TSinf"):
            if num_particles % self.num_members:
                network = network.at(self._pick(num_particles, generator))
            shuffle = self.draw_kind == "TS1" and self.num_members > 1
            by_networks = EnsembleSampler(network, coordinates, generator, shuffle=shuffle, noise_share=share)
            return observed(by_networks, blur, generator)
        if self.draw_kind == "expectation":
            return GaussianSampler(CollapsedEnsemble(network, None), coordinates, generator)
        collapsed, match_moments = CollapsedEnsemble(network, share), self.draw_kind == "MM"
        sampler = GaussianSampler(collapsed, coordinates, generator, match_moments=match_moments)
        return observed(sampler, blur, generator)

    def _pick(self, num_particles: int, generator: torch.Generator) -> Int[Tensor, "P"]:
        """A network for each particle, as different as may be."""
        rounds = -(-num_particles // self.num_members)
        orders = [torch.randperm(self.num_members, generator=generator, device=self.device) for _ in range(rounds)]
        return torch.cat(orders)[:num_particles]

    def _mixture(self, x: Float[Tensor, "n D"], generator: torch.Generator) -> Mixture:
        fitted = self._require_fit("predict")
        rows = fitted.inputs(x).float().expand(self.num_members, -1, -1)
        mean, logvar = predict(fitted.network, rows)
        return Mixture(mean.double(), logvar.double().exp())

    def state_dict(self) -> StateDict:
        """Networks, input normaliser and what Adam remembers; empty before the first fit."""
        if self._fitted is None:
            return {}
        trained, inputs, noise = self._fitted
        state = trained.state() | {f"inputs.{key}": value for key, value in inputs._asdict().items()}
        return state if noise is None else state | noise.state()

    def load_state_dict(self, state: StateDict) -> None:
        """Restore `state_dict` of a model with the same settings.

        Raises:
            ValueError: an entry is missing or is not what these settings give it; the model stays as it was.
        """
        if not state:
            self._fitted = None
            return

        trained = take_trained(state, self._shapes(), self.device)
        inputs = take_normaliser(state, "inputs", self.encoder.input_size, self.device)
        self._fitted = _Fitted(trained, inputs, take_noise_split(state, self.encoder.target_size, self.device))

    def _train(
        self, start: Trained, x: Float[Tensor, "N D"], y: Float[Tensor, "N T"], generator: torch.Generator
    ) -> Learning:
        """Each member from its own bootstrap of the rows."""
        learned, held_out = self.epochs.split(len(x), generator, self.device)
        chosen = torch.randint(len(learned), (self.num_members, len(learned)), generator=generator, device=x.device)

        def of_batch(parameters: Parameters, batch: Int[Tensor, "B m"]) -> Float[Tensor, ""]:
            return loss(Ensemble.from_parameters(parameters), x[batch], y[batch])

        def of_held_out(parameters: Parameters) -> float:
            tested = (rows[held_out].expand(self.num_members, -1, -1) for rows in (x, y))
            return float(misfit(Ensemble.from_parameters(parameters), *tested).mean())

        return self.epochs.train(
            start,
            learned[chosen],
            of_batch,
            None if held_out is None else of_held_out,
            generator,
            # Adam's own decay adds decay * W to the gradient, that of decay / 2 |W|^2, without a pass of its own.
            options={f"layers.{i}.weight": {"weight_decay": decay} for i, decay in enumerate(self.weight_decay)},
            on_progress=self.on_progress,
        )

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of every parameter."""
        shapes: dict[str, tuple[int, ...]] = {}
        for i, (inputs, outputs) in enumerate(self.sizes):
            shapes[f"layers.{i}.weight"] = (self.num_members, inputs, outputs)
            shapes[f"layers.{i}.bias"] = (self.num_members, 1, outputs)
        return shapes | dict.fromkeys(("max_logvar", "min_logvar"), (self.encoder.target_size,))


def _unit(size: int, device: torch.device) -> Normaliser:
    """The identity: the targets are not standardised."""
    return Normaliser(*(torch.full((size,), value, dtype=torch.float64, device=device) for value in (0.0, 1.0)))
