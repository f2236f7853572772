"""The numbers that an episode is reported by."""

import math

import pytest
import torch

from gym_dgpmpc.agents import episode
from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.types import PlanInfo


def record_of(rewards, plans, horizon=2, terminated=False):
    """A record of these rewards, with plans {step: expected return}; the last step may be a termination."""
    record = EpisodeRecord(3, horizon)
    for step, reward in enumerate(rewards):
        if step in plans:
            record.add_plan(PlanInfo(plans[step], step, {"num_iterations": 4}), 0.001 * (step + 1))
        record.add_reward(reward, terminated=terminated and step == len(rewards) - 1)
    return record


def test_predicted_and_obtained_are_over_the_same_steps():
    record = record_of([1.0, 2.0, 4.0, 8.0], {0: 3.0, 2: 20.0})
    assert record.predicted_and_obtained() == ((1.5 + 10.0) / 2, (1.5 + 6.0) / 2)


def test_steps_beyond_the_end_are_left_out_of_what_was_obtained():
    assert record_of([1.0, 2.0, 4.0], {2: 6.0}).predicted_and_obtained() == (3.0, 4.0)


def test_steps_that_a_plan_has_beyond_a_termination_earn_nothing():
    plans = {0: 2.0, 2: 1.0}
    assert record_of([1.0, 1.0, 1.0], plans).predicted_and_obtained() == (0.75, 1.0)
    record = record_of([1.0, 1.0, 1.0], plans, terminated=True)
    assert record.predicted_and_obtained() == (0.75, 0.75)
    loaded = EpisodeRecord(3, 2)
    loaded.load_state_dict(record.state_dict())
    assert loaded.predicted_and_obtained() == (0.75, 0.75)


def test_metrics():
    metrics = record_of([1.0, 2.0, 4.0, 8.0], {0: 3.0, 2: 20.0}).metrics()
    assert metrics["rollout/ep_return"] == 15.0
    assert metrics["rollout/ep_length"] == 4
    assert metrics["planner/expected_return"] == 11.5
    assert metrics["planner/num_nonfinite"] == 2
    assert metrics["planner/num_iterations"] == 4
    assert metrics["time/plan_ms"] == pytest.approx(2.0)
    assert metrics["time/plan_ms_p95"] == pytest.approx(2.9)
    assert not any(name.startswith("planner/") for name in record_of([1.0], {}).metrics())


def test_metrics_of_any_planner_are_averaged_over_the_plans_that_have_them():
    record = EpisodeRecord(1, 2)
    for found in ({"spread": 1.0, "depth": 3}, {"spread": math.nan, "depth": 4}, {"spread": 2.0}, {"none": math.nan}):
        record.add_plan(PlanInfo(0.0, metrics=found), 0.1)
        record.add_reward(1.0)
    metrics = record.metrics()
    assert (metrics["planner/spread"], metrics["planner/depth"]) == (1.5, 3.5)
    assert "planner/none" not in metrics
    loaded = EpisodeRecord(1, 2)
    loaded.load_state_dict(record.state_dict())
    assert {name: value for name, value in loaded.metrics().items() if name != "time/ep_seconds"} == {
        name: value for name, value in metrics.items() if name != "time/ep_seconds"
    }


def test_a_metric_cannot_hide_what_is_logged_of_every_planner():
    with pytest.raises(ValueError, match="num_late"):
        EpisodeRecord(1, 2).add_plan(PlanInfo(0.0, metrics={"num_late": 1.0}), 0.1)


def test_a_record_of_an_older_file():
    """In files of the schemas 2 to 4 a plan is a row: expected return, scores that are not finite, iterations."""
    record = record_of([1.0, 2.0, 4.0, 8.0], {0: 3.0, 2: 20.0})
    state = record.state_dict()
    for name in ("expected_return", "num_nonfinite", "metric.num_iterations"):
        del state[name]
    old = {**state, "plans": torch.tensor([[3.0, 0.0, 4.0], [20.0, 2.0, 4.0]], dtype=torch.float64)}
    loaded = EpisodeRecord(3, 2)
    loaded.load_state_dict(old)
    assert loaded.plans == record.plans
    assert all(type(info.num_nonfinite) is int for info in loaded.plans)
    loaded.load_state_dict(
        {**old, "plans": torch.zeros(0, 3), "plan_steps": torch.zeros(0), "plan_seconds": torch.zeros(0)}
    )
    assert loaded.plans == []
    with pytest.raises(KeyError, match="expected_return"):
        loaded.load_state_dict(state)


def test_the_time_of_an_episode_goes_on_without_that_between(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(episode.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(episode.time, "process_time", lambda: clock[0] / 2)
    record = EpisodeRecord(3, 2)
    record.training_iterations = 7
    clock[0] = 130.0
    state = record.state_dict()
    clock[0] = 1000.0
    loaded = EpisodeRecord(3, 2)
    loaded.load_state_dict(state)
    clock[0] = 1005.0
    assert loaded.seconds == loaded.metrics()["time/ep_seconds"] == 35.0
    assert (loaded.cpu_seconds, loaded.training_iterations) == (17.5, 7)
    older = {name: value for name, value in state.items() if name not in ("cpu_seconds", "training_iterations")}
    loaded.load_state_dict(older)
    assert (loaded.cpu_seconds, loaded.training_iterations) == (0.0, 0)


def test_the_line_tells_of_candidates_that_diverged():
    assert "2 candidates not finite" in record_of([1.0] * 3, {2: 1.0}).line(30)
    assert "not finite" not in record_of([1.0] * 3, {0: 1.0}).line(30)
    assert record_of([1.0], {}).line(30).endswith("random actions")
