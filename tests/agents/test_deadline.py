"""A time budget: the best plan so far, always an action, and lateness that is told of."""

import time
import warnings

import numpy as np
import pytest
import torch

from gym_dgpmpc.agents.episode import EpisodeRecord
from gym_dgpmpc.planning import CEM
from gym_dgpmpc.types import PlanInfo
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, agent

OBSERVATION = np.array([0.7, -0.1])


class SlowModel(LinearModel):
    """Every step of a rollout takes its time."""

    seconds = 0.0

    def draw(self, *arguments):
        sampler = super().draw(*arguments)

        def slow(*step):
            time.sleep(self.seconds)
            return sampler(*step)

        return slow


def test_without_a_budget_the_plan_is_what_it_was():
    plans = []
    for budget in (None, 1e6):
        learner = agent(time_budget=budget).learn(2 * LENGTH)
        plans.append(learner.predict(OBSERVATION, deterministic=True)[1])
        assert learner.num_late_plans == 0
    np.testing.assert_array_equal(plans[0][0], plans[1][0])


def test_a_plan_ends_within_its_budget():
    """Five steps of 10 ms are an iteration: of the three, one fits into 90 ms."""
    learner = agent(dynamics=SlowModel(), time_budget=0.09).learn(LENGTH)
    learner.dynamics.seconds = 0.01
    counted = []
    plan = learner.planner.plan
    learner.planner.plan = lambda *arguments, **limit: counted.append(plan(*arguments, **limit)) or counted[-1]
    action, _ = learner.predict(OBSERVATION, deterministic=True)
    assert counted[0][1].metrics["num_iterations"] == 1
    assert learner.action_space.contains(action)


@pytest.mark.parametrize("budget", [1e-9, 1e-3])
def test_late_plans_are_counted_and_logged(budget):
    learner = agent(dynamics=SlowModel(), time_budget=budget, verbose=1)
    learner.dynamics.seconds = 2e-3
    logged = {}
    learner.learn(LENGTH)
    learner.logger.dump = lambda step: logged.update(learner.logger.name_to_value)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a control loop that learns is told of in its logs
        learner.learn(LENGTH, reset_num_timesteps=False)
    assert len(learner.store) == 2 * LENGTH


def test_a_plan_without_any_time_is_the_shifted_one(capsys):
    learner = agent(KnownPointMass(), time_budget=1e-9, verbose=1).learn(2 * LENGTH)
    assert learner.num_late_plans == LENGTH
    assert f"{LENGTH} of {LENGTH} plans late" in capsys.readouterr().out
    assert learner.store.transitions().action[LENGTH:].abs().max() == 0  # the middle, where a cold plan starts
    mean = np.linspace(-3.0, 3.0, 5, dtype=np.float32).reshape(1, 5, 1)
    state = (mean, np.ones_like(mean), np.array([0]))
    with pytest.warns(UserWarning, match="time_budget of 1e-09 s.*num_late_plans"):
        action, after = learner.predict(OBSERVATION, state)
    assert action == -2.0  # within the bounds, whatever the plan was
    np.testing.assert_allclose(after[0][0, :, 0], [-1.5, 0.0, 1.5, 2.0, 0.0])
    assert learner.num_late_plans == LENGTH + 1


def test_metrics_count_late_plans_and_leave_out_what_was_not_expected():
    record = EpisodeRecord(1, 2)
    for expected, late in ((float("nan"), True), (3.0, False)):
        record.add_plan(PlanInfo(expected), 0.1, late=late)
        record.add_reward(1.0)
    metrics = record.metrics()
    assert (metrics["planner/num_late"], metrics["planner/expected_return"]) == (1, 3.0)
    restored = EpisodeRecord(1, 2)
    restored.load_state_dict(record.state_dict())
    again = restored.metrics()
    assert {name: again[name] for name in again if "seconds" not in name} == {
        name: metrics[name] for name in metrics if "seconds" not in name
    }
    with pytest.raises(ValueError, match=r"\[2, 5\]"):
        restored.load_state_dict({**record.state_dict(), "plan_steps": torch.zeros(5)})


def test_a_budget_that_is_set_later_takes_effect_at_once():
    learner = agent().learn(2 * LENGTH)
    learner.controller.time_budget = 1e-9
    with pytest.warns(UserWarning, match="time_budget of 1e-09 s"):
        learner.predict(OBSERVATION)
    assert learner.num_late_plans == 1


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_is_a_positive_time(budget):
    with pytest.raises(ValueError, match=rf"time_budget .* {budget}$"):
        agent(time_budget=budget)


class TestCEM:
    """With a clock that the objective moves."""

    @pytest.fixture
    def clock(self, monkeypatch):
        now = [100.0]
        monkeypatch.setattr(time, "perf_counter", lambda: now[0])
        return now

    def plan(self, clock, durations, deadline):
        bound = torch.tensor([2.0])
        cem = CEM(action_low=-bound, action_high=bound, horizon=3, num_candidates=20, num_elites=4, min_std=0.0)
        durations = iter(durations)

        def objective(actions):
            clock[0] += next(durations)
            return -actions.square().sum((1, 2))

        start = cem.initial_plan()._replace(mean=torch.full((3, 1), 5.0))
        return cem.plan(objective, start, torch.Generator().manual_seed(0), deadline)

    @pytest.mark.parametrize(
        ("durations", "budget", "iterations"),
        [
            ([1.0] * 5, None, 5),
            ([1.0] * 5, 10.0, 5),
            ([1.0] * 5, 5.1, 5),
            ([1.0] * 5, 4.9, 4),
            ([1.0] * 5, 1.9, 1),
            ([1.0, 3.0, 1.0, 1.0, 1.0], 6.9, 2),  # a third might take 3 seconds again
            ([9.0] * 5, 1.0, 1),  # how long the first one takes is not known
            ([1.0] * 5, 0.0, 0),
            ([1.0] * 5, -1.0, 0),
        ],
    )
    def test_no_iteration_begins_that_would_not_end_in_time(self, clock, durations, budget, iterations):
        plan, info = self.plan(clock, durations, None if budget is None else clock[0] + budget)
        assert info.metrics["num_iterations"] == iterations
        assert np.isnan(info.expected_return) == (iterations == 0)
        assert (plan.mean.abs() <= 2.0).all()
        assert plan.std.isfinite().all()

    def test_the_plan_is_that_of_as_many_iterations(self, clock):
        stopped, _ = self.plan(clock, [1.0] * 5, clock[0] + 3.5)
        bound = torch.tensor([2.0])
        cem = CEM(
            action_low=-bound,
            action_high=bound,
            horizon=3,
            num_candidates=20,
            num_elites=4,
            num_iterations=3,
            min_std=0,
        )
        start = cem.initial_plan()._replace(mean=torch.full((3, 1), 5.0))
        three, _ = cem.plan(lambda a: -a.square().sum((1, 2)), start, torch.Generator().manual_seed(0))
        assert torch.equal(stopped.mean, three.mean)
