"""The cart-pole of MC-PILCO: the laws of mechanics, what counts as success, and what is written down of a run."""

import numpy as np
import pytest

from benchmarks import outside
from benchmarks.outside import CART, FRICTION, GRAVITY, LENGTH, POLE, STEPS, TRIALS, OutsideCartPole, derivative
from gym_dgpmpc import MCPILCOAgent
from gym_dgpmpc.tasks.environment import time_limit


def energy(state):
    """Of a uniform pole, whose middle is at (x + l/2 sin theta, -l/2 cos theta), on a cart."""
    _, speed, angle, rate = state
    kinetic = 0.5 * (CART + POLE) * speed**2 + 0.5 * POLE * LENGTH * speed * rate * np.cos(angle)
    return kinetic + POLE * LENGTH**2 * rate**2 / 6 - 0.5 * POLE * GRAVITY * LENGTH * np.cos(angle)


def momentum(state):
    """Along the track."""
    _, speed, angle, rate = state
    return (CART + POLE) * speed + 0.5 * POLE * LENGTH * rate * np.cos(angle)


def test_energy_and_momentum_change_by_what_acts_on_the_cart():
    """dE/dt = (F - b x') x' and dp/dt = F - b x', two equations for two accelerations.

    Central differences with h = 1e-5 err by h^2 times third derivatives, of up to 1e4 here.
    """
    rng, h = np.random.default_rng(0), 1e-5
    for _ in range(20):
        state, force = rng.normal(0.0, [1.0, 2.0, 2.0, 4.0]), rng.uniform(-10.0, 10.0)
        change = np.array(derivative(0.0, state, force))
        acting = force - FRICTION * state[1]
        for law, rate in ((energy, acting * state[1]), (momentum, acting)):
            found = (law(state + h * change) - law(state - h * change)) / (2 * h)
            assert found == pytest.approx(rate, abs=1e-5)
        assert change[0] == state[1] and change[2] == state[3]


def test_a_trial_is_three_seconds_from_rest_of_noisy_states():
    env = OutsideCartPole()
    env.reset(seed=0)
    observed, over = [], False
    while not over:
        observation, _, _, over, info = env.step(np.zeros(1))
        observed.append(observation)
    assert len(observed) == STEPS == 60 and not info["succeeded"]
    errors = (np.array(observed) - np.array(env.path[1:])) / 0.01
    # The standard deviation of 240 normal numbers has a standard error of 1 / sqrt(480).
    assert abs(errors.std() - 1.0) < 4 / np.sqrt(480)
    assert np.abs(np.array(env.path)).max() < 0.2  # it hangs, and nothing pushes


@pytest.mark.parametrize(
    ("step", "state", "succeeded"),
    [
        (59, (0.09, 0.0, np.radians(171.0), 0.0), True),
        (59, (0.09, 0.0, np.radians(-171.0), 0.0), True),
        (59, (0.11, 0.0, np.pi, 0.0), False),
        (45, (0.0, 0.0, np.radians(169.0), 0.0), False),
        (39, (5.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_success_is_to_stand_for_the_whole_last_second(step, state, succeeded):
    env = OutsideCartPole()
    env.path = [np.array([0.0, 0.0, np.pi, 0.0]) for _ in range(STEPS + 1)]
    env.path[step + 1] = np.array(state)
    assert env.succeeded() is succeeded
    env.path.pop()
    assert env.succeeded() is False  # it is not over yet


def test_each_trial_is_in_the_row_and_on_the_page(monkeypatch):
    quick = {"first_training_iterations": 5, "training_iterations": 5, "num_samples": 5, "num_inducing": 10}
    quick |= {"num_worlds": 5, "num_paths": 1, "first_search_steps": 1, "search_steps": 1, "search_horizon": 5}
    made = []

    def make(env, **settings):
        made.append(MCPILCOAgent(env, sample_spacing=1, **quick, **settings))
        return made[-1]

    monkeypatch.setattr(outside, "METHODS", {"quick": make})
    row = {"method": "quick", "seed": 100} | outside.measure({"method": "quick", "seed": 100})
    assert len(row["returns"]) == len(row["succeeded"]) == TRIALS and row["cpu_minutes"] > 0
    assert all(0.0 < each <= STEPS for each in row["returns"])
    assert time_limit(made[0].env) == STEPS  # or the policies are searched over other episodes
    better = row | {"succeeded": [False, False, True, True, True], "seed": 101, "command": "c"}
    page = outside.page([row | {"succeeded": [False] * TRIALS, "command": "c"}, better])
    assert "| quick | 100, 101 | 0 of 2 | 0 of 2 | 1 of 2 | 1 of 2 | 1 of 2 |" in page
