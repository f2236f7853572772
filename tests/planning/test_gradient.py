"""Gradient planning against exact optima of linear-quadratic problems, and what it asks of objectives."""

import math
import time

import gymnasium
import numpy as np
import pytest
import torch

from gym_dgpmpc import MPCAgent
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.planning import GradientAscent, rollout_objective
from gym_dgpmpc.planning.sequence import Sequence
from tests.oracles import lqr
from tests.oracles.models import seeded

PROBLEM = lqr.LQR(
    A=np.array([[1.0, 0.2], [-0.1, 0.95]]),
    B=np.array([[0.0, 0.1], [0.3, 0.0]]),
    Q=np.array([[1.0, 0.1], [0.1, 0.2]]),
    R=np.diag([0.1, 0.2]),
)
START = np.array([1.5, -0.5])
H = 8


def linear_quadratic():
    A, B, Q, R = (torch.tensor(each) for each in PROBLEM)

    def reward(observation, action, next_observation):
        return -((next_observation @ Q) * next_observation).sum(-1) - ((action @ R) * action).sum(-1)

    return rollout_objective(lambda x, u, step: x @ A.T + u @ B.T, reward, torch.tensor(START), 1)


def planner(bound, **settings):
    low, high = torch.full((2,), -bound, dtype=torch.float64), torch.full((2,), bound, dtype=torch.float64)
    return GradientAscent(low, high, horizon=H, **settings)


@pytest.mark.parametrize("start", ["plan", "cem"])
@pytest.mark.parametrize("seed", range(3))
def test_lbfgs_finds_the_riccati_solution(seed, start):
    """With e = u - u*, the cost exceeds the optimum by e' G e, so an excess of rounding's size bounds e by its root."""
    actions, optimum = lqr.solve(PROBLEM, START, H)
    assert np.abs(actions).max() < 4.0
    ascent = planner(8.0, optimiser="lbfgs", num_iterations=60, start_from=start)
    plan, info = ascent.plan(linear_quadratic(), ascent.initial_plan(), seeded(seed))
    assert -info.expected_return == pytest.approx(optimum, rel=1e-10)
    smallest = np.linalg.eigvalsh(lqr.condensed(PROBLEM, H))[0]
    assert np.abs(plan.actions.numpy() - actions).max() < math.sqrt(1e-10 * optimum / smallest)


@pytest.mark.parametrize("seed", range(3))
def test_adam_comes_near_it(seed):
    """Its steps fall to nothing, the last ones far below the first one's tenth of the range."""
    _, optimum = lqr.solve(PROBLEM, START, H)
    ascent = planner(8.0, optimiser="adam", num_iterations=100)
    _, info = ascent.plan(linear_quadratic(), ascent.initial_plan(), seeded(seed))
    nothing = -linear_quadratic()(torch.zeros(1, H, 2).double()).item()
    assert 0.0 <= -info.expected_return - optimum < 1e-3 * (nothing - optimum)


@pytest.mark.parametrize("seed", range(3))
def test_a_bounded_plan_is_the_exact_one(seed):
    """A concave quadratic in a box has one top, where the gradient is zero or points out of the box (Karush, Kuhn and
    Tucker): the gradient of the cost u' G u + 2 g' u, by the condensed matrix."""
    actions, _ = lqr.solve(PROBLEM, START, H)
    bound = float(np.abs(actions).max()) / 3
    ascent = planner(bound, optimiser="lbfgs", num_iterations=80)
    plan, _ = ascent.plan(linear_quadratic(), ascent.initial_plan(), seeded(seed))
    found = plan.actions.numpy()
    slope = -2 * lqr.condensed(PROBLEM, H) @ (found - actions).ravel()
    upper, lower = (found == bound).ravel(), (found == -bound).ravel()
    assert (upper | lower).any() and not (upper | lower).all()
    assert (slope[upper] > 0).all() and (slope[lower] < 0).all()
    assert np.abs(slope[~(upper | lower)]).max() < 1e-4


