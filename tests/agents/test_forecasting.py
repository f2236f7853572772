"""`MPCAgent.forecast`: what the model says of given actions, without a step of the agent's random streams."""

import numpy as np
import pytest
import torch

from gym_dgpmpc.errors import EnvironmentDataError
from tests.agents import point_mass

ACTIONS = np.linspace(-1.0, 1.0, 4)[:, None]


@pytest.fixture(scope="module")
def agent():
    return point_mass.agent().learn(2 * point_mass.LENGTH)


def test_is_what_the_particles_of_the_model_do(agent):
    """The point mass is linear, so its regression knows it but for the spread of its draws, 1e-3 in each weight."""
    start = np.array([0.5, -0.2])
    states = agent.forecast(start, ACTIONS, num_particles=400)
    assert states.shape == (400, 5, 2)
    expected = [start]
    for (force,) in ACTIONS:
        velocity = expected[-1][1] + point_mass.TIME_STEP * force
        expected.append(np.array([expected[-1][0] + point_mass.TIME_STEP * velocity, velocity]))
    np.testing.assert_array_equal(states[:, 0], np.broadcast_to(start.astype(np.float32), (400, 2)))
    # Errors of four weights a step, of which the first are carried on, below 1e-2 a step; the mean of 400 is closer.
    np.testing.assert_allclose(states.mean(0), expected, atol=5 * 1e-2 / np.sqrt(400))
    assert (states.std(0)[1:] > 0).all()


def test_the_seed_decides(agent):
    before = {name: generator.get_state() for name, generator in agent.generators._asdict().items()}
    one, same, other = (agent.forecast(np.zeros(2), ACTIONS, 3, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one[:, 1:] != other[:, 1:]).any()
    for name, generator in agent.generators._asdict().items():
        assert torch.equal(generator.get_state(), before[name])


def test_a_longer_forecast_than_a_plan(agent):
    assert agent.forecast(np.zeros(2), np.zeros((12, 1)), 2).shape == (2, 13, 2)


@pytest.mark.parametrize(
    ("observation", "actions", "named"),
    [
        (np.zeros(3), ACTIONS, r"observation of shape \(2,\)"),
        (np.zeros((2, 2)), ACTIONS, "one observation, got 2"),
        (np.zeros(2), np.zeros((4, 2)), r"actions of shape \(H, 1\).*got \(4, 2\)"),
        (np.zeros(2), np.zeros(4), r"got \(4,\)"),
        (np.zeros(2), np.zeros((0, 1)), r"got \(0, 1\)"),
        (np.zeros(2), np.full((1, 1), 2.5), "within .*got"),
        (np.zeros(2), np.full((1, 1), np.nan), "must be finite"),
    ],
)
def test_refuses_other_shapes_and_actions(agent, observation, actions, named):
    with pytest.raises(ValueError, match=named):
        agent.forecast(observation, actions)


def test_refuses_before_there_is_a_model_and_what_is_not_finite(agent):
    with pytest.raises(ValueError, match="not learned yet"):
        point_mass.agent().forecast(np.zeros(2), ACTIONS)
    with pytest.raises(EnvironmentDataError, match="not finite"):
        agent.forecast(np.array([np.nan, 0.0]), ACTIONS)
    with pytest.raises(ValueError, match="num_particles"):
        agent.forecast(np.zeros(2), ACTIONS, 0)
