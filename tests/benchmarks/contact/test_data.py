"""The cases of the contact study: where their carts go, that the environment itself moves them, what a seed decides."""

import numpy as np
import pytest

from benchmarks.contact.data import (
    CASES,
    NUM_SEQUENCES,
    beyond_the_end,
    contact_test,
    training_data,
    training_sequences,
)
from gym_dgpmpc.envs.mod_cartpole import RAIL_LIMIT, ModCartPoleEnv

SEEDS = range(100, 104)


def sequences(name):
    """States [seeds * n, T + 1, S] of several seeds."""
    return np.concatenate([training_sequences(name, seed)[0] for seed in SEEDS])


def share_in_contact(name):
    return beyond_the_end(sequences(name)[:, 1:]).any(axis=1).mean()


def test_positive_actions_drive_nearly_every_cart_into_the_end():
    """The rest start 0.2 m away or more, or are pushed little."""
    assert share_in_contact("a") > 0.8


def test_negative_actions_keep_the_cart_free():
    """Only carts that start at the very end, moving outwards, are beyond it, by less than they move in a few steps."""
    states = sequences("b")
    touching = beyond_the_end(states[:, 1:])
    assert touching.any(axis=1).mean() < 0.1
    starts = states[touching.any(axis=1), 0]
    assert (starts[:, 0] > RAIL_LIMIT - 0.02).all() and (starts[:, 2] > 0).all()
    assert states[..., 0].max() < RAIL_LIMIT + 0.01
    assert not touching[:, 5:].any()


def test_actions_of_both_signs_do_both():
    assert 0.2 < share_in_contact("c") < 0.8


@pytest.mark.parametrize("name", CASES)
def test_actions_are_as_the_case_says(name):
    case = CASES[name]
    states, actions = training_sequences(name, 100)
    assert states.shape == (NUM_SEQUENCES, case.length + 1, 4) and actions.shape == (NUM_SEQUENCES, case.length, 1)
    assert case.lowest_action <= actions.min() and actions.max() <= case.highest_action
    # The mean of n uniform numbers scatters by width / sqrt(12 n).
    width = case.highest_action - case.lowest_action
    middle = (case.highest_action + case.lowest_action) / 2
    assert abs(actions.mean() - middle) < 5 * width / np.sqrt(12 * actions.size)


@pytest.mark.parametrize("name", CASES)
def test_the_environment_moves_the_cart(name):
    env = ModCartPoleEnv(frame_skip=1)
    assert env.dt == pytest.approx(0.02)
    states, actions = training_sequences(name, 100)
    trial = contact_test(name, 100, 2)
    held = np.broadcast_to(trial.action[1], (len(trial.states) - 1, 1))
    for expected, performed in ((states[7], actions[7]), (trial.states[:, 1], held)):
        env.reset()
        env.set_state(expected[0, :2], expected[0, 2:])
        stepped = [env.step(action)[0] for action in performed]
        np.testing.assert_allclose(expected[1:], stepped, rtol=0, atol=1e-9)


def test_starts_are_those_of_the_task():
    starts = np.concatenate([sequences("a")[:, 0], contact_test("a", 100, 201).states[0, 1:]])
    assert starts[:, 0].max() == RAIL_LIMIT
    # N(2.4, 0.1^2) is beyond the limit with probability 0.159; all else is N(0, 0.1^2). Five standard errors.
    count = len(starts)
    at_limit = (starts[:, 0] == RAIL_LIMIT).mean()
    assert abs(at_limit - 0.1587) < 5 * np.sqrt(0.1587 * 0.8413 / count)
    others = starts[:, 1:]
    assert (np.abs(others.mean(axis=0)) < 5 * 0.1 / np.sqrt(count)).all()
    assert (np.abs(others.std(axis=0) - 0.1) < 5 * 0.1 / np.sqrt(2 * count)).all()


def test_transitions_stay_within_their_sequences():
    states, actions = training_sequences("c", 100)
    data = training_data("c", 100)
    length = CASES["c"].length
    assert data.observation.shape == (NUM_SEQUENCES * length, 4)
    row = 3 * length - 1  # the last of the third sequence
    np.testing.assert_allclose(data.observation[row], states[2, -2], rtol=1e-6)
    np.testing.assert_allclose(data.next_observation[row], states[2, -1], rtol=1e-6)
    np.testing.assert_array_equal(data.action[row], actions[2, -1])
    np.testing.assert_allclose(data.observation[row + 1], states[3, 0], rtol=1e-6)


def test_a_test_begins_at_the_mean_start_and_holds_its_action():
    trial = contact_test("a", 100, 3)
    np.testing.assert_array_equal(trial.states[0, 0], [2.4, 0, 0, 0])
    np.testing.assert_array_equal(trial.action, np.full((3, 1), 0.75))
    assert trial.states.shape == (CASES["a"].horizon + 1, 3, 4)


def test_contact_lasts_from_the_first_time_beyond_the_end():
    trial = contact_test("a", 100, 20)
    for start in range(20):
        beyond = trial.states[1:, start, 0] > RAIL_LIMIT
        first = beyond.argmax() if beyond.any() else len(beyond)
        np.testing.assert_array_equal(trial.in_contact[:, start], np.arange(len(beyond)) >= first)
    # From the mean start the tenth step is the first that ends beyond the end.
    np.testing.assert_array_equal(trial.in_contact[:, 0], np.arange(1, 16) >= 10)


def test_case_and_seed_decide_everything():
    for make in (
        lambda name, seed: training_sequences(name, seed)[0],
        lambda *key: contact_test(*key, 5).states[:, 1:],
    ):
        np.testing.assert_array_equal(make("a", 100), make("a", 100))
        assert not np.isin(make("a", 101)[0], make("a", 100)).any()
    # Actions of other cases, and starts of tests, are no copies of the training's.
    assert not np.isin(training_sequences("c", 100)[0][:, 0, 1], training_sequences("a", 100)[0][:, 0, 1]).any()
    assert not np.isin(contact_test("a", 100, 50).states[0, 1:, 1], training_sequences("a", 100)[0][:, 0, 1]).any()


def test_more_starts_leave_the_first_ones_as_they_are():
    few, many = contact_test("c", 100, 3), contact_test("c", 100, 6)
    np.testing.assert_array_equal(many.states[:, :3], few.states)


def test_what_is_no_case_or_no_test_is_refused():
    with pytest.raises(ValueError, match="'d'"):
        training_data("d", 0)
    with pytest.raises(ValueError, match="0"):
        contact_test("a", 0, 0)
