"""The paper's dynamics model: a deep Gaussian process over transitions, sampled by SG-HMC.

Prepares data for `inference/`, keeps what it returns (for each of some chains hyperparameters, where it is, and a pool
of posterior samples), and makes the draws of `draws.py` from the pool: each particle is of another chain. The agent
calls `fit` at an episode's start, `resample` after each control step and `draw` for each plan.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.bounds import SeenTargets
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.deep_gp import compiled_rollout
from gym_dgpmpc.dynamics.deep_gp.draws import (
    DRAWS,
    REFRESHES,
    CompiledPathwiseSampler,
    ConditionalSampler,
    Draw,
    PathwiseSampler,
    Posterior,
    Refresh,
)
from gym_dgpmpc.dynamics.deep_gp.fitted import Fitted, FittedSizes, take_fitted
from gym_dgpmpc.dynamics.deep_gp.start import initial_model, relocate, restandardise
from gym_dgpmpc.dynamics.learner import Learner
from gym_dgpmpc.dynamics.noise import observed
from gym_dgpmpc.dynamics.predictive import Mixture
from gym_dgpmpc.errors import FactorisationError
from gym_dgpmpc.gp.deep_gp import Factorised, factorise_all, posterior_mean, propagate
from gym_dgpmpc.gp.kernels import Kernel, KernelName, find_kernel
from gym_dgpmpc.inference import sghmc, training
from gym_dgpmpc.inference.following import Follower
from gym_dgpmpc.inference.settings import InferenceSettings
from gym_dgpmpc.types import ObservationSpec, Scales, StateDict, Transitions, TransitionSampler


class _Standardised(NamedTuple):
    """A `DataSource` that encodes and standardises only the rows that are asked for: cost independent of N."""

    encode: Callable[[Transitions], tuple[Tensor, Tensor]]
    transitions: Transitions
    normalisers: tuple[Normaliser, Normaliser]

    @property
    def num_rows(self) -> int:
        return self.transitions.observation.shape[0]

    def rows(self, index: Tensor) -> Data:
        if len(index) == 0:  # which encoding refuses
            return Data(*(normaliser.mean.new_empty(0, len(normaliser.mean)) for normaliser in self.normalisers))
        # The store is on the CPU, whatever the model's device.
        picked = index.to(self.transitions.observation.device)
        x, y = self.encode(Transitions(*(field[picked] for field in self.transitions)))
        return Data(self.normalisers[0](x), self.normalisers[1](y))


class DeepGPDynamics(Learner[Fitted]):
    """Implements `DynamicsModel` with a deep Gaussian process of L layers.

    Args:
        observation_size: numbers in an observation, S.
        action_size: numbers in an action, A.
        observation_spec: how to read the observation.
        num_layers: layers of the deep GP, L; with 1 it is an ordinary sparse GP.
        kernel: covariance function of every layer, from the smoothest functions to the roughest: rbf, matern72,
            matern52, matern32 or matern12.
        linear: add a linear part to the last layer's kernel, whose slopes are inferred with all else: far from all
            data the model goes on along a line, instead of back to the mean.
        num_inducing: inducing points per layer, M; more of them follow finer detail and cost more time.
        draw: how a world is drawn from the posterior: "pathwise" (whole functions), "joint" (values, jointly over the
            candidate sequences, as in the paper) or "marginal" (values, each candidate on its own).
        refresh: when a particle of a "pathwise" draw gets a new function: at each "step" of a plan, or once per "plan".
        num_features: random features of a "pathwise" draw, F, an even number; the error of its prior covariance falls
            as F^-1/2.
        first_training_iterations: training iterations of the first fit, each with one SG-HMC step and, unless
            ``hyperparameters_every`` says otherwise, one of the hyperparameters.
        training_iterations: training iterations of each later fit, which goes on from the fit before.
        num_chains: chains of the sampler, C, with hyperparameters and inducing inputs of their own; particles are
            spread over them.
        num_samples: posterior samples kept (the pool), over all chains, rounded up to as many of each; the worlds of a
            plan are drawn from them.
        sample_spacing: SG-HMC steps between two samples of the pool; more of them make the samples less alike.
        resample_samples: samples of each chain that are replaced after each control step, by exact draws of the last
            layer given the new data too; 0 keeps the posterior as it is within an episode.
        relocate: move the inducing inputs to the cluster centres of the grown data before each later fit.
        add_noise: draw the fitted noise too, so that plans reckon with it; without it, as in the paper, worlds are the
            function alone.
        split_noise: where ``add_noise`` is on, tell the sensors' noise, which only blurs what is observed, from the
            process's, which adds up over a plan, as far as the data show it; otherwise all of it adds up.
        compile: train, and roll "pathwise" draws out, in compiled code, several times faster; a C++ compiler builds it
            once in a few seconds. PyTorch does it where there is no compiler, on a GPU, and for kernels of your own.
        dtype: precision of rollouts; training and every factorisation are in float64.
        device: where tensors live.
        **inference: the settings of `InferenceSettings`, each as a keyword argument of its own.

    Attributes:
        draw_kind: the setting ``draw``; `draw` is the method.

    Raises:
        TypeError: a setting is unknown.
        ValueError: a setting is out of its range.
    """

    composed_of: ClassVar[tuple[type, ...]] = (InferenceSettings,)
    """Classes whose settings the constructor takes as keyword arguments too."""
    largest: ClassVar[Mapping[str, int]] = MappingProxyType({"num_layers": 100, "num_features": 10**5})
    """What a file may claim; see `settings.settings_of`."""
    unsaved: ClassVar[tuple[str, ...]] = ("compile",)
    """Settings that depend on the machine, so that no file holds them."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        observation_spec: ObservationSpec | None = None,
        *,
        num_layers: int = 2,
        kernel: KernelName = "matern32",
        linear: bool = False,
        num_inducing: int = 100,
        draw: Draw = "pathwise",
        refresh: Refresh = "plan",
        num_features: int = 64,
        first_training_iterations: int = 1000,
        training_iterations: int = 300,
        num_chains: int = 5,
        num_samples: int = 100,
        sample_spacing: int = 20,
        resample_samples: int = 5,
        relocate: bool = True,
        add_noise: bool = True,
        split_noise: bool = True,
        compile: bool = True,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        **inference: Any,
    ):
        check_counts(
            num_layers=num_layers,
            num_inducing=num_inducing,
            num_features=num_features,
            first_training_iterations=first_training_iterations,
            training_iterations=training_iterations,
            num_chains=num_chains,
            num_samples=num_samples,
            sample_spacing=sample_spacing,
        )
        if num_features % 2:
            raise ValueError(
                f"num_features must be even, a cosine and a sine of each frequency: received {num_features}"
            )
        if resample_samples < 0:
            raise ValueError(f"resample_samples must be at least 0, received {resample_samples}")
        if draw not in DRAWS:
            raise ValueError(f"unknown draw {draw!r}: expected one of {', '.join(DRAWS)}")
        if refresh not in REFRESHES:
            raise ValueError(f"unknown refresh {refresh!r}: expected one of {', '.join(REFRESHES)}")
        noise = {"add_noise": add_noise, "split_noise": split_noise}
        super().__init__(observation_size, action_size, observation_spec, dtype, device, **noise)
        self.kernel: Kernel = find_kernel(kernel)
        self.num_layers, self.linear = num_layers, linear
        self.num_inducing, self.num_features = num_inducing, num_features
        self.draw_kind, self.refresh = draw, refresh
        self.first_training_iterations, self.training_iterations = first_training_iterations, training_iterations
        self.num_chains, self.num_samples, self.sample_spacing = num_chains, num_samples, sample_spacing
        self._samples_of_chain = -(-num_samples // num_chains)
        self.relocate = relocate
        self.resample_samples = min(resample_samples, self._samples_of_chain)
        self.inference = InferenceSettings(**inference)
        self._follower: Follower | None = None  # of what was fitted, once it is followed
        self.compile = compile

    def fit(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Train all chains on all transitions, then take a fresh pool of posterior samples from them.

        The first fit starts from the data, later ones from the present posterior.

        Raises:
            ValueError: there are no transitions.
            TrainingError: training diverged with ever smaller steps; the model is as it was.
        """
        normalisers, standardised = self._standardised(data)
        if self._fitted is None:
            iterations, settled = self.first_training_iterations, False
            sizes = self.num_layers, self.num_inducing, self.num_chains
            model = initial_model(self.kernel, standardised, *sizes, generator, linear=self.linear)
            whitened = sghmc.init(standardised.x.new_zeros(self.num_chains, model.num_whitened()))
        else:
            iterations, settled, last = self.training_iterations, True, self._fitted
            model, position = restandardise(last.factorised.model, last.chain.position, last.normalisers, normalisers)
            if self.relocate:
                model, position = relocate(model, position, standardised, generator)
            whitened = last.chain._replace(position=position, momentum=torch.zeros_like(position))
        samples, spacing = self._samples_of_chain, self.sample_spacing
        total, report = iterations + samples * spacing, self.on_progress or _report_nothing
        trained = training.train(
            model,
            whitened,
            standardised,
            iterations,
            generator,
            self.inference,
            settled=settled,
            compile=self.compile,
            on_look=lambda done, loss: report(done, total, loss),
        )
        sampled = training.sample_pool(
            trained.model,
            trained.state,
            standardised,
            samples,
            spacing,
            generator,
            self.inference,
            trained.scale,
            lambda count: report(iterations + count * spacing, total, trained.negative_log_likelihood),
            compile=self.compile,
        )
        factorised = factorise_all(trained.model)
        variance = factorised.model.noise_variance.mean(0)
        noise = self._split_noise(data, normalisers, posterior_mean(factorised, sampled.pool), variance)
        latents = [latent.float() for latent in sampled.state.latents]
        self._follower = None
        seen = SeenTargets.of(standardised.y)
        self._fitted = Fitted(factorised, normalisers, sampled.state.whitened, latents, sampled.pool, 0, seen, noise)
        counts = {"iterations": float(trained.num_iterations), "rollbacks": float(trained.num_rollbacks)}
        metrics = {"negative_log_likelihood": trained.negative_log_likelihood} | counts
        return metrics | self._fitted.diagnostics() | self._noise_metrics(noise, normalisers[1], variance)

    def resample(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Follow the grown data: in every chain exact draws of the last layer replace the oldest samples.

        Hyperparameters and inner layers stay as they are until the next fit; steps may become as large as the new ones.
        Where the new data make the posterior impossible to compute, all stays as it was.

        Returns:
            ``resamplings_dropped``: 1 if that happened, otherwise 0; an empty mapping if there is nothing to replace.

        Raises:
            RuntimeError: the model was not fitted.
        """
        fitted = self._require_fit("resample")
        if self.resample_samples == 0:
            return {}
        position, inner = fitted.chain.position, fitted.factorised.model.num_inner()
        if self._follower is None:
            self._follower = Follower(fitted.factorised.model, position[:, :inner], compile=self.compile)
        standardised = _Standardised(self._encode, data, fitted.normalisers)
        count = self._samples_of_chain
        try:
            newest, latents, targets = self._follower.follow(
                position, standardised, fitted.latents, self.resample_samples, generator
            )
        except FactorisationError:
            return {"resamplings_dropped": 1.0}
        rows = (fitted.oldest + torch.arange(len(newest), dtype=torch.int64, device=self.device)) % count
        fitted.pool[rows] = newest
        chain, oldest = fitted.chain._replace(position=newest[-1]), (fitted.oldest + len(newest)) % count
        seen = fitted.seen.and_of(targets)
        self._fitted = fitted._replace(chain=chain, latents=latents, oldest=oldest, seen=seen)
        return {"resamplings_dropped": 0.0}

    def draw(self, num_particles: int, horizon: int, generator: torch.Generator) -> TransitionSampler:
        """Worlds for plans of ``horizon`` steps: particles are spread over the chains, each a sample of its chain.

        Raises:
            RuntimeError: the model was not fitted.
        """
        fitted = self._require_fit("draw")
        chain, row = self._pick(num_particles, generator)
        model = fitted.factorised.model.at(chain)
        factorised = Factorised(model, [factor[chain] for factor in fitted.factorised.factors])
        posterior = Posterior(factorised, model.split(fitted.pool[row, chain]))
        coordinates = Coordinates(self.encoder, *fitted.normalisers, self.dtype, fitted.seen)
        drawn = self._drawn_noise(fitted.noise)
        process_std = (model.noise_variance * drawn.process_share).sqrt() if self.add_noise else None
        blur = drawn.observation(self.encoder)
        if self.draw_kind == "pathwise":
            settings = posterior, coordinates, horizon, self.num_features, self.refresh
            noise = None if process_std is None else (process_std, blur)
            single = self.dtype == torch.float32 and self.device.type == "cpu"
            if self.compile and single and compiled_rollout.is_available(self.kernel):
                return CompiledPathwiseSampler(*settings, generator, noise)
            return PathwiseSampler(*settings, self.dtype, generator, noise)
        joint = self.draw_kind == "joint"
        sampler = ConditionalSampler(posterior, coordinates, generator, joint=joint, noise_std=process_std)
        return observed(sampler, blur, generator)

    def _mixture(self, x: Float[Tensor, "n D"], generator: torch.Generator) -> Mixture:
        """Over all samples of the pool, with one draw through the inner layers for each."""
        fitted = self._require_fit("predict")
        inputs, targets = fitted.normalisers
        model, whitened = fitted.factorised.model, fitted.factorised.model.split(fitted.pool)
        moments = []
        for row in range(self._samples_of_chain):
            points = inputs(x).expand(self.num_chains, -1, -1)
            moments.append(propagate(fitted.factorised, [v[row] for v in whitened], points, generator))
        mean, variance = (torch.cat(parts) for parts in zip(*moments, strict=True))
        noise = model.noise_variance.repeat(self._samples_of_chain, 1).unsqueeze(1)
        variance = variance.unsqueeze(-1) + noise
        return Mixture(targets.inverse(mean), variance * targets.std.square())

    def _pick(self, num_particles: int, generator: torch.Generator) -> tuple[Int[Tensor, "P"], Int[Tensor, "P"]]:
        """A chain and a row of the pool for each particle, as different as may be."""

        def spread_over(count: int, rounds: int) -> Int[Tensor, "P"]:
            orders = [torch.randperm(count, generator=generator, device=self.device) for _ in range(rounds)]
            return torch.cat(orders)

        chains, samples = self.num_chains, self._samples_of_chain
        rounds = math.ceil(num_particles / chains)
        chain = spread_over(chains, rounds)[:num_particles]
        # Every round over the chains has a row of its own for each of them, and they begin at rows of their own.
        rows = torch.stack([spread_over(samples, math.ceil(rounds / samples))[:rounds] for _ in range(chains)], dim=1)
        return chain, rows[torch.arange(num_particles, dtype=torch.int64, device=self.device) // chains, chain]

    def diagnostics(self) -> dict[str, float]:
        """Mixing of the samples that are kept now, noise and kernel scales; see `Fitted.diagnostics`."""
        return {} if self._fitted is None else self._fitted.diagnostics()

    def scales(self) -> Scales | None:
        """See `ReportsScales`."""
        return None if self._fitted is None else self._fitted.scales()

    def state_dict(self) -> StateDict:
        """Hyperparameters, normalisers, the chain and the whole pool of samples; empty before the first fit."""
        if self._fitted is None:
            return {}
        return self._fitted.state_dict()

    def load_state_dict(self, state: StateDict) -> None:
        """Restore `state_dict` of a model with the same settings.

        Raises:
            ValueError: an entry is missing or is not what these settings give it; the model stays as it was.
        """
        if not state:
            self._fitted = self._follower = None
            return
        expected = FittedSizes(
            num_chains=self.num_chains,
            num_layers=self.num_layers,
            num_inducing=self.num_inducing,
            num_samples=self._samples_of_chain,
            num_inputs=self.encoder.input_size,
            num_targets=self.encoder.target_size,
            linear=self.linear,
        )
        self._fitted, self._follower = take_fitted(state, self.kernel, expected, self.device), None


def _report_nothing(done: int, total: int, loss: float) -> None:
    """In place of ``on_progress`` where nobody listens."""
