"""What happened in one episode: rewards, plans and their cost, as numbers to log and as one readable line."""

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gym_dgpmpc.types import PlanInfo

METRIC = "metric."
"""Before the names of the planner's own metrics in `EpisodeRecord.state_dict`."""

COMMON = ("expected_return", "predicted_reward_per_step", "obtained_reward_per_step", "num_nonfinite", "num_late")
"""Names logged as ``planner/<name>`` for every planner; a planner's own metrics must have others."""


class EpisodeRecord:
    """Gathers one episode while it runs.

    Args:
        number: counts from 1, the random episode included.
        horizon: H, the steps that a plan's expected return is a sum over.
    """

    def __init__(self, number: int, horizon: int):
        self.number, self.horizon = number, horizon
        self._started, self._cpu_started = time.perf_counter(), time.process_time()
        self.training_iterations = 0
        """Of the trainings since the episode began, in the model's own count; samples taken after them not included."""
        self.rewards: list[float] = []
        self.plans: list[PlanInfo] = []
        self.plan_steps: list[int] = []
        self.plan_seconds: list[float] = []
        self.num_late = 0
        """Plans that took longer than their time budget."""
        self.has_terminated = False

    def add_plan(self, info: PlanInfo, seconds: float, *, late: bool = False) -> None:
        """A plan made before the step whose reward is added next.

        Raises:
            ValueError: a metric of the planner has the name of a value that is logged for every planner.
        """
        taken = [name for name in info.metrics if name in COMMON]
        if taken:
            raise ValueError(f"a planner's metrics must not have the names {COMMON}, got {taken}")
        self.plans.append(info)
        self.plan_steps.append(len(self.rewards))
        self.plan_seconds.append(seconds)
        self.num_late += late

    def add_reward(self, reward: float, *, terminated: bool = False) -> None:
        """The reward of a step, and whether the step ended the episode by termination."""
        self.rewards.append(reward)
        self.has_terminated |= terminated

    @property
    def episode_return(self) -> float:
        return float(np.sum(self.rewards))

    @property
    def seconds(self) -> float:
        """Wall-clock time since the episode began, training included; not the time in which the run was interrupted."""
        return time.perf_counter() - self._started

    @property
    def cpu_seconds(self) -> float:
        """This process's time on the processor, over the same time; that of all threads."""
        return time.process_time() - self._cpu_started

    def predicted_and_obtained(self) -> tuple[float, float]:
        """Reward per step: what the plans expected over their horizons, and what was obtained over the same steps.

        The two are averages over the same plans, so they agree for a perfect model whose plans are carried out; a
        planner that exploits its model's errors predicts more than it obtains. Steps that a plan has beyond the
        episode's end count as zero if it ended by termination, as they do in the plan; otherwise they are left out of
        what was obtained.
        """
        predicted = [info.expected_return / self.horizon for info in self.plans]
        over = [self.rewards[step : step + self.horizon] for step in self.plan_steps]
        obtained = [np.sum(rewards) / (self.horizon if self.has_terminated else len(rewards)) for rewards in over]
        known = np.isfinite(predicted)  # a plan without time for one iteration expected nothing
        if not known.any():
            return float("nan"), float("nan")
        return float(np.mean(np.array(predicted)[known])), float(np.mean(np.array(obtained)[known]))

    def metrics(self) -> dict[str, float]:
        """Names and values for the logger; those of planning only if there were plans."""
        metrics: dict[str, float] = {"rollout/ep_return": self.episode_return, "rollout/ep_length": len(self.rewards)}
        metrics["time/ep_seconds"] = self.seconds
        if self.plans:
            predicted, obtained = self.predicted_and_obtained()
            metrics["planner/expected_return"] = self.horizon * predicted
            metrics["planner/predicted_reward_per_step"] = predicted
            metrics["planner/obtained_reward_per_step"] = obtained
            metrics["planner/num_nonfinite"] = sum(info.num_nonfinite for info in self.plans)
            metrics["planner/num_late"] = self.num_late
            metrics |= {f"planner/{name}": value for name, value in self._means_of_metrics().items()}
            metrics["time/plan_ms"] = 1e3 * float(np.mean(self.plan_seconds))
            metrics["time/plan_ms_p95"] = 1e3 * float(np.quantile(self.plan_seconds, 0.95))
        return metrics

    def _means_of_metrics(self) -> dict[str, float]:
        """The mean of each metric of the planner over the plans that have it; NaN counts as missing."""
        known: dict[str, list[float]] = {}
        for info in self.plans:
            for name, value in info.metrics.items():
                if not np.isnan(value):
                    known.setdefault(name, []).append(value)
        return {name: float(np.mean(values)) for name, values in known.items()}

    def line(self, num_timesteps: int) -> str:
        """The episode on one line, for a person."""
        text = f"episode {self.number:3d} | {num_timesteps:6d} steps | return {self.episode_return:9.2f}"
        text += f" | {self.seconds:6.1f} s"
        if not self.plans:
            return f"{text} | random actions"
        predicted, obtained = self.predicted_and_obtained()
        plan_ms = 1e3 * float(np.mean(self.plan_seconds))
        if np.isfinite(predicted):
            text += f" | per step: predicted {predicted:8.3f}, obtained {obtained:8.3f}"
        text += f" | {plan_ms:5.0f} ms per plan"
        num_nonfinite = sum(info.num_nonfinite for info in self.plans)
        if num_nonfinite:
            text += f" | {num_nonfinite} candidates not finite"
        return f"{text} | {self.num_late} of {len(self.plans)} plans late" if self.num_late else text

    def state_dict(self) -> dict[str, Tensor]:
        """Everything but the number, which is counted elsewhere."""
        return {
            "rewards": _column(self.rewards),
            "expected_return": _column([info.expected_return for info in self.plans]),
            "num_nonfinite": _column([info.num_nonfinite for info in self.plans], torch.int64),
            **self._metric_columns(),
            "plan_steps": _column(self.plan_steps, torch.int64),
            "plan_seconds": _column(self.plan_seconds),
            "num_late": _column(self.num_late, torch.int64),
            "has_terminated": _column(self.has_terminated, torch.bool),
            "seconds": _column(self.seconds),
            "cpu_seconds": _column(self.cpu_seconds),
            "training_iterations": _column(self.training_iterations, torch.int64),
        }

    def _metric_columns(self) -> dict[str, Tensor]:
        """Each metric of the planner, one number per plan; NaN where a plan lacks it."""
        names = sorted({name for info in self.plans for name in info.metrics})
        return {METRIC + name: _column([info.metrics.get(name, float("nan")) for info in self.plans]) for name in names}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from `state_dict`.

        Raises:
            KeyError, TypeError, ValueError: the state is not one.
        """
        columns = _plan_columns(state)
        counts = {size for column in columns.values() for size in column.shape}
        counts |= {*state["plan_steps"].shape, *state["plan_seconds"].shape}
        if len(counts) != 1 or state["rewards"].ndim != 1:
            raise ValueError(
                f"an episode's record must have one entry per plan, got different counts: {sorted(counts)}"
            )
        self.rewards = state["rewards"].tolist()
        returns, nonfinite = columns.pop("expected_return").tolist(), columns.pop("num_nonfinite").tolist()
        metrics = {name.removeprefix(METRIC): column.tolist() for name, column in columns.items()}
        self.plans = [
            PlanInfo(expected, int(count), {name: values[i] for name, values in metrics.items()})
            for i, (expected, count) in enumerate(zip(returns, nonfinite, strict=True))
        ]
        self.plan_steps = [int(step) for step in state["plan_steps"].tolist()]
        self.plan_seconds = state["plan_seconds"].tolist()
        self.num_late = int(state["num_late"])
        self.has_terminated = bool(state.get("has_terminated", False))  # older files do not say
        self._started = time.perf_counter() - float(state["seconds"])
        # Older files have neither.
        self._cpu_started = time.process_time() - float(state.get("cpu_seconds", 0.0))
        self.training_iterations = int(state.get("training_iterations", 0))


def _column(values: Any, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(values, dtype=dtype, device="cpu")


def _plan_columns(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """What the plans found, one column [n] per name of `EpisodeRecord.state_dict`."""
    if "plans" in state:  # one table, in files of the schemas 2 to 4
        expected_return, num_nonfinite, num_iterations = state["plans"].T
        old = {"expected_return": expected_return, "num_nonfinite": num_nonfinite}
        return old | {f"{METRIC}num_iterations": num_iterations}
    names = ["expected_return", "num_nonfinite", *(name for name in state if name.startswith(METRIC))]
    return {name: state[name] for name in names}
