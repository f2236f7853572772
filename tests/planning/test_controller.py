"""From an observation to an action, with any planner."""

import math
import time
from typing import NamedTuple

import numpy as np
import pytest
import scipy.stats
import torch
from gymnasium import spaces

from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.planning.controller import Controller
from gym_dgpmpc.planning.plan_state import pack, unpack
from gym_dgpmpc.planning.risk import RiskMeasure
from gym_dgpmpc.tasks.task import Task, TaskArguments
from gym_dgpmpc.types import PlanInfo
from tests.planning.test_planner_contract import FACTORIES
from tests.planning.toy_planners import RandomShooting, Sequence

SPACE = spaces.Box(-1.0, 2.0, (1,))
OBSERVATION = np.array([0.5], dtype=np.float32)


class Drifting:
    """The state moves by the action, and each particle by itself; draws are counted."""

    def __init__(self):
        self.drawn = []

    def fit(self, data, generator):
        return {}

    def resample(self, data, generator):
        return {}

    def draw(self, num_particles, horizon, generator):
        assert not torch.is_grad_enabled(), "a plan's memory would grow with all that is recorded"
        self.drawn.append((num_particles, horizon))
        drift = 0.01 * torch.randn(num_particles, 1, 1, generator=generator)
        return lambda observation, action, step: observation + action + drift

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def distance(observation, action, next_observation):
    return -next_observation[..., 0].abs()


def a_task(reward_fn):
    observations = spaces.Box(-9.0, 9.0, (1,))
    return Task(None, observations, SPACE, TaskArguments(reward_fn, None, None), torch.device("cpu"))


TASK = a_task(distance)


def controller(name="one sequence", **arguments):
    low, high = torch.tensor([-1.0]), torch.tensor([2.0])
    return Controller(Drifting(), FACTORIES[name](low, high, horizon=4), SPACE, **arguments)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("name", FACTORIES)
def test_any_planner_controls(name):
    control, generator = controller(name, actions_per_plan=2, num_particles=3), seeded()
    carried, ages, planned = control.cold, [], []
    for _ in range(4):
        acted = control.act(TASK, OBSERVATION, carried, generator)
        assert acted.action.shape == (1,) and acted.action.dtype == np.float32
        assert -1.0 <= acted.action[0] <= 2.0
        assert acted.seconds > 0.0 and not acted.late
        carried = unpack(pack([acted.carried]), control.cold, 1, 2)[0]
        ages.append(carried.age)
        planned.append(acted.info is not None)
    assert (ages, planned) == ([1, 0, 1, 0], [True, False, True, False])
    assert control.dynamics.drawn == [(3, 4)] * 2
    assert control.num_late == 0


def test_actions_without_a_plan_are_the_middle_and_uniform_ones():
    """The Kolmogorov distance exceeds 2.23 / sqrt(n) with probability 1e-4 under the right law."""
    space = spaces.Box(np.array([[-1.0, 4.0]]), np.array([[3.0, 4.0]]), dtype=np.float64)
    planner = RandomShooting(torch.tensor([-1.0, 4.0]), torch.tensor([3.0, 4.0]), horizon=4)
    control, generator = Controller(Drifting(), planner, space), seeded()
    assert control.midpoint().tolist() == [1.0, 4.0]
    drawn = np.stack([control.uniform(generator) for _ in range(2000)])
    assert drawn.dtype == np.float32 and (drawn[:, 1] == 4.0).all()
    assert scipy.stats.kstest(drawn[:, 0], scipy.stats.uniform(-1.0, 4.0).cdf).statistic < 2.23 / math.sqrt(2000)
    # Five particles, one for each network of PETS, and a plan for each action, unless another number is asked for.
    assert (control.num_particles, control.actions_per_plan, control.time_budget) == (5, 1, None)


def test_plans_made_together_may_share_their_worlds():
    control, generator = controller(), seeded()
    worlds = control.worlds(generator)
    assert control.dynamics.drawn == []
    for _ in range(3):
        control.act(TASK, OBSERVATION, control.cold, generator, worlds)
    assert len(control.dynamics.drawn) == 1


def test_lateness_is_the_plans_own(monkeypatch):
    """A clock that moves by a second whenever it is read: no budget of less is kept, and no other plan is late."""
    control = controller(time_budget=0.5)
    now = iter(range(1000))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(now)))
    late = control.act(TASK, OBSERVATION, control.cold, seeded())
    assert late.late and control.num_late == 1
    assert math.isnan(late.info.expected_return)
    control.time_budget = 100.0
    assert not control.act(TASK, OBSERVATION, control.cold, seeded()).late
    control.time_budget = None
    assert not control.act(TASK, OBSERVATION, control.cold, seeded()).late
    assert control.num_late == 1


def test_what_is_set_holds_from_the_next_plan_on():
    control = controller(actions_per_plan=4)
    carried = control.act(TASK, OBSERVATION, control.cold, seeded()).carried
    assert carried.age == 1
    control.num_particles, control.actions_per_plan, control.dynamics = 2, 1, Drifting()
    acted = control.act(TASK, OBSERVATION, carried, seeded())
    assert acted.info is not None and acted.carried.age == 0
    assert control.dynamics.drawn == [(2, 4)]


