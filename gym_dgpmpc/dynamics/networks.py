"""What models made of networks share: their layers by name, and training by Adam in epochs.

Adam's memory is kept between two trainings, so that the next one goes on from where the last one ended.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.dynamics.state import take_tensors
from gym_dgpmpc.inference.adam import adam_memory
from gym_dgpmpc.types import ProgressFn, StateDict

HELD_OUT = 0.1
"""The share of the transitions that ``patience`` holds out."""

Parameters = dict[str, Tensor]
"""Every parameter of a model's networks by name."""

_LAYER_FIELDS = ("weight", "bias")


def layer_sizes(
    input_size: int, num_hidden_layers: int, hidden_size: int, num_outputs: int
) -> tuple[tuple[int, int], ...]:
    """Inputs and outputs of every layer."""
    return tuple(pairwise([input_size, *[hidden_size] * num_hidden_layers, num_outputs]))


def initial_weight(
    inputs: int, outputs: int, generator: torch.Generator, device: torch.device, *members: int
) -> Float[Tensor, "*B I O"]:
    """From a normal of standard deviation 1 / (2 sqrt(inputs)), cut off at twice that, as PETS's published code has it.

    Args:
        members: how many networks side by side; nothing for one alone.
    """
    weight = torch.empty(*members, inputs, outputs, dtype=torch.float32, device=device)
    std = 0.5 * inputs**-0.5
    return torch.nn.init.trunc_normal_(weight, 0.0, std, -2 * std, 2 * std, generator=generator)