def test_the_best_sequence_that_was_scored_is_the_plan_and_never_worse_than_the_carried_one():
    seen = []

    def objective(actions):
        scores = (5.0 * actions).sin().sum((1, 2))
        seen.append((scores.detach(), actions.detach()))
        return scores

    ascent = planner(2.0, num_starts=5, num_iterations=4)
    start = Sequence(torch.full((H, 2), 0.31, dtype=torch.float64))
    plan, info = ascent.plan(objective, start, seeded())
    scores, actions = torch.cat([each for each, _ in seen]), torch.cat([each for _, each in seen])
    assert len(seen) == 4 and len(scores) == 20
    assert info.expected_return == scores.max().item() >= objective(start.actions[None]).item()
    assert torch.equal(plan.actions, actions[scores.argmax()])
    torch.testing.assert_close(actions[0], start.actions)
    assert info.metrics == {"num_iterations": 4, "climbed": (scores.max() - scores[0]).item()}


def test_cem_asks_for_values_alone_and_what_it_found_is_climbed_from():
    asked = []

    def objective(actions):
        asked.append((len(actions), actions.requires_grad, actions.detach().clone()))
        return -(actions - 0.7).square().sum((1, 2))

    ascent = planner(2.0, num_starts=2, num_iterations=3, start_from="cem", cem_candidates=50, cem_iterations=4)
    _, info = ascent.plan(objective, ascent.initial_plan(), seeded())
    assert [each[:2] for each in asked] == [(50, False)] * 4 + [(2, True)] * 3
    cold = planner(2.0, num_starts=2, num_iterations=3)
    _, alone = cold.plan(objective, cold.initial_plan(), seeded())
    assert info.metrics["climbed"] < 0.2 * alone.metrics["climbed"], "less was left to climb"


@pytest.mark.parametrize(("seconds", "calls"), [(3.5, 3), (5.5, 5)])
def test_the_gradient_gets_the_time_that_cem_leaves(monkeypatch, seconds, calls):
    now, asked = [100.0], []
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def objective(actions):
        now[0] += 1.0
        asked.append(actions.requires_grad)
        return -(actions - 0.7).square().sum((1, 2))

    ascent = planner(2.0, start_from="cem", cem_iterations=3)
    plan, info = ascent.plan(objective, ascent.initial_plan(), seeded(), 100.0 + seconds)
    assert asked[:3] == [False] * 3 and all(asked[3:]) and calls <= len(asked) <= calls + 1
    assert math.isfinite(info.expected_return) and not torch.equal(plan.actions, ascent.initial_plan().actions)


@pytest.mark.parametrize(
    "objective",
    [
        lambda actions: torch.from_numpy(actions.detach().numpy().sum((1, 2))),
        lambda actions: torch.ones(len(actions), dtype=torch.float64),
        lambda actions: torch.ones(len(actions), dtype=torch.float64, requires_grad=True) * 2.0,
    ],
)
def test_an_objective_without_a_gradient_is_refused(objective):
    ascent = planner(2.0)
    with pytest.raises(NotDifferentiableError, match=r"no gradient by the actions.*reward.*cem"):
        ascent.plan(objective, ascent.initial_plan(), seeded())


def test_the_simulator_is_refused_by_name_before_a_step_is_lost():
    env = gymnasium.make("ModCartPole-v0")
    agent = MPCAgent(env, TrueDynamics(env), planner="gradient", horizon=3, num_particles=1, learning_starts=1)
    with pytest.raises(NotDifferentiableError, match=r"SimulatorSampler has no gradients.*cem"):
        agent.learn(2)
    env.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"optimiser": "sgd"}, r"optimiser must be one of adam, lbfgs, got 'sgd'"),
        ({"start_from": "mppi"}, r"start_from must be one of plan, cem, got 'mppi'"),
        ({"action_step": 0.0}, r"action_step .* 0\.0$"),
        ({"cem_iterations": 0}, "cem_iterations must be at least 1, got 0"),
        ({"num_starts": 0}, "num_starts must be at least 1, got 0"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        planner(1.0, **settings)
