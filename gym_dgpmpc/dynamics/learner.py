"""The base of models that are fitted to encoded transitions: the encoding, and whether there was a fit yet."""

from collections.abc import Callable
from typing import ClassVar, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.noise import NoiseSplit, split_noise
from gym_dgpmpc.dynamics.predictive import Mixture, Predictive
from gym_dgpmpc.forks import compute_on_one_thread_in_children
from gym_dgpmpc.types import ObservationSpec, ProgressFn, Transitions

Fitted = TypeVar("Fitted")

ROWS_AT_ONCE = 1000
"""Transitions that `predictive` looks at together, so that memory stays small."""


class Learner(Generic[Fitted]):
    """Base of a `DynamicsModel` that keeps what a fit left in ``_fitted``.

    Transitions and states of rollouts may be float64: see `takes_float64`.

    Args:
        observation_size: S.
        action_size: A.
        observation_spec: how to read the observation.
        dtype: precision of rollouts.
        device: where tensors live.
        add_noise: draw the fitted noise too.
        split_noise: of that, draw apart what only blurs the observation; see `noise.py`.

    Attributes:
        on_progress: see `ReportsProgress`.
    """

    takes_float64: ClassVar[bool] = True
    """Whether observations may come as float64, where float32 would hide their changes; states then are float64."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        observation_spec: ObservationSpec | None,
        dtype: torch.dtype,
        device: torch.device | str,
        *,
        add_noise: bool = False,
        split_noise: bool = False,
    ):
        self.encoder = Encoder(observation_size, action_size, observation_spec)
        self.dtype, self.device = dtype, torch.device(device)
        self.add_noise, self.split_noise = add_noise, split_noise
        self._fitted: Fitted | None = None
        self.on_progress: ProgressFn | None = None
        compute_on_one_thread_in_children()

    def _encode(self, data: Transitions) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N T"]]:
        """Inputs and targets, in raw units and double precision.

        Raises:
            ValueError: there are no transitions.
        """
        if len(data.observation) == 0:
            raise ValueError("cannot fit a dynamics model to 0 transitions")
        observation, action, after = (t.to(self.device, torch.float64) for t in data)
        return self.encoder.inputs(observation, action), self.encoder.targets(observation, after)

    def _standardised(self, data: Transitions) -> tuple[tuple[Normaliser, Normaliser], Data]:
        """The standardisation of inputs and targets that these transitions give, and what they then are.

        Raises:
            ValueError: there are no transitions.
        """
        x, y = self._encode(data)
        magnitudes = self.encoder.target_magnitudes(data.observation, data.next_observation)
        precision = data.observation.dtype
        inputs = Normaliser.fit(x, precision=precision)
        targets = Normaliser.fit(y, magnitudes.to(y), precision)
        return (inputs, targets), Data(inputs(x), targets(y))

    def _split_noise(
        self,
        data: Transitions,
        normalisers: tuple[Normaliser, Normaliser],
        predict: Callable[[Float[Tensor, "n D"]], Float[Tensor, "n T"]],
        variance: Float[Tensor, "T"],
    ) -> NoiseSplit | None:
        """What the data say of the fitted noise; None where draws do not ask for it.

        Args:
            data: what was fitted to.
            normalisers: of inputs and targets.
            predict: the posterior mean, standardised, float64 in and out.
            variance: of the noise, standardised.
        """
        if not (self.add_noise and self.split_noise):
            return None
        inputs, targets = normalisers
        return split_noise(
            data,
            self.encoder,
            lambda raw: targets.inverse(predict(inputs(raw))),
            variance.double() * targets.std.square(),
        )

    def _drawn_noise(self, found: NoiseSplit | None) -> NoiseSplit:
        """What of the fitted noise to draw, by the settings; ``found`` is None where nothing was told apart."""
        if self.add_noise and self.split_noise and found is not None:
            return found
        return NoiseSplit.all_process(self.encoder.target_size, self.device, share=float(self.add_noise))

    def _noise_metrics(
        self, found: NoiseSplit | None, targets: Normaliser, variance: Float[Tensor, "T"]
    ) -> dict[str, float]:
        """Both parts of the noise, in units of the targets' standardisation; nothing where they are not told apart."""
        return {} if found is None else found.metrics(variance.double() * targets.std.square(), targets.std)

    @torch.no_grad()
    def predictive(self, data: Transitions, generator: torch.Generator) -> Predictive:
        """What the model expects after these observations and actions, its noise included, whatever draws leave out.

        Args:
            data: transitions, raw units; their next observations serve for ``log_density`` alone.
            generator: of posterior samples, where the model has any.

        Raises:
            RuntimeError: the model was not fitted.
            ValueError: there are no transitions.
            NotImplementedError: the model's class has no predictive density.
        """
        self._require_fit("predict")
        x, y = self._encode(data)
        by_rows = [
            self._mixture(rows, generator).predictive(target)
            for rows, target in zip(x.split(ROWS_AT_ONCE), y.split(ROWS_AT_ONCE), strict=True)
        ]
        return Predictive(*(torch.cat(parts) for parts in zip(*by_rows, strict=True)))

    def _mixture(self, x: Float[Tensor, "n D"], generator: torch.Generator) -> Mixture:
        """The predictive density of the targets, both in raw units, float64; a model that only plans needs none."""
        name = type(self).__name__
        raise NotImplementedError(f"{name} has no predictive density: define {name}._mixture")

    def _require_fit(self, verb: str) -> Fitted:
        if self._fitted is None:
            raise RuntimeError(f"cannot {verb}: the dynamics model has not been fitted yet, call fit first")
        return self._fitted
