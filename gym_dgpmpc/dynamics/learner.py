"""The base of models that are fitted to encoded transitions: the encoding, and whether there was a fit yet."""

from typing import ClassVar, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.forks import compute_on_one_thread_in_children
from gym_dgpmpc.types import ObservationSpec, ProgressFn, Transitions

Fitted = TypeVar("Fitted")


class Learner(Generic[Fitted]):
    """Base of a `DynamicsModel` that keeps what a fit left in ``_fitted``.

    Transitions and states of rollouts may be float64: see `takes_float64`.

    Args:
        observation_size: S.
        action_size: A.
        observation_spec: how to read the observation.
        dtype: precision of rollouts.
        device: where tensors live.

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
    ):
        self.encoder = Encoder(observation_size, action_size, observation_spec)
        self.dtype, self.device = dtype, torch.device(device)
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

    def _require_fit(self, verb: str) -> Fitted:
        if self._fitted is None:
            raise RuntimeError(f"cannot {verb}: the dynamics model has not been fitted yet, call fit first")
        return self._fitted
