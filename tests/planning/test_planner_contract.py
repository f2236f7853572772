"""What every planner must do, whatever its algorithm and whatever it carries; a new planner is one line in FACTORIES.

A plan is read by its `actions` alone; its other fields are compared, stacked and handed back, never interpreted.
"""

import inspect
import math
import re
import time
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.planning import CEM, ICEM, MPPI, GradientAscent
from gym_dgpmpc.planning.plan_state import PlanState, pack, plans_from_tensors, plans_to_tensors, unpack
from gym_dgpmpc.types import Plan, Planner
from tests.planning.toy_planners import ElitesKept, RandomShooting

FACTORIES = {
    "cem": partial(CEM, num_candidates=64, num_elites=8, num_iterations=4),
    "icem": partial(ICEM, num_candidates=64, num_elites=8, num_iterations=4),
    "mppi": partial(MPPI, num_candidates=64, num_iterations=4),
    "gradient, adam": partial(GradientAscent, num_starts=16, num_iterations=8, optimiser="adam"),
    "gradient, lbfgs": partial(GradientAscent, num_starts=16, num_iterations=2, optimiser="lbfgs"),  # 3 are exact
    "gradient from cem": partial(GradientAscent, num_iterations=3, start_from="cem", optimiser="adam"),
    "one sequence": partial(RandomShooting, num_candidates=256),
    "elites": partial(ElitesKept, num_candidates=128),
}
"""By name, the factory with settings that make a plan quick."""

HORIZON = 4

pytestmark = pytest.mark.parametrize("name", FACTORIES)


def make(name, low=(-1.0, -2.0), high=(1.0, 3.0), dtype=torch.float32):
    return FACTORIES[name](torch.tensor(low, dtype=dtype), torch.tensor(high, dtype=dtype), horizon=HORIZON)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def near(target):
    return lambda actions: -(actions - target).square().sum(dim=(1, 2))


def takes_proposals(planner):
    return "proposals" in inspect.signature(planner.plan).parameters


def made(planner, seed=0, start=None):
    """A plan that was optimised, from the initial one or another."""
    return planner.plan(near(-0.9), planner.initial_plan() if start is None else start, seeded(seed))[0]


def equal(first, second):
    return type(first) is type(second) and all(map(torch.equal, first, second))


