"""Data that are hard on the numerics, through the public interface: they are learned from, and planned with."""

import numpy as np
import pytest

from gym_dgpmpc import DGPMPCAgent
from tests.faults.cases import STEPS, Case, Scripted, check_action

RNG = np.random.default_rng(0)
NOISE = RNG.normal(size=(STEPS + 2, 3))
OBSERVATIONS = {
    "ordinary": NOISE,
    "a constant dimension": NOISE * [1.0, 0.0, 1.0] + [0.0, 7.3, 0.0],
    "a dimension twice": NOISE[:, [0, 0, 1]],
    "a dimension that is the negative of another": NOISE[:, [0, 0, 1]] * [1.0, -1.0, 1.0],
    "wildly different scales": NOISE * [1e-9, 1.0, 1e9],
    "a small signal on a large offset": NOISE * 1e-2 + 1e4,
    "everything the same": np.full((STEPS + 2, 3), 0.1),
    "zeros": np.zeros((STEPS + 2, 3)),
    "the rounding of a constant": 2.5e4 + 1e-3 * np.sign(NOISE),
    "two states in turn": np.resize([[0.0, 1.0, 2.0], [1.0, 0.0, -2.0]], (STEPS + 2, 3)),
    "targets without variance": np.arange(STEPS + 2)[:, None] * [0.5, -0.25, 1.0],
    "one jump": np.where(np.arange(STEPS + 2)[:, None] < 5, 0.0, 1e6) * np.ones(3),
}


def learned(observations, reward_scale=1.0, **arguments):
    """An agent that has learned from these observations, with a step of a plan after each training."""
    bounds = np.float32([-1.0]), np.float32([2.0])
    case = Case(observations, np.full(STEPS, reward_scale), (STEPS - 1,), *bounds, reward_scale, {})
    sizes = {"num_layers": 2, "num_inducing": 6, "num_features": 8, "num_candidates": 10, "num_iterations": 2}
    sizes |= {"first_training_iterations": 30, "training_iterations": 10, "num_samples": 4, "sample_spacing": 2}
    sizes |= {"horizon": 3, "resample_samples": 2, "learning_starts": STEPS - 3, "seed": 0}
    env = Scripted(case)
    return DGPMPCAgent(env, **(sizes | arguments)).learn(STEPS), case, env


@pytest.mark.parametrize("draw", ["pathwise", "joint"])
@pytest.mark.parametrize("name", OBSERVATIONS)
def test_observations(name, draw):
    agent, case, env = learned(OBSERVATIONS[name], draw=draw)
    assert len(agent.store) == len(env.actions) == STEPS
    assert agent.is_fitted
    for action in env.actions:
        check_action(case, action)
    check_action(case, agent.predict(OBSERVATIONS[name][0], deterministic=True)[0])


@pytest.mark.parametrize("num_layers", [1, 3])
@pytest.mark.parametrize("num_inducing", [1, 5, 50])
@pytest.mark.parametrize("first", [1, 2, 5])
def test_few_transitions_and_many_inducing_points(num_layers, num_inducing, first):
    agent, case, _ = learned(NOISE, num_layers=num_layers, num_inducing=num_inducing, learning_starts=first)
    assert len(agent.store) == STEPS
    check_action(case, agent.predict(NOISE[0], deterministic=True)[0])


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e6, -1e6])
def test_rewards_of_any_size(scale):
    agent, case, _ = learned(NOISE, reward_scale=scale)
    assert agent.store.rewards.tolist() == [np.float32(scale)] * STEPS
    check_action(case, agent.predict(NOISE[0], deterministic=True)[0])


def test_more_inducing_points_than_different_transitions():
    """k-means finds two clusters among what are two points, seen many times."""
    agent, case, _ = learned(OBSERVATIONS["two states in turn"], num_inducing=4, learning_starts=6)
    check_action(case, agent.predict(NOISE[0], deterministic=True)[0])
