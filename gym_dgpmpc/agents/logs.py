"""What an agent logs: the logger of `learn`, the numbers that wait to be written, and the episodes that means are over.

The agent records numbers through Stable-Baselines3's logger; what a run must not lose of them is kept here.
"""

import math
import os
import re
from collections import deque
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.utils import configure_logger, get_latest_run_id, safe_mean
from torch import Tensor

from gym_dgpmpc.checks import saved_count
from gym_dgpmpc.types import StateDict

_INFO, _SUCCESSES = "ep_info.", "ep_successes"


class Waiting(NamedTuple):
    """A number that the logger was given and has not written."""

    name: str
    value: float
    weight: int
    """How many numbers it is the mean of; 0 if it is none."""
    left_out_of: list[str] | None
    """Formats that do not get it."""


class Logs:
    """The logs of one agent.

    Args:
        agent: whose logger and windows of episodes these are.

    Attributes:
        run: the folder under ``tensorboard_log`` that a run with a folder logs in; None of other runs.
    """

    def __init__(self, agent: BaseAlgorithm):
        self._agent = agent
        self._waiting: list[Waiting] = []  # of a checkpoint, for the logger of `learn`
        self.run: str | None = None

    def choose_run(self, tb_log_name: str) -> None:
        """Let a new run log in the next folder of that name, if it logs for TensorBoard at all."""
        if self._agent.tensorboard_log is not None:
            self.run = f"{tb_log_name}_{get_latest_run_id(self._agent.tensorboard_log, tb_log_name) + 1}"

    def keep_waiting(self) -> None:
        """Set aside what the present logger has not written, for the one that `open` makes."""
        self._waiting = self.waiting()

    def open(self, tb_log_name: str, *, begin_anew: bool, in_run: bool) -> Logger:
        """A logger: in the run's folder if there is one, else in the next or the newest folder of that name."""
        agent = self._agent
        verbose = max(agent.verbose - 1, 0)  # SB3 prints its tables at verbose=1; here that is a line per episode
        if not in_run or agent.tensorboard_log is None or self.run is None:
            return configure_logger(verbose, agent.tensorboard_log, tb_log_name, begin_anew)
        formats = ["stdout", "tensorboard"] if verbose else ["tensorboard"]
        return configure(os.path.join(agent.tensorboard_log, self.run), formats)

    def hand_over(self, logger: Logger) -> None:
        """Give a logger what waits."""
        for name, value, weight, left_out_of in self._waiting:
            logger.record(name, value, tuple(left_out_of or ()))
            logger.name_to_count[name] = weight
        self._waiting = []

    def waiting(self) -> list[Waiting]:
        """Numbers that the logger was given since it last wrote."""
        logger = getattr(self._agent, "_logger", None)
        if logger is None:
            return self._waiting
        return [
            Waiting(name, float(value), logger.name_to_count.get(name, 0), logger.name_to_excluded.get(name))
            for name, value in list(logger.name_to_value.items())
            if isinstance(value, int | float | np.number)
        ]

    def record_means(self, logger: Logger) -> None:
        """The means over the latest episodes."""
        agent = self._agent
        if agent.ep_info_buffer:
            logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in agent.ep_info_buffer]))
            logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in agent.ep_info_buffer]))
        if agent.ep_success_buffer:
            logger.record("rollout/success_rate", safe_mean(agent.ep_success_buffer))

    def state_dict(self) -> StateDict:
        """What waits; the run's folder; and of the latest episodes Monitor's numbers, [n] and NaN where one is missing.

        As plain values these would be most of a file whose window is wide: a line of JSON for every number. What else
        users put into Monitor's summary may not be a number, and is left out; so is an episode of which another wrapper
        says neither return nor length as a number.
        """
        infos = [
            info
            for info in self._agent.ep_info_buffer or ()
            if not _column(info.get(name) for name in ("r", "l")).isnan().any()
        ]
        names = {name: None for info in infos for name, value in info.items() if _is_number(value)}
        columns = {_INFO + name: _column(info.get(name) for info in infos) for name in names}
        columns[_SUCCESSES] = _column(self._agent.ep_success_buffer or ())
        waiting = [[*each[:3], None if each[3] is None else list(each[3])] for each in self.waiting()]
        return {"waiting": waiting, "run": self.run, **columns}

    def load_state_dict(self, state: StateDict) -> None:
        """Go on from `state_dict`.

        Raises:
            KeyError, TypeError, ValueError: the state is not one of logs.
        """
        run = state.get("run")
        if run is not None and not re.fullmatch(r"[^./\\][^/\\]{0,200}", run):
            raise ValueError(f"the run's folder of logs must be the name of a folder, got {run!r}")
        self.run = run
        self._waiting = [_waiting(*each) for each in state["waiting"]]
        columns = {name.removeprefix(_INFO): value.tolist() for name, value in state.items() if name.startswith(_INFO)}
        infos = [
            {name: value for name, value in zip(columns, row, strict=True) if not math.isnan(value)}
            for row in zip(*columns.values(), strict=True)
        ]
        if not all({"r", "l"} <= set(info) for info in infos):
            raise ValueError("each of the latest episodes must have a return 'r' and a length 'l'")
        window = self._agent._stats_window_size
        self._agent.ep_info_buffer = deque(infos, maxlen=window)
        self._agent.ep_success_buffer = deque(state[_SUCCESSES].tolist(), maxlen=window)


def _waiting(name: str, value: float, weight: int, left_out_of: list[str] | None) -> Waiting:
    """A number of a file that waits, if it is one."""
    if left_out_of is not None and not all(isinstance(each, str) for each in left_out_of):
        raise ValueError(f"the formats that do not get {name} must be names, got {left_out_of!r}")
    return Waiting(str(name), float(value), saved_count(f"the weight of {name}", weight), left_out_of)


def _column(values: Iterable[Any]) -> Tensor:
    return torch.tensor(
        [float(np.asarray(value).item()) if _is_number(value) else math.nan for value in values],
        dtype=torch.float64,
        device="cpu",
    )


def _is_number(value: Any) -> bool:
    """Whether it is one number; Gymnasium's RecordEpisodeStatistics has arrays of one where rewards are such."""
    is_array_of_one = isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "fiub"
    return is_array_of_one or isinstance(value, int | float | np.number | np.bool_)