def within(actions, low, high):
    return bool((actions >= low).all()) and bool((actions <= high).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_plans_keep_their_fields_shapes_and_dtypes(name, dtype):
    planner = make(name, dtype=dtype)
    cold = planner.initial_plan()
    assert isinstance(planner, Planner) and isinstance(cold, Plan)
    assert cold.actions.shape == (HORIZON, 2) and cold.actions.dtype == dtype
    expected = {field: (value.shape, value.dtype) for field, value in cold._asdict().items()}
    for plan in (made(planner), planner.shift(cold, 2), planner.shift(made(planner), HORIZON)):
        assert type(plan) is type(cold)
        assert {field: (value.shape, value.dtype) for field, value in plan._asdict().items()} == expected
        assert plan.actions.isfinite().all()


def test_the_factory_has_defaults_for_all_its_settings(name):
    factory = FACTORIES[name].func
    assert factory(torch.tensor([-1.0]), torch.tensor([1.0])).initial_plan().actions.shape[1] == 1


def test_a_plan_improves_on_its_start(name):
    planner, objective = make(name), near(torch.tensor([-0.9, 2.7]))
    start = planner.initial_plan()
    plan, info = planner.plan(objective, start, seeded())
    assert objective(plan.actions[None]).item() > objective(start.actions[None]).item()
    again, _ = planner.plan(objective, plan, seeded(1))
    assert objective(again.actions[None]).item() > objective(start.actions[None]).item()
    assert type(info.expected_return) is float and -40.0 < info.expected_return <= 0.0
    assert info.num_nonfinite == 0


def test_the_generator_decides_everything(name):
    planner = make(name)
    global_state = torch.get_rng_state()
    first, second, other = (made(planner, seed) for seed in (3, 3, 4))
    assert equal(first, second)
    assert not torch.equal(first.actions, other.actions)
    assert torch.equal(torch.get_rng_state(), global_state)


def test_planning_changes_neither_the_plan_given_nor_the_bounds(name):
    low, high = torch.tensor([-1.0]), torch.tensor([1.0])
    planner = FACTORIES[name](low, high, horizon=2)
    start = planner.initial_plan()
    copy = type(start)(*(value.clone() for value in start))
    made(planner, start=start)
    planner.shift(start, 1).actions.add_(1.0)
    high.mul_(0.0)
    assert equal(start, copy)
    assert equal(planner.initial_plan(), copy)


def test_no_gradient_is_recorded(name):
    planner = make(name)
    weight = torch.ones((), requires_grad=True)
    plan, _ = planner.plan(lambda actions: near(-0.9)(actions) * weight, planner.initial_plan(), seeded())
    assert not any(value.requires_grad for value in plan)


@settings(max_examples=25, deadline=None)
@given(
    bounds=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(0.0, 1e6)), min_size=1, max_size=3),
    pull=st.floats(-1.0, 1.0),
    scale=st.sampled_from([1e-12, 1.0, 1e12]),
    seed=st.integers(0, 2**31),
)
def test_candidates_and_plans_stay_within_any_bounds(name, bounds, pull, scale, seed):
    """Also those that go on from a plan, which the pull may have led to a bound, and for an action that is fixed."""
    low = torch.tensor([lower for lower, _ in bounds]) * scale
    high = torch.maximum(torch.tensor([lower + width for lower, width in bounds]) * scale, low)
    planner = FACTORIES[name](low, high, horizon=2)

    def objective(actions):
        assert within(actions, low, high)
        return pull * (actions / scale).sum(dim=(1, 2))

    plan = planner.initial_plan()
    for _ in range(2):
        plan, _ = planner.plan(objective, planner.shift(plan, 1), seeded(seed))
        assert within(plan.actions, low, high)
        assert all(value.isfinite().all() for value in plan)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_score_that_is_not_finite_never_wins(name, bad):
    """Candidates are finite whose first action is not positive, and the best of those are the ones nearest zero."""
    planner = make(name)
    counted = 0

    def objective(actions):
        nonlocal counted
        first = actions[:, 0, 0]
        counted += int((first > 0).sum())
        return torch.where(first > 0, bad, first)

    plan, info = planner.plan(objective, planner.initial_plan(), seeded())
    assert plan.actions[0, 0] <= 0.0
    assert math.isfinite(info.expected_return) and info.expected_return <= 0.0
    assert info.num_nonfinite == counted > 0


def test_proposals_are_scored_as_they_are_in_the_place_of_others(name):
    planner = make(name)
    if not takes_proposals(planner):
        return  # they are no part of what every planner must take
    proposals = torch.tensor([0.93, -1.71]).expand(1, HORIZON, 2)
    scored = []

    def objective(actions):
        scored.append(actions.detach().clone())
        return near(0.2)(actions)

    planner.plan(objective, planner.initial_plan(), seeded())
    sizes = [len(actions) for actions in scored]
    scored.clear()
    planner.plan(objective, planner.initial_plan(), seeded(), proposals=proposals)
    assert [len(actions) for actions in scored] == sizes  # no more work than without
    assert any(((actions - proposals).abs().amax((1, 2)) < 1e-6).any() for actions in scored)  # float32, of size 2


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_finite_score_is_an_error(name, bad):
    planner = make(name)
    with pytest.raises(PlanningError, match="finite score"):
        planner.plan(lambda actions: torch.full((len(actions),), bad), planner.initial_plan(), seeded())


def test_metrics_are_numbers(name):
    planner = make(name)
    for deadline in (None, time.perf_counter() - 1.0):
        _, info = planner.plan(near(-0.9), planner.initial_plan(), seeded(), deadline)
        assert all(type(key) is str and not math.isinf(value) for key, value in info.metrics.items())