class Gaining(Drifting):
    """An action earns its negative in one world and four times itself in the other."""

    def draw(self, num_particles, horizon, generator):
        gains = torch.tensor([-1.0, 4.0])[:, None, None]
        return lambda observation, action, step: gains * action.expand(2, -1, -1)


@pytest.mark.parametrize("seed", range(3))
def test_the_measure_of_risk_decides_what_is_planned(seed):
    """The worst world is best served by standing still, the mean and the best one by all there is."""
    control, acted = controller("cem", num_particles=2), {}
    control.dynamics = Gaining()
    task = a_task(lambda observation, action, next_observation: next_observation[..., 0])
    for risk in ("mean", "worst", "best"):
        control.risk = risk
        acted[risk] = control.act(task, OBSERVATION, control.cold, seeded(seed))
    assert abs(acted["worst"].action) < 0.5 < min(acted["mean"].action, acted["best"].action)
    returns = [acted[risk].info.expected_return for risk in ("worst", "mean", "best")]
    assert returns[0] <= 0.0 < returns[1] < returns[2]


@pytest.mark.parametrize(("setting", "value"), [("risk", "median"), ("risk_aversion", math.nan), ("cvar_share", 0.0)])
def test_the_measure_of_risk_is_checked_when_it_is_set(setting, value, unchecked):
    control = controller(measure=RiskMeasure("cvar", 2.0, 0.5))
    with pytest.raises(ValueError, match=rf"{setting} .*{value}"):
        setattr(control, setting, value)
    assert control.measure == RiskMeasure("cvar", 2.0, 0.5)
    control.cvar_share = 0.25
    assert control.measure == RiskMeasure("cvar", 2.0, 0.25)


@pytest.mark.parametrize(
    ("setting", "value", "error"),
    [
        ("time_budget", 0.0, ValueError),
        ("time_budget", -1.0, ValueError),
        ("time_budget", math.nan, ValueError),
        ("time_budget", math.inf, ValueError),
        ("time_budget", "0.04", ValueError),
        ("num_particles", 0, ValueError),
        ("num_particles", 1.5, TypeError),
        ("actions_per_plan", 0, ValueError),
        ("actions_per_plan", 5, ValueError),
        ("actions_per_plan", 1.5, TypeError),
    ],
)
def test_settings_are_checked_when_they_are_set(setting, value, error, unchecked):
    control = controller()
    before = getattr(control, setting)
    with pytest.raises(error, match=rf"{setting} .*{value}"):
        setattr(control, setting, value)
    assert getattr(control, setting) == before
    with pytest.raises(error, match=setting):
        controller(**{setting: value})


def test_a_planner_of_other_actions_is_refused():
    planner = RandomShooting(torch.zeros(2), torch.ones(2), horizon=4)
    with pytest.raises(ValueError, match=r"planner .*\b2\b.*action space .*\b1\b"):
        Controller(Drifting(), planner, SPACE)


class Aged(NamedTuple):
    age: torch.Tensor
    actions: torch.Tensor


class Counted(NamedTuple):
    count: int
    actions: torch.Tensor


@pytest.mark.parametrize(
    ("plan", "error", "message"),
    [
        (torch.zeros(4, 1), TypeError, r"RandomShooting .*tensor\("),
        (Counted(3, torch.zeros(4, 1)), TypeError, "RandomShooting .*count=3"),
        (Aged(torch.zeros(4, 1), torch.zeros(4, 1)), ValueError, "RandomShooting .*'age'"),
    ],
)
def test_plans_that_cannot_be_carried_are_refused(plan, error, message, unchecked):
    planner = RandomShooting(torch.zeros(1), torch.ones(1))
    planner.initial_plan = lambda: plan
    with pytest.raises(error, match=message):
        Controller(Drifting(), planner, SPACE)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (torch.full((4, 1), math.nan), "actions .*nan"),
        (torch.tensor([[0.0], [0.0], [0.0], [math.inf]]), "actions .*inf"),
        (torch.zeros(3, 1), r"\(3, 1\)"),
        (torch.zeros(4, 1).double(), "float64"),
    ],
)
def test_what_a_planner_returns_is_checked(actions, message):
    control = controller()
    control.planner.plan = lambda objective, plan, generator, deadline: (Sequence(actions), PlanInfo(0.0))
    with pytest.raises(PlanningError, match=rf"RandomShooting.*{message}.*observation \[0.5\]"):
        control.act(TASK, OBSERVATION, control.cold, seeded())


def test_returns_that_are_never_finite_name_the_observation():
    control = controller()
    control.dynamics.draw = lambda *_: lambda observation, action, step: math.nan * observation
    with pytest.raises(PlanningError, match=r"finite.*observation \[0\.5\]"):
        control.act(TASK, OBSERVATION, control.cold, seeded())
