"""The Gaussian-process model that PETS is compared with: one sparse layer, trained by the collapsed bound.

Chua et al. (2018) call it GP, with the propagations DS ("distribution sampling") and MM ("moment matching"). The bound
is in `gp/sgpr.py`, its optimisation in `inference/lbfgs.py`, the draws in `gaussian_draws.py` and, with analytic
moments, in `moment_matching.py`.
"""

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.bounds import SeenTargets, take_seen
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.deep_gp.start import restandardise
from gym_dgpmpc.dynamics.gaussian_draws import Gaussian, GaussianSampler
from gym_dgpmpc.dynamics.learner import Learner
from gym_dgpmpc.dynamics.noise import NoiseSplit, observed, take_noise_split
from gym_dgpmpc.dynamics.predictive import Mixture
from gym_dgpmpc.dynamics.sparse_gp.moment_matching import MomentMatchingSampler
from gym_dgpmpc.dynamics.state import normalisers_state, take_normaliser, take_tensor, take_tensors
from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.gp.kernels import RBF, Kernel, KernelName, find_kernel
from gym_dgpmpc.gp.layer import Layer, parameter_shapes
from gym_dgpmpc.gp.moments import Predictor
from gym_dgpmpc.gp.sgpr import SparsePosterior, shrinkage, sparse_posterior, sparse_predict
from gym_dgpmpc.inference.lbfgs import maximise_bound
from gym_dgpmpc.inference.priors import NOISE_VARIANCE
from gym_dgpmpc.types import ObservationSpec, Scales, StateDict, Transitions, TransitionSampler

GPDraw = Literal["DS", "MM", "AMM"]
GP_DRAWS: tuple[GPDraw, ...] = get_args(GPDraw)


class _Fitted(NamedTuple):
    model: DeepGP  # of one layer
    normalisers: tuple[Normaliser, Normaliser]
    posterior: SparsePosterior
    seen: SeenTargets
    noise: NoiseSplit | None = None  # None: not told apart