def test_a_shifted_plan_starts_where_the_performed_actions_end(name):
    planner = make(name)
    plan = made(planner)
    low, high = torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 3.0])
    for num_actions in range(HORIZON + 1):
        shifted = planner.shift(plan, num_actions)
        assert torch.equal(shifted.actions[: HORIZON - num_actions], plan.actions[num_actions:])
        assert within(shifted.actions, low, high)
    for num_actions in (-1, HORIZON + 1):
        with pytest.raises(ValueError, match=rf"got {num_actions}"):
            planner.shift(plan, num_actions)


class TestDeadlines:
    """With a clock that the objective moves, by a second at each call."""

    @pytest.fixture
    def clock(self, monkeypatch):
        now = [100.0]
        monkeypatch.setattr(time, "perf_counter", lambda: now[0])
        return now

    def slow(self, clock):
        def objective(actions):
            clock[0] += 1.0
            return near(-0.9)(actions)

        return objective

    @pytest.mark.parametrize("budget", [0.5, 1.5, 2.5])
    def test_a_plan_ends_by_about_the_deadline(self, name, clock, budget):
        """The call that is running when it passes is not cut short."""
        planner, deadline = make(name), clock[0] + budget
        plan, info = planner.plan(self.slow(clock), planner.initial_plan(), seeded(), deadline)
        assert clock[0] <= deadline + 1.0
        assert within(plan.actions, torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 3.0]))
        assert math.isfinite(info.expected_return)

    def test_far_deadlines_change_nothing(self, name, clock):
        planner = make(name)
        plan, _ = planner.plan(self.slow(clock), planner.initial_plan(), seeded(), clock[0] + 1e6)
        assert equal(plan, made(planner))

    def test_once_it_has_passed_the_plan_is_the_given_one(self, name, clock):
        planner = make(name)
        start = made(planner)
        for deadline in (clock[0], clock[0] - 1.0):
            plan, info = planner.plan(self.slow(clock), start, seeded(), deadline)
            assert torch.equal(plan.actions, start.actions)
            assert math.isnan(info.expected_return)
        assert clock[0] == 100.0


class TestCarriedPlans:
    """Through SB3's state and through a file, whatever the fields are."""

    def states(self, planner):
        return [PlanState(made(planner, seed), age) for seed, age in ((0, 0), (1, 2), (2, 1))]

    def test_round_trips(self, name):
        planner = make(name)
        cold, states = PlanState(planner.initial_plan()), self.states(planner)
        packed, tensors = pack(states), plans_to_tensors(states)
        assert [f"plan.{field}" for field in cold.plan._asdict()] + ["plan.age"] == list(tensors)
        assert len(packed) == len(tensors) and all(len(array) == 3 for array in packed)
        for back in (unpack(packed, cold, 3, 3), plans_from_tensors(tensors, cold, 3, 3)):
            assert [state.age for state in back] == [0, 2, 1]
            assert all(equal(one.plan, other.plan) for one, other in zip(back, states, strict=True))
        assert equal(made(planner, 5, unpack(packed, cold, 3, 3)[1].plan), made(planner, 5, states[1].plan))

    def test_what_is_no_plan_of_this_planner_is_refused(self, name):
        planner = make(name)
        cold, packed = PlanState(planner.initial_plan()), pack(self.states(planner))
        ages, shape = packed[-1], packed[0].shape
        bad = [
            (packed[:-1], str(len(packed) - 1)),
            ((*packed, ages), str(len(packed) + 1)),
            ((packed[0][:, 1:], *packed[1:]), str((shape[0], shape[1] - 1, *shape[2:]))),
            (tuple(array[:2] for array in packed), str((2, *shape[1:]))),
            ((*packed[:-1], ages + 1), f"age .*{ages[-1] + 1}"),
            ((*packed[:-1], ages - 1), f"age .*{ages[0] - 1}"),
            (tuple(array * math.nan for array in packed[:-1]) + packed[-1:], "nan"),
        ]
        for state, received in bad:
            with pytest.raises(ValueError, match=received if "age" in received else re.escape(received)):
                unpack(state, cold, 3, 3)
        with pytest.raises(KeyError, match="age"):
            plans_from_tensors({f"plan.{field}": array for field, array in cold.plan._asdict().items()}, cold, 1, 3)
