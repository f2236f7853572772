"""Prediction: the plan as a recurrent state, determinism, shapes, and no trace left in learning."""

import re

import numpy as np
import pytest
import torch

from gym_dgpmpc.errors import EnvironmentDataError
from tests.agents.point_mass import KnownPointMass, actions_of, agent

OBSERVATION = np.array([0.7, -0.1])


@pytest.fixture(scope="module")
def learned():
    return agent().learn(25)


def test_deterministic_prediction_is_a_function_of_observation_and_state(learned):
    action, state = learned.predict(OBSERVATION, deterministic=True)
    learned.predict(OBSERVATION + 1, deterministic=True)
    learned.predict(OBSERVATION)
    again, same = learned.predict(OBSERVATION, deterministic=True)
    np.testing.assert_array_equal(action, again)
    for one, other in zip(state, same, strict=True):
        np.testing.assert_array_equal(one, other)
    warm, _ = learned.predict(OBSERVATION, state, deterministic=True)
    assert not np.array_equal(warm, action)


def test_prediction_that_is_not_deterministic_draws_anew(learned):
    assert learned.predict(OBSERVATION)[0] != learned.predict(OBSERVATION)[0]


def test_the_action_fits_the_space_and_the_state_has_one_row_per_environment(learned):
    action, state = learned.predict(OBSERVATION, deterministic=True)
    assert learned.action_space.contains(action)
    assert [array.shape for array in state] == [(1, 5, 1), (1, 5, 1), (1,)]
    actions, states = learned.predict(np.stack([OBSERVATION, OBSERVATION + 0.1, OBSERVATION]), deterministic=True)
    assert actions.shape == (3, 1)
    assert [array.shape for array in states] == [(3, 5, 1), (3, 5, 1), (3,)]
    np.testing.assert_array_equal(actions[0], action)
    np.testing.assert_array_equal(actions[2], action)


def test_the_state_is_the_shifted_plan(learned):
    _, (mean, std, age) = learned.predict(OBSERVATION, deterministic=True)
    cold = learned.planner.initial_plan()
    np.testing.assert_array_equal(mean[0, -1], cold.mean[-1])
    np.testing.assert_array_equal(std[0], cold.std)
    assert age == 0


def test_an_episodes_start_forgets_the_state(learned):
    cold, state = learned.predict(np.stack([OBSERVATION] * 2), deterministic=True)
    warm, _ = learned.predict(np.stack([OBSERVATION] * 2), state, np.array([False, False]), deterministic=True)
    mixed, _ = learned.predict(np.stack([OBSERVATION] * 2), state, np.array([False, True]), deterministic=True)
    assert not np.array_equal(cold, warm)
    np.testing.assert_array_equal(mixed, [warm[0], cold[1]])


def test_actions_of_one_plan_are_performed_without_planning_again():
    learned = agent(actions_per_plan=3).learn(20)
    first, state = learned.predict(OBSERVATION, deterministic=True)
    plan = state[0][0]
    assert state[2] == 1
    second, state = learned.predict(OBSERVATION + 5, state, deterministic=True)
    third, state = learned.predict(OBSERVATION - 5, state, deterministic=True)
    np.testing.assert_array_equal(np.stack([first, second, third]), plan[:3])
    assert state[2] == 0
    np.testing.assert_array_equal(state[0][0, :2], plan[3:])


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("actions_per_plan", [1, 2])
def test_prediction_leaves_learning_alone(deterministic, actions_per_plan):
    undisturbed, disturbed = (agent(actions_per_plan=actions_per_plan) for _ in range(2))
    undisturbed.learn(35)

    def predict_often(locals_, globals_):
        state = None
        for _ in range(2):
            _, state = disturbed.predict(OBSERVATION, state, deterministic=deterministic)
        return True

    with pytest.warns(UserWarning, match=r"predict.*learned"):
        disturbed.learn(35, callback=predict_often)
    np.testing.assert_array_equal(actions_of(undisturbed.env.envs[0]), actions_of(disturbed.env.envs[0]))


def test_an_agent_that_has_not_learned_warns_once_and_acts():
    fresh = agent()
    with pytest.warns(UserWarning, match=r"predict.*learned") as warned:
        middle, state = fresh.predict(OBSERVATION, deterministic=True)
        actions = np.array([fresh.predict(OBSERVATION, state)[0] for _ in range(50)])
    assert len(warned) == 1
    np.testing.assert_array_equal(middle, [0.0])
    assert np.all(np.abs(actions) <= 2.0)
    assert len(np.unique(actions)) == 50


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (1, 1, 2)])
def test_an_observation_of_the_wrong_shape_is_named(learned, shape):
    with pytest.raises(ValueError, match=rf"observation .*\(2,\).*{re.escape(str(shape))}"):
        learned.predict(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_observation_that_is_not_finite_is_named(learned, value):
    with pytest.raises(EnvironmentDataError, match=rf"finite: \[ *0\.1 +{value}\]"):
        learned.predict(np.array([0.1, value]))


def test_a_state_of_another_agent_is_refused(learned):
    _, (mean, std, age) = learned.predict(OBSERVATION)
    with pytest.raises(ValueError, match=r"\(1, 5, 1\).*\(1, 4, 1\)"):
        learned.predict(OBSERVATION, (mean[:, 1:], std[:, 1:], age))
    with pytest.raises(ValueError, match=r"2 observation\(s\)"):
        learned.predict(np.stack([OBSERVATION] * 2), (mean, std, age))
    with pytest.raises(ValueError, match=r"age .*\[7\]"):
        learned.predict(OBSERVATION, (mean, std, age + 7))


def test_planning_costs_no_gradients(learned):
    learned.dynamics.mean.requires_grad_(True)
    try:
        action, _ = learned.predict(OBSERVATION, deterministic=True)
    finally:
        learned.dynamics.mean.requires_grad_(False)
    assert isinstance(action, np.ndarray)


def test_float32_and_float64_observations_agree(learned):
    observation = OBSERVATION.astype(np.float32)
    one, other = (learned.predict(o, deterministic=True)[0] for o in (observation, observation.astype(np.float64)))
    np.testing.assert_array_equal(one, other)


def test_a_seed_set_anew_repeats_the_run():
    first, second = agent(seed=1).learn(25), agent(seed=2)
    second.set_random_seed(1)
    second.learn(25)
    np.testing.assert_array_equal(actions_of(first.env.envs[0]), actions_of(second.env.envs[0]))
    assert second.seed == 1
    second.set_random_seed(None)
    assert second.seed == 1


def test_set_env_goes_on_in_another_environment():
    learner = agent().learn(15)
    other = KnownPointMass(fixed_start=True)
    learner.set_env(other)
    learner.learn(15, reset_num_timesteps=False)
    assert learner.num_timesteps == 30
    assert len(other.steps) == 15
    assert torch.equal(learner.store.transitions().observation[15], torch.tensor([1.0, 0.0]))