def named_layers(weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Parameters:
    """The entries "layers.0.weight", "layers.0.bias", and so on."""
    layers = enumerate(zip(weights, biases, strict=True))
    return {f"layers.{i}.{name}": value for i, pair in layers for name, value in zip(_LAYER_FIELDS, pair, strict=True)}


def layers_of(named: Parameters) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Weights and biases, the inverse of `named_layers`; other entries do not matter."""
    count = sum(name.endswith(".weight") for name in named)
    weights, biases = (tuple(named[f"layers.{i}.{name}"] for i in range(count)) for name in _LAYER_FIELDS)
    return weights, biases


class Moments(NamedTuple):
    """What Adam remembers of one parameter between two trainings."""

    first: Tensor
    second: Tensor


class Trained(NamedTuple):
    """Parameters, float32, what Adam remembers of each, and its steps over all trainings."""

    parameters: Parameters
    moments: Mapping[str, Moments]
    num_updates: int

    @classmethod
    def untrained(cls, parameters: Parameters) -> "Trained":
        """Before the first step."""
        return cls(parameters, {}, 0)

    def state(self) -> StateDict:
        """The parameters' entries, and those of Adam, "adam.num_updates" and "adam.<parameter>.first" and "second"."""
        state: StateDict = {**self.parameters, "adam.num_updates": self.num_updates}
        for name, pair in self.moments.items():
            state |= {f"adam.{name}.{key}": value for key, value in pair._asdict().items()}
        return state


def take_trained(state: StateDict, shapes: Mapping[str, tuple[int, ...]], device: torch.device) -> Trained:
    """What `Trained.state` gave, of parameters of these shapes.

    Raises:
        ValueError: an entry is missing, or is not of its type and shape.
    """
    parameters = take_tensors(state, shapes, device, torch.float32)
    moments = {
        name: Moments(
            **take_tensors(state, dict.fromkeys(Moments._fields, shape), device, torch.float32, prefix=f"adam.{name}.")
        )
        for name, shape in shapes.items()
    }
    num_updates = state.get("adam.num_updates")
    if not isinstance(num_updates, int) or num_updates < 1:
        raise ValueError(f"dynamics state 'adam.num_updates': expected a positive integer, received {num_updates!r}")
    return Trained(parameters, moments, num_updates)


class Learning(NamedTuple):
    """What came of a training: its result, the mean loss of its last epoch, and the steps made."""

    trained: Trained
    last_loss: float
    num_steps: int


class _Best(NamedTuple):
    """The epoch of a training after which held-out data were likeliest, and what was trained then."""

    misfit: float
    epoch: int
    trained: Trained


class Epochs(NamedTuple):
    """How to train.

    Attributes:
        learning_rate: of Adam.
        batch_size: transitions in a minibatch of each network.
        num_epochs: passes over the data; with ``patience`` the most of them.
        patience: epochs in a row without a better likelihood of held-out transitions after which training stops, and
            what the best epoch left is taken; None trains all epochs.
    """

    learning_rate: float
    batch_size: int
    num_epochs: int
    patience: int | None

    def check(self) -> None:
        """Refuse settings that are out of their range.

        Raises:
            TypeError, ValueError: naming the setting and its value.
        """
        check_counts(batch_size=self.batch_size, num_epochs=self.num_epochs)
        if self.patience is not None:
            check_counts(patience=self.patience)
        if not 0 < self.learning_rate < math.inf:
            raise ValueError(f"learning_rate must be positive, received {self.learning_rate}")

    def split(
        self, num_rows: int, generator: torch.Generator, device: torch.device
    ) -> tuple[Int[Tensor, "n"], Int[Tensor, "h"] | None]:
        """Rows to learn from, and those held out; None where nothing is, for want of patience or of rows."""
        count = int(HELD_OUT * num_rows)
        if self.patience is None or count == 0:
            return torch.arange(num_rows, dtype=torch.int64, device=device), None
        order = torch.randperm(num_rows, generator=generator, device=device)
        return order[count:], order[:count]

    def train(
        self,
        start: Trained,
        rows: Int[Tensor, "B n"],
        loss: Callable[[Parameters, Int[Tensor, "B m"]], Float[Tensor, ""]],
        misfit: Callable[[Parameters], float] | None,
        generator: torch.Generator,
        *,
        options: Mapping[str, Mapping[str, Any]],
        on_progress: ProgressFn | None,
    ) -> Learning:
        """Take steps down the loss of minibatches, the rows of each network shuffled anew for each epoch.

        Args:
            start: where to go on from.
            rows: of the data that each of B networks learns from.
            loss: of a minibatch.
            misfit: of the rows held out, the less the better; None where there are none.
            generator: of the shuffling.
            options: Adam's own for some parameters by name, such as their "weight_decay".
            on_progress: told of each epoch.
        """
        parameters = {name: value.clone().requires_grad_() for name, value in start.parameters.items()}
        groups: list[dict[str, Any]] = [{"params": [parameters[name]], **own} for name, own in options.items()]
        groups.append({"params": [value for name, value in parameters.items() if name not in options]})
        adam = torch.optim.Adam(groups, lr=self.learning_rate)
        for name, parameter in parameters.items():
            adam.state[parameter] = adam_memory(parameter, start.num_updates, start.moments.get(name))
        num_updates, best = start.num_updates, _Best(math.inf, 0, start)
        for epoch in range(self.num_epochs):
            order = torch.rand(rows.shape, generator=generator, dtype=torch.float32, device=rows.device).argsort(1)
            losses = []
            for batch in rows.gather(1, order).split(self.batch_size, dim=1):
                with torch.enable_grad():
                    value = loss(parameters, batch)
                adam.zero_grad()
                value.backward()
                adam.step()
                losses.append(value.detach())
                num_updates += 1
            if on_progress is not None:
                on_progress(epoch + 1, self.num_epochs, float(torch.stack(losses).mean()))
            if misfit is None:
                continue
            with torch.no_grad():
                tested = misfit(parameters)
            if tested < best.misfit:
                best = _Best(tested, epoch, _trained(parameters, adam, num_updates))
            if epoch - best.epoch == self.patience:
                break
        # Without anything held out the last epoch is taken; so it is where none was better than none: no finite misfit.
        trained = best.trained if best.misfit < math.inf else _trained(parameters, adam, num_updates)
        return Learning(trained, float(torch.stack(losses).mean()), num_updates - start.num_updates)


def _trained(parameters: Parameters, adam: torch.optim.Optimizer, num_updates: int) -> Trained:
    """Copies of the parameters as they are now, and of what Adam remembers of them."""
    moments = {
        name: Moments(adam.state[value]["exp_avg"].clone(), adam.state[value]["exp_avg_sq"].clone())
        for name, value in parameters.items()
    }
    return Trained({name: value.detach().clone() for name, value in parameters.items()}, moments, num_updates)
