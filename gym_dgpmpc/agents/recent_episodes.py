"""The episodes that Stable-Baselines3's logged means are over, as tensors for a file.

As plain values they would be most of a file whose window is wide: a line of JSON for every number.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

_INFO, _SUCCESSES = "ep_info.", "ep_successes"


def recent_episodes(agent: Any) -> dict[str, Tensor]:
    """Of an SB3 algorithm's last n episodes: Monitor's numbers, each [n] and NaN where there is none, and successes.

    What else users put into Monitor's summary may not be a number, and is left out.
    """
    infos = agent.ep_info_buffer or ()
    names = {name: None for info in infos for name, value in info.items() if _is_number(value)}
    columns = {_INFO + name: _column(info.get(name) for info in infos) for name in names}
    return columns | {_SUCCESSES: _column(agent.ep_success_buffer or ())}


def restore_recent_episodes(agent: Any, state: dict[str, Tensor]) -> None:
    """Put back what `recent_episodes` gave; other tensors of ``state`` are left alone.

    Raises:
        KeyError, ValueError: the state is none.
    """
    columns = {name.removeprefix(_INFO): value.tolist() for name, value in state.items() if name.startswith(_INFO)}
    infos = [
        {name: value for name, value in zip(columns, row, strict=True) if not math.isnan(value)}
        for row in zip(*columns.values(), strict=True)
    ]
    agent.ep_info_buffer = deque(infos, maxlen=agent.stats_window_size)
    agent.ep_success_buffer = deque(state[_SUCCESSES].tolist(), maxlen=agent.stats_window_size)


def _column(values: Iterable[Any]) -> Tensor:
    return torch.tensor([float(value) if _is_number(value) else math.nan for value in values], dtype=torch.float64)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number | np.bool_)