class SparseGPDynamics(Learner[_Fitted]):
    """Implements `DynamicsModel` with one sparse Gaussian process, its kernel shared by the outputs.

    Inputs and targets are standardised at each training. Inducing inputs start from training inputs drawn at random,
    anew at each training; hyperparameters from where the last training left them.

    Args:
        observation_size: numbers in an observation, S.
        action_size: numbers in an action, A.
        observation_spec: how to read the observation.
        kernel: covariance function, shared by the outputs, from the smoothest functions to the roughest: rbf, matern72,
            matern52, matern32 or matern12.
        num_inducing: inducing points, M; more of them follow finer detail and cost more time. While there are fewer
            transitions than that, each of them is one.
        exact: make every transition an inducing point and keep it there, which is the exact Gaussian process up to the
            jitter; for small data, since the cost grows with the cube of their number.
        max_training_iterations: iterations of the optimiser, L-BFGS, in each training, at most.
        draw: how particles move: "DS", each by its own draw from the Gaussian at its place; "MM", as DS, then the
            particles of a candidate are replaced by draws from their mean and variance; "AMM", a Gaussian per
            candidate through its exact moments (kernel "rbf", more particles than an observation has numbers).
        add_noise: draw the fitted noise too, so that plans reckon with it: for plants or sensors that are noisy.
        split_noise: where ``add_noise`` is on, tell the sensors' noise, which only blurs what is observed, from the
            process's, which adds up over a plan, as far as the data show it; otherwise all of it adds up.
        update_within_episode: condition on each new transition at once, hyperparameters and inducing inputs frozen (if
            exact, each is one more inducing input); PETS does so between episodes only.
        dtype: precision of a rollout's states; the model itself computes in float64.
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
        kernel: KernelName = "rbf",
        num_inducing: int = 200,
        exact: bool = False,
        max_training_iterations: int = 200,
        draw: GPDraw = "DS",
        add_noise: bool = False,
        split_noise: bool = True,
        update_within_episode: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ):
        check_counts(num_inducing=num_inducing, max_training_iterations=max_training_iterations)
        if draw not in GP_DRAWS:
            raise ValueError(f"unknown draw {draw!r}: expected one of {', '.join(GP_DRAWS)}")
        self.kernel: Kernel = find_kernel(kernel)
        if draw == "AMM" and not isinstance(self.kernel, RBF):
            raise ValueError(f"the draw AMM has closed forms for the kernel 'rbf' only, received {kernel!r}")
        if draw == "AMM" and observation_spec is not None and observation_spec.body_frame:
            raise ValueError(
                "the draw AMM has no closed forms for vectors that turn with a heading: use the draw MM, or leave out "
                f"body_frame, received body_frame={observation_spec.body_frame}"
            )
        noise = {"add_noise": add_noise, "split_noise": split_noise}
        super().__init__(observation_size, action_size, observation_spec, dtype, device, **noise)
        self.num_inducing, self.exact = num_inducing, exact
        self.max_training_iterations = max_training_iterations
        self.draw_kind, self.update_within_episode = draw, update_within_episode

    def fit(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Maximise the collapsed bound, then condition on all transitions.

        Raises:
            ValueError: there are no transitions.
        """
        normalisers, standardised = self._standardised(data)
        start = self._start(standardised, normalisers, generator)
        found = maximise_bound(
            start,
            standardised,
            self.max_training_iterations,
            free_inducing_inputs=not self.exact,
            on_progress=self.on_progress,
        )
        variance = found.model.noise_variance
        posterior = sparse_posterior(found.model.layers[0], variance, *standardised)

        def predict(x: Tensor) -> Tensor:
            return sparse_predict(found.model.layers[0], variance, posterior, x)[0]

        noise = self._split_noise(data, normalisers, predict, variance)
        self._fitted = _Fitted(found.model, normalisers, posterior, SeenTargets.of(standardised.y), noise)
        return {
            "bound": found.bound,
            "iterations": float(found.num_iterations),
            "noise_std": float(variance.sqrt().mean()),
            "kernel_std": float(found.model.layers[0].variance.sqrt()),
        } | self._noise_metrics(noise, normalisers[1], variance)

    def resample(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Condition on the grown data if ``update_within_episode``; otherwise do nothing.

        Raises:
            RuntimeError: the model was not fitted.
        """
        fitted = self._require_fit("resample")
        model, normalisers = fitted.model, fitted.normalisers
        if self.update_within_episode:
            x, y = self._encode(data)
            standardised = Data(normalisers[0](x), normalisers[1](y))
            if self.exact:  # the new transitions are inducing points too
                model = model._replace(layers=(model.layers[0]._replace(inducing_inputs=standardised.x),))
            posterior = sparse_posterior(model.layers[0], model.noise_variance, *standardised)
            seen = fitted.seen.and_of(standardised.y)
            self._fitted = fitted._replace(model=model, posterior=posterior, seen=seen)
        return {}

    def draw(self, num_particles: int, horizon: int, generator: torch.Generator) -> TransitionSampler:
        """Particles for plans of ``horizon`` steps.

        Raises:
            RuntimeError: the model was not fitted.
            ValueError: there are too few particles for "AMM".
        """
        model, normalisers, posterior, seen, found = self._require_fit("draw")
        drawn = self._drawn_noise(found)
        noise = model.noise_variance * drawn.process_share
        if self.draw_kind == "AMM":
            predictor, blur = _predictor(model, posterior), drawn.observation(self.encoder)
            return MomentMatchingSampler(predictor, self.encoder, *normalisers, noise, num_particles, generator, blur)

        def predict(x: Tensor) -> Gaussian:
            mean, variance = sparse_predict(model.layers[0], model.noise_variance, posterior, x.double())
            return Gaussian(mean, variance + noise)

        coordinates = Coordinates(self.encoder, *normalisers, self.dtype, seen)
        sampler = GaussianSampler(predict, coordinates, generator, match_moments=self.draw_kind == "MM")
        return observed(sampler, drawn.observation(self.encoder), generator)

    def _mixture(self, x: Float[Tensor, "n D"], generator: torch.Generator) -> Mixture:
        model, (inputs, targets), posterior, *_ = self._require_fit("predict")
        mean, variance = sparse_predict(model.layers[0], model.noise_variance, posterior, inputs(x))
        variance = (variance + model.noise_variance) * targets.std.square()
        return Mixture(targets.inverse(mean).unsqueeze(0), variance.unsqueeze(0))

    def scales(self) -> Scales | None:
        """See `ReportsScales`; there is one chain."""
        if self._fitted is None:
            return None
        model = self._fitted.model
        lengthscales = [layer.lengthscale.unsqueeze(0) for layer in model.layers]
        return Scales(lengthscales, model.noise_variance.sqrt().unsqueeze(0))

    def state_dict(self) -> StateDict:
        """Hyperparameters, normalisers and the posterior; empty before the first fit."""
        if self._fitted is None:
            return {}
        model, normalisers, posterior, seen, noise = self._fitted
        state: StateDict = {**model.layers[0].parameters(), "log_noise": model.log_noise}
        state |= normalisers_state(*normalisers) | seen.state() | ({} if noise is None else noise.state())
        return state | {f"posterior.{key}": value for key, value in posterior._asdict().items()}

    def load_state_dict(self, state: StateDict) -> None:
        """Restore `state_dict` of a model with the same settings.

        Raises:
            ValueError: an entry is missing or is not what these settings give it; the model stays as it was.
        """
        if not state:
            self._fitted = None
            return
        sizes, device = (self.encoder.input_size, self.encoder.target_size), self.device
        # With little data, or if exact, the number of inducing points is the data's.
        received = state.get("inducing_inputs")
        count = len(received) if isinstance(received, Tensor) and received.ndim == 2 else self.num_inducing
        count = count if self.exact else min(count, self.num_inducing)
        layer = Layer(self.kernel, **take_tensors(state, parameter_shapes(count, sizes[0]), device))
        model = DeepGP((layer,), take_tensor(state, "log_noise", (sizes[1],), device))
        normalisers = (
            take_normaliser(state, "inputs", sizes[0], device),
            take_normaliser(state, "targets", sizes[1], device),
        )
        shapes = dict(zip(SparsePosterior._fields, ((count, count), (count,), (count, sizes[1])), strict=True))
        posterior = SparsePosterior(**take_tensors(state, shapes, device, prefix="posterior."))
        seen, noise = take_seen(state, sizes[1], device), take_noise_split(state, sizes[1], device)
        self._fitted = _Fitted(model, normalisers, posterior, seen, noise)

    def _start(self, data: Data, normalisers: tuple[Normaliser, Normaliser], generator: torch.Generator) -> DeepGP:
        """Hyperparameters of the last training in the new standardisation, or fixed ones; fresh inducing inputs."""
        num_data, size = data.x.shape
        rows = torch.randperm(num_data, generator=generator, device=data.x.device)[: self.num_inducing]
        inducing = data.x if self.exact else data.x[rows]
        if self._fitted is None:
            layer = Layer(self.kernel, inducing, data.x.new_full((size,), 0.5 * math.log(size)), data.x.new_zeros(()))
            return DeepGP((layer,), data.y.new_full((data.y.shape[1],), math.log(NOISE_VARIANCE)))
        last = self._fitted
        outputs = data.y.new_zeros(last.model.num_whitened())  # the inducing outputs are not carried over
        model, _ = restandardise(last.model, outputs, last.normalisers, normalisers)
        return model._replace(layers=(model.layers[0]._replace(inducing_inputs=inducing),))


def _predictor(model: DeepGP, posterior: SparsePosterior) -> Predictor:
    """The same predictions, in the form whose moments are known."""
    layer, basis = model.layers[0], posterior.basis
    removed = shrinkage(posterior, model.noise_variance).mT.unsqueeze(-1)
    return Predictor(
        layer.inducing_inputs,
        layer.lengthscale,
        layer.variance,
        basis.mT @ posterior.mean,
        basis.mT @ (removed * basis),
    )
