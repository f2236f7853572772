"""The dynamics model of PETS: an ensemble of probabilistic networks, each trained on a resampling of the data.

Chua et al. (2018), "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models". The
networks are in `network.py`, the draws in `draws.py`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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
    layer_sizes,
    loss,
    misfit,
    predict,
)
from gym_dgpmpc.dynamics.gaussian_draws import GaussianSampler
from gym_dgpmpc.dynamics.learner import Learner
from gym_dgpmpc.dynamics.noise import NoiseSplit, observed, take_noise_split
from gym_dgpmpc.dynamics.predictive import Mixture
from gym_dgpmpc.dynamics.state import take_normaliser, take_tensors
from gym_dgpmpc.inference.adam import adam_memory
from gym_dgpmpc.types import ObservationSpec, StateDict, Transitions, TransitionSampler


class _Moments(NamedTuple):
    """What Adam remembers of one parameter between two trainings."""

    first: Tensor
    second: Tensor


class _Fitted(NamedTuple):
    network: Ensemble
    inputs: Normaliser
    moments: dict[str, _Moments]
    num_updates: int  # Adam steps over all trainings
    noise: NoiseSplit | None = None  # None: not told apart


class _Best(NamedTuple):
    """The epoch of a training after which held-out data were likeliest, and the networks then."""

    misfit: float
    epoch: int
    parameters: dict[str, Tensor]
    moments: dict[str, _Moments]
    num_updates: int


HELD_OUT = 0.1
"""The share of the transitions that ``patience`` holds out."""


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
        check_counts(
            num_members=num_members,
            num_hidden_layers=num_hidden_layers,
            hidden_size=hidden_size,
            batch_size=batch_size,
            num_epochs=num_epochs,
        )
        if patience is not None:
            check_counts(patience=patience)
        if len(weight_decay) != num_hidden_layers + 1 or not all(0 <= decay < math.inf for decay in weight_decay):
            raise ValueError(
                f"weight_decay must hold one number of at least 0 for each layer: {num_hidden_layers} for the hidden "
                f"layers and one for the last, received {weight_decay}"
            )
        if not 0 < learning_rate < math.inf:
            raise ValueError(f"learning_rate must be positive, received {learning_rate}")
        if draw not in PROPAGATIONS:
            raise ValueError(f"unknown draw {draw!r}: expected one of {', '.join(PROPAGATIONS)}")
        noise = {"add_noise": add_noise, "split_noise": split_noise}
        super().__init__(observation_size, action_size, observation_spec, dtype, device, **noise)
        self.num_members, self.weight_decay, self.learning_rate = num_members, tuple(weight_decay), learning_rate
        self.batch_size, self.num_epochs, self.patience, self.draw_kind = batch_size, num_epochs, patience, draw
        self.sizes = layer_sizes(self.encoder.input_size, num_hidden_layers, hidden_size, self.encoder.target_size)
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
            network = initial_ensemble(self.num_members, self.sizes, generator, self.device)
            moments, updates = dict[str, _Moments](), 0
        else:
            network, _, moments, updates, _ = self._fitted
        trained, last_loss, iterations = self._train(network, moments, updates, inputs, x, y, generator)

        @torch.no_grad()
        def predicted(x: Tensor) -> Prediction:
            return predict(trained.network, x.float().expand(self.num_members, -1, -1))

        mean, logvar = predicted(x)
        normalisers, aleatoric = (inputs, _unit(y.shape[1], self.device)), logvar.exp().mean((0, 1))
        noise = self._split_noise(data, normalisers, lambda x: predicted(x).mean.mean(0).double(), aleatoric)
        self._fitted = trained._replace(noise=noise)
        return {
            "loss": last_loss,
            "iterations": float(iterations),
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
        network, inputs, moments, num_updates, noise = self._fitted
        state: StateDict = {**network.parameters(), "adam.num_updates": num_updates}
        state |= {f"inputs.{key}": value for key, value in inputs._asdict().items()}
        for name, pair in moments.items():
            state |= {f"adam.{name}.{key}": value for key, value in pair._asdict().items()}
        return state if noise is None else state | noise.state()

    def load_state_dict(self, state: StateDict) -> None:
        """Restore `state_dict` of a model with the same settings.

        Raises:
            ValueError: an entry is missing or is not what these settings give it; the model stays as it was.
        """
        if not state:
            self._fitted = None
            return

        shapes = self._shapes()
        device, single = self.device, torch.float32
        network = Ensemble.from_parameters(take_tensors(state, shapes, device, single))
        inputs = take_normaliser(state, "inputs", self.encoder.input_size, device)
        moments = {
            name: _Moments(
                **take_tensors(state, dict.fromkeys(_Moments._fields, shape), device, single, prefix=f"adam.{name}.")
            )
            for name, shape in shapes.items()
        }
        num_updates = state.get("adam.num_updates")
        if not isinstance(num_updates, int) or num_updates < 1:
            raise ValueError(
                f"dynamics state 'adam.num_updates': expected a positive integer, received {num_updates!r}"
            )
        noise = take_noise_split(state, self.encoder.target_size, device)
        self._fitted = _Fitted(network, inputs, moments, num_updates, noise)

    def _train(
        self,
        network: Ensemble,
        moments: dict[str, _Moments],
        num_updates: int,
        inputs: Normaliser,
        x: Float[Tensor, "N D"],
        y: Float[Tensor, "N T"],
        generator: torch.Generator,
    ) -> tuple[_Fitted, float, int]:
        """Every member's own bootstrap, shuffled for each epoch; the mean loss of the last one, and the steps made."""
        parameters = {name: value.clone().requires_grad_() for name, value in network.parameters().items()}
        network = Ensemble.from_parameters(parameters)
        # Adam's own decay adds decay * W to the gradient, the gradient of decay / 2 |W|^2, without a pass of its own.
        groups: list[dict[str, Any]] = [
            {"params": [weight], "weight_decay": decay}
            for weight, decay in zip(network.weights, self.weight_decay, strict=True)
        ]
        groups.append({"params": [*network.biases, network.max_logvar, network.min_logvar]})
        adam = torch.optim.Adam(groups, lr=self.learning_rate)
        for name, parameter in parameters.items():
            adam.state[parameter] = adam_memory(parameter, num_updates, moments.get(name))
        learned, held_out = self._split(len(x), generator)
        before = num_updates
        chosen = torch.randint(len(learned), (self.num_members, len(learned)), generator=generator, device=x.device)
        rows, best = learned[chosen], _Best(math.inf, 0, {}, {}, num_updates)
        for epoch in range(self.num_epochs):
            order = torch.rand(rows.shape, generator=generator, dtype=torch.float32, device=x.device).argsort(1)
            losses = []
            for batch in rows.gather(1, order).split(self.batch_size, dim=1):
                with torch.enable_grad():
                    value = loss(network, x[batch], y[batch])
                adam.zero_grad()
                value.backward()
                adam.step()
                losses.append(value.detach())
                num_updates += 1
            if self.on_progress is not None:
                self.on_progress(epoch + 1, self.num_epochs, float(torch.stack(losses).mean()))
            if held_out is None:
                continue
            with torch.no_grad():
                tested = float(misfit(network, *(t[held_out].expand(self.num_members, -1, -1) for t in (x, y))).mean())
            if tested < best.misfit:
                best = _Best(tested, epoch, *_copies(parameters, adam), num_updates)
            if epoch - best.epoch == self.patience:
                break
        if held_out is None or not best.parameters:  # no epoch was better than none: its loss was not finite
            best = _Best(math.nan, epoch, *_copies(parameters, adam), num_updates)
        trained = Ensemble.from_parameters(best.parameters)
        fitted = _Fitted(trained, inputs, best.moments, best.num_updates)
        return fitted, float(torch.stack(losses).mean()), num_updates - before

    def _split(self, num_rows: int, generator: torch.Generator) -> tuple[Int[Tensor, "n"], Int[Tensor, "h"] | None]:
        """Rows to learn from, and those held out; None where nothing is, for want of patience or of rows."""
        count = int(HELD_OUT * num_rows)
        if self.patience is None or count == 0:
            return torch.arange(num_rows, dtype=torch.int64, device=self.device), None
        order = torch.randperm(num_rows, generator=generator, device=self.device)
        return order[count:], order[:count]

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of every parameter."""
        shapes: dict[str, tuple[int, ...]] = {}
        for i, (inputs, outputs) in enumerate(self.sizes):
            shapes[f"layers.{i}.weight"] = (self.num_members, inputs, outputs)
            shapes[f"layers.{i}.bias"] = (self.num_members, 1, outputs)
        return shapes | dict.fromkeys(("max_logvar", "min_logvar"), (self.encoder.target_size,))


def _copies(
    parameters: Mapping[str, Tensor], adam: torch.optim.Optimizer
) -> tuple[dict[str, Tensor], dict[str, _Moments]]:
    """The parameters as they are now, and what Adam remembers of them."""
    moments = {
        name: _Moments(adam.state[value]["exp_avg"].clone(), adam.state[value]["exp_avg_sq"].clone())
        for name, value in parameters.items()
    }
    return {name: value.detach().clone() for name, value in parameters.items()}, moments


def _unit(size: int, device: torch.device) -> Normaliser:
    """The identity: the targets are not standardised."""
    return Normaliser(*(torch.full((size,), value, dtype=torch.float64, device=device) for value in (0.0, 1.0)))
