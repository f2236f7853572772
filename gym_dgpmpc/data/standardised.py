"""Standardised inputs and targets, as the models train on them.

Between `normaliser.py`, which makes them, and what trains: `inference/` and `dynamics/`.
"""

from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor


class Data(NamedTuple):
    """Standardised inputs and targets, float64."""

    x: Float[Tensor, "N D"]
    y: Float[Tensor, "N T"]

    @property
    def num_rows(self) -> int:
        """N."""
        return self.x.shape[0]

    def rows(self, index: Int[Tensor, "n"]) -> "Data":
        """Some of the rows."""
        return Data(self.x.index_select(0, index), self.y.index_select(0, index))


@runtime_checkable
class DataSource(Protocol):
    """Where minibatches come from: `Data`, or something that standardises only the rows that are asked for."""

    @property
    def num_rows(self) -> int: ...

    def rows(self, index: Int[Tensor, "n"]) -> Data: ...
