"""What happened in one episode: rewards, plans and their cost, as numbers to log and as one readable line."""

import time

import numpy as np

from gym_dgpmpc.types import PlanInfo


class EpisodeRecord:
    """Gathers one episode while it runs.

    Args:
        number: counts from 1, the random episode included.
        horizon: H, the steps that a plan's expected return is a sum over.
    """

    def __init__(self, number: int, horizon: int):
        self.number, self.horizon = number, horizon
        self.started = time.perf_counter()
        self.rewards: list[float] = []
        self.plans: list[PlanInfo] = []
        self.plan_steps: list[int] = []
        self.plan_seconds: list[float] = []

    def add_plan(self, info: PlanInfo, seconds: float) -> None:
        """A plan made before the step whose reward is added next."""
        self.plans.append(info)
        self.plan_steps.append(len(self.rewards))
        self.plan_seconds.append(seconds)

    def add_reward(self, reward: float) -> None:
        self.rewards.append(reward)

    @property
    def episode_return(self) -> float:
        return float(np.sum(self.rewards))

    def predicted_and_obtained(self) -> tuple[float, float]:
        """Reward per step: what the plans expected over their horizons, and what was obtained over the same steps.

        The two are averages over the same plans, so they agree for a perfect model whose plans are carried out; a
        planner that exploits its model's errors predicts more than it obtains. Steps beyond the episode's end are
        left out of what was obtained.
        """
        predicted = [info.expected_return / self.horizon for info in self.plans]
        obtained = [np.mean(self.rewards[step : step + self.horizon]) for step in self.plan_steps]
        return float(np.mean(predicted)), float(np.mean(obtained))

    def metrics(self) -> dict[str, float]:
        """Names and values for the logger; those of planning only if there were plans."""
        metrics: dict[str, float] = {"rollout/ep_return": self.episode_return, "rollout/ep_length": len(self.rewards)}
        metrics["time/ep_seconds"] = time.perf_counter() - self.started
        if self.plans:
            predicted, obtained = self.predicted_and_obtained()
            metrics["planner/expected_return"] = float(np.mean([info.expected_return for info in self.plans]))
            metrics["planner/predicted_reward_per_step"] = predicted
            metrics["planner/obtained_reward_per_step"] = obtained
            metrics["planner/num_nonfinite"] = sum(info.num_nonfinite for info in self.plans)
            metrics["planner/num_iterations"] = float(np.mean([info.num_iterations for info in self.plans]))
            metrics["time/plan_ms"] = 1e3 * float(np.mean(self.plan_seconds))
            metrics["time/plan_ms_p95"] = 1e3 * float(np.quantile(self.plan_seconds, 0.95))
        return metrics

    def line(self, num_timesteps: int) -> str:
        """The episode on one line, for a person."""
        seconds = time.perf_counter() - self.started
        text = f"episode {self.number:3d} | {num_timesteps:6d} steps | return {self.episode_return:9.2f}"
        text += f" | {seconds:6.1f} s"
        if not self.plans:
            return f"{text} | random actions"
        predicted, obtained = self.predicted_and_obtained()
        plan_ms = 1e3 * float(np.mean(self.plan_seconds))
        text += f" | per step: predicted {predicted:8.3f}, obtained {obtained:8.3f} | {plan_ms:5.0f} ms per plan"
        num_nonfinite = sum(info.num_nonfinite for info in self.plans)
        return f"{text} | {num_nonfinite} candidates not finite" if num_nonfinite else text
