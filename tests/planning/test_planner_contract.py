"""What every planner must do, whatever its algorithm; a new planner is one more line in PLANNERS."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.planning import CEM
from gym_dgpmpc.types import Plan

PLANNERS = {"cem": CEM}
HORIZON = 4


def make(name, low=(-1.0, -2.0), high=(1.0, 3.0), dtype=torch.float32, **arguments):
    low, high = torch.tensor(low, dtype=dtype), torch.tensor(high, dtype=dtype)
    arguments = {"horizon": HORIZON, "num_candidates": 64, "num_elites": 8, "num_iterations": 4, **arguments}
    return PLANNERS[name](action_low=low, action_high=high, **arguments)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def near(target):
    return lambda actions: -(actions - target).square().sum(dim=(1, 2))


pytestmark = pytest.mark.parametrize("name", PLANNERS)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_plans_have_the_shape_and_dtype_of_the_bounds(name, dtype):
    planner = make(name, dtype=dtype)
    plan, info = planner.plan(near(0.5), planner.initial_plan(), seeded())
    for each in (planner.initial_plan(), plan, planner.shift(plan, 2)):
        assert each.mean.shape == each.std.shape == (HORIZON, 2)
        assert each.mean.dtype == each.std.dtype == dtype
    assert type(info.expected_return) is float and type(info.num_nonfinite) is int
    assert 1 <= info.num_iterations <= 4


def test_a_plan_improves_on_its_start(name):
    planner, objective = make(name), near(0.7)
    start = planner.initial_plan()
    plan, _ = planner.plan(objective, start, seeded())
    assert objective(plan.mean[None]).item() > 0.5 * objective(start.mean[None]).item()


def test_the_generator_decides_everything(name):
    planner = make(name)
    global_state = torch.get_rng_state()
    first, second, other = (planner.plan(near(0.5), planner.initial_plan(), seeded(s))[0] for s in (3, 3, 4))
    assert torch.equal(first.mean, second.mean) and torch.equal(first.std, second.std)
    assert not torch.equal(first.mean, other.mean)
    assert torch.equal(torch.get_rng_state(), global_state)


def test_planning_changes_neither_the_plan_given_nor_the_bounds(name):
    low, high = torch.tensor([-1.0]), torch.tensor([1.0])
    planner = PLANNERS[name](action_low=low, action_high=high, horizon=2)
    start = planner.initial_plan()
    copy = Plan(start.mean.clone(), start.std.clone())
    planner.plan(near(0.5), start, seeded())
    planner.shift(start, 1).mean.add_(1.0)
    high.mul_(0.0)
    assert torch.equal(start.mean, copy.mean) and torch.equal(start.std, copy.std)
    assert torch.equal(planner.initial_plan().std, copy.std)


def test_no_gradient_is_recorded(name):
    planner = make(name)
    weight = torch.ones((), requires_grad=True)
    plan, _ = planner.plan(lambda actions: near(0.5)(actions) * weight, planner.initial_plan(), seeded())
    assert not plan.mean.requires_grad


@settings(max_examples=40, deadline=None)
@given(
    bounds=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(0.0, 1e6)), min_size=1, max_size=3),
    where=st.floats(0.0, 1.0),
    pull=st.floats(-1.0, 1.0),
    scale=st.sampled_from([1e-12, 1.0, 1e12]),
    seed=st.integers(0, 2**31),
)
def test_candidates_and_plans_stay_within_any_bounds(name, bounds, where, pull, scale, seed):
    """Also with the mean at a bound, where there is no room to explore, and for an action that is fixed."""
    low = torch.tensor([lower for lower, _ in bounds]) * scale
    high = torch.maximum(torch.tensor([lower + width for lower, width in bounds]) * scale, low)
    planner = PLANNERS[name](
        action_low=low, action_high=high, horizon=2, num_candidates=16, num_elites=3, num_iterations=3
    )

    def objective(actions):
        assert bool((actions >= low).all()) and bool((actions <= high).all())
        return pull * (actions / scale).sum(dim=(1, 2))

    start = planner.initial_plan()
    start = Plan((low + where * (high - low)).clamp(low, high).expand(2, -1), start.std)
    plan, _ = planner.plan(objective, start, seeded(seed))
    assert bool((plan.mean >= low).all()) and bool((plan.mean <= high).all())
    assert bool(plan.std.isfinite().all()) and bool((plan.std >= 0).all())


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_score_that_is_not_finite_never_wins(name, bad):
    """Only candidates whose first action is negative are finite, and the best of those are the ones nearest zero."""
    planner = make(name, num_candidates=256, num_elites=16)
    counted = 0

    def objective(actions):
        nonlocal counted
        first = actions[:, 0, 0]
        counted += int((first > 0).sum())
        return torch.where(first > 0, bad, first)

    plan, info = planner.plan(objective, planner.initial_plan(), seeded())
    assert plan.mean[0, 0] <= 0.0
    assert math.isfinite(info.expected_return) and info.expected_return <= 0.0
    assert info.num_nonfinite == counted > 0


def test_no_finite_score_is_an_error_that_says_how_many(name):
    planner = make(name)
    calls = iter([torch.zeros(64), torch.full((64,), math.nan)])
    with pytest.raises(PlanningError, match=r"none of the 64 candidate.*iteration 2 \(64 non-finite"):
        planner.plan(lambda actions: next(calls), planner.initial_plan(), seeded())


def test_an_objective_of_the_wrong_shape_is_named(name):
    planner = make(name)
    with pytest.raises(ValueError, match=r"must return shape \(64,\), got \(64, 1\)"):
        planner.plan(lambda actions: actions[:, :1, 0], planner.initial_plan(), seeded())


def test_a_shifted_plan_starts_where_the_performed_actions_end(name):
    planner = make(name)
    plan = Plan(torch.arange(8.0).reshape(4, 2) / 10, torch.full((4, 2), 0.01))
    middle = planner.initial_plan().mean[:1]
    for num_actions in range(HORIZON + 1):
        shifted = planner.shift(plan, num_actions)
        kept = HORIZON - num_actions
        assert torch.equal(shifted.mean[:kept], plan.mean[num_actions:])
        assert torch.equal(shifted.mean[kept:], middle.expand(num_actions, -1))
    for num_actions in (-1, HORIZON + 1):
        with pytest.raises(ValueError, match=rf"num_actions must lie in 0 to the horizon 4, got {num_actions}"):
            planner.shift(plan, num_actions)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (Plan(torch.zeros(3, 2), torch.ones(3, 2)), r"plan.mean must have shape \(4, 2\).*got \(3, 2\)"),
        (Plan(torch.zeros(4, 2), torch.ones(4, 2).double()), r"plan.std must have.*float32, got .*float64"),
        (Plan(torch.full((4, 2), math.nan), torch.ones(4, 2)), r"plan.mean must be finite, got .*nan"),
    ],
)
def test_a_plan_of_another_planner_is_refused(name, plan, message):
    planner = make(name)
    with pytest.raises(ValueError, match=message):
        planner.plan(near(0.0), plan, seeded())
    with pytest.raises(ValueError, match=message):
        planner.shift(plan, 1)
