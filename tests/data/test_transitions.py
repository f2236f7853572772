"""The store keeps exactly what it was given, however it grows, and refuses what cannot be learned from."""

import math
import re

import numpy as np
import pytest
import torch

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import CheckpointError, EnvironmentDataError

S, A = 3, 2
FIELDS = ("observation", "action", "next_observation")


def rows(n, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "observation": rng.normal(size=(n, S)),
        "action": rng.normal(size=(n, A)),
        "next_observation": rng.normal(size=(n, S)),
        "reward": rng.normal(size=n),
        "terminated": rng.random(n) < 0.5,
        "episode": np.arange(n) // 7,
    }


def part(index, data):
    """A slice of the rows, or one row as an environment gives it."""
    selected = {name: value[index] for name, value in data.items()}
    return selected if isinstance(index, slice) else {**selected, "episode": int(selected["episode"])}


def assert_holds(store, data):
    assert len(store) == len(data["reward"])
    held = store.transitions()
    for name in FIELDS:
        assert getattr(held, name).dtype == torch.float32
        np.testing.assert_array_equal(getattr(held, name), data[name].astype(np.float32))
    np.testing.assert_array_equal(store.rewards, data["reward"].astype(np.float32))
    np.testing.assert_array_equal(store.terminated, data["terminated"])
    np.testing.assert_array_equal(store.episodes, data["episode"])


def test_an_empty_store_has_no_rows_and_the_right_sizes():
    store = TransitionStore(S, A)
    assert len(store) == 0
    assert [tuple(field.shape) for field in store.transitions()] == [(0, S), (0, A), (0, S)]


@pytest.mark.parametrize("capacity", [1, 3, 100, 1024])
def test_rows_added_one_by_one_or_together_are_the_same(capacity):
    data = rows(100)
    one_by_one, together, mixed = (TransitionStore(S, A, capacity) for _ in range(3))
    for index in range(100):
        one_by_one.append(**part(index, data))
    together.extend(**data)
    mixed.append(**part(0, data))
    mixed.extend(**part(slice(1, 60), data))
    mixed.extend(**part(slice(60, 60), data))
    mixed.extend(**part(slice(60, 100), data))
    for store in (one_by_one, together, mixed):
        assert_holds(store, data)


def test_growth_is_amortised():
    """2,000 rows into a store of one take 11 doublings."""
    store = TransitionStore(S, A, capacity=1)
    buffers = set()
    for index in range(2_000):
        store.append(np.zeros(S), np.zeros(A), np.zeros(S), reward=float(index))
        buffers.add(store.rewards.data_ptr())
    assert len(buffers) <= 12
    assert store.rewards.tolist() == list(range(2_000))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("terminated", math.nan, "step 2: terminated .* nan$"),
        ("terminated", 2, "step 2: terminated .* 2$"),
        ("episode", 1.7, r"step 2: episode .* 1\.7$"),
        ("episode", math.nan, "step 2: episode .* nan$"),
    ],
)
def test_what_a_conversion_would_change_is_refused(name, value, message):
    store, data = TransitionStore(S, A), rows(2)
    store.extend(**data)
    with pytest.raises(EnvironmentDataError, match=message):
        store.extend(**data | {name: np.array([value, 0])})
    assert_holds(store, data)
    store.extend(**data | {"terminated": np.array([1.0, 0.0]), "episode": np.array([3.0, 4.0])})
    assert store.terminated[2:].tolist() == [True, False] and store.episodes[2:].tolist() == [3, 4]


def test_transitions_are_views_that_later_rows_do_not_change():
    store, data = TransitionStore(S, A, capacity=50), rows(50)
    store.extend(**part(slice(0, 20), data))
    held = store.transitions()
    assert held.observation.data_ptr() == store.transitions().observation.data_ptr()
    before = held.observation.clone()
    store.extend(**part(slice(20, 50), data))
    assert held.observation.data_ptr() == store.transitions().observation.data_ptr()
    assert torch.equal(held.observation, before)


def test_the_caller_may_reuse_its_arrays():
    store, observation = TransitionStore(S, A), np.ones(S, dtype=np.float32)
    store.append(observation, np.ones(A), observation, reward=0.0)
    observation[:] = 5.0
    assert torch.equal(store.transitions().observation, torch.ones(1, S))
    # What was not said: the first episode, and that it goes on.
    assert store.episodes.tolist() == [0] and store.terminated.tolist() == [False]


@pytest.mark.parametrize("convert", [np.asarray, torch.tensor, list, lambda value: np.asarray(value, dtype=np.int32)])
def test_arrays_tensors_lists_and_integers_are_taken(convert):
    store = TransitionStore(S, A)
    store.append(convert([1, 2, 3]), convert([4, 5]), convert([6, 7, 8]), reward=1, terminated=True, episode=2)
    assert [field.tolist() for field in store.transitions()] == [[[1, 2, 3]], [[4, 5]], [[6, 7, 8]]]
    assert (store.rewards.tolist(), store.terminated.tolist(), store.episodes.tolist()) == ([1], [True], [2])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e39])
@pytest.mark.parametrize(
    ("name", "index", "where"),
    [
        ("observation", (2, 1), r"observation\[1\]"),
        ("action", (2, 0), r"action\[0\]"),
        ("next_observation", (2, 2), r"next_observation\[2\]"),
        ("reward", (2,), "reward"),
    ],
)
def test_what_is_not_finite_in_float32_is_refused_and_nothing_is_lost(name, index, where, value):
    store, data = TransitionStore(S, A, capacity=4), rows(15)
    store.extend(**part(slice(0, 10), data))
    bad = {each: np.array(array[10:15]) for each, array in data.items()}
    bad[name][index] = value
    message = rf"step 12: {where} .* {re.escape(str(value))}$"
    with pytest.raises(EnvironmentDataError, match=message):
        store.extend(**bad)
    with pytest.raises(EnvironmentDataError, match=message.replace("step 12", "step 10")):
        store.append(**part(2, bad))
    assert_holds(store, part(slice(0, 10), data))
    store.extend(**part(slice(10, 15), data))
    assert_holds(store, data)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("observation", np.zeros(S + 1), r"observation .*\(1, 3\).*\(1, 4\)"),
        ("action", np.array(0.5), r"action .*\(1, 2\).*\(1,\)"),
        ("next_observation", np.zeros((1, S)), r"next_observation .*\(1, 3\).*\(1, 1, 3\)"),
        ("observation", np.array(["a", "b", "c"]), "observation .*<U1"),
        ("observation", np.array([1.0, 2.0, None]), "observation .*object"),
    ],
)
def test_the_wrong_shape_or_kind_is_named(name, value, message):
    store = TransitionStore(S, A)
    with pytest.raises(EnvironmentDataError, match=rf"step 0: {message}"):
        store.append(**{**part(0, rows(1)), name: value})
    assert len(store) == 0


def test_double_precision_is_kept_beside_what_it_is_in_single():
    data, field = rows(10), "observation"
    data[field] += 1e9  # where float32 has steps of 64
    store = TransitionStore(S, A, capacity=4, observation_dtype=torch.float64)
    store.append(**part(0, data))
    store.extend(**part(slice(1, 10), data))
    assert_holds(store, data)
    exact = store.exact_transitions()
    np.testing.assert_array_equal(exact.observation, data["observation"])
    np.testing.assert_array_equal(exact.next_observation, data["next_observation"])
    assert torch.equal(exact.action, store.transitions().action)
    single = TransitionStore(S, A)
    single.extend(**data)
    assert all(
        a is b or torch.equal(a, b) for a, b in zip(single.transitions(), single.exact_transitions(), strict=True)
    )
    assert single.exact_transitions().observation.dtype == torch.float32


def test_rows_may_be_added_in_and_after_inference_mode():
    store, data = TransitionStore(S, A, capacity=1), rows(9)
    with torch.inference_mode():
        store.extend(**part(slice(0, 5), data))  # which makes new buffers
    store.extend(**part(slice(5, 8), data))
    store.append(**part(8, data))
    assert_holds(store, data)
    assert not any(field.is_inference() for field in store.transitions())


def test_fields_of_different_lengths_are_refused():
    data = rows(5)
    with pytest.raises(EnvironmentDataError, match=r"action .*\(5, 2\).*\(4, 2\)"):
        TransitionStore(S, A).extend(**{**data, "action": data["action"][:4]})


@pytest.mark.parametrize("sizes", [(0, 1, 1), (1, 0, 1), (1, 1, 0)])
def test_sizes_must_be_positive(sizes):
    with pytest.raises(ValueError, match=f"capacity .*{sizes[0]}, {sizes[1]} and {sizes[2]}"):
        TransitionStore(*sizes)


class TestStateDict:
    @pytest.mark.parametrize("n", [0, 1, 50])
    def test_a_round_trip_restores_everything_and_goes_on(self, n):
        data = rows(n + 10)
        store, other = TransitionStore(S, A, capacity=8), TransitionStore(S, A)
        store.extend(**part(slice(0, n), data))
        other.extend(**rows(3, seed=1))
        other.load_state_dict(store.state_dict())
        assert_holds(other, part(slice(0, n), data))
        other.extend(**part(slice(n, n + 10), data))
        assert_holds(other, data)
        assert len(store) == n

    def test_it_holds_copies_of_the_rows_alone(self):
        store = TransitionStore(S, A, capacity=1000)
        store.extend(**rows(5))
        state = store.state_dict()
        for value in state.values():
            assert value.untyped_storage().nbytes() == value.numel() * value.element_size()
            value.zero_()
        assert_holds(store, rows(5))

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda state: state.pop("action"), r"fields \['action', .*\['episode'"),
            (lambda state: state.update(extra=1), "fields .*'extra'"),
            (lambda state: state.update(reward=1.0), r"reward .*torch\.float32.*\bfloat$"),
            (lambda state: state.update(episode=torch.zeros(5)), r"episode .*int64.*torch\.float32"),
            (lambda state: state.update(action=torch.zeros(5, A + 1)), r"action .*\(5, 2\).*\(5, 3\)"),
            (lambda state: state.update(reward=torch.zeros(4)), r"observation .*\(4, 3\).*\(5, 3\)"),
            (lambda state: state.update(reward=torch.zeros(())), r"observation .*\(0, 3\).*\(5, 3\)"),
            (lambda state: state["observation"].fill_(math.nan), "step 0: observation.*nan"),
        ],
    )
    def test_a_state_that_does_not_fit_is_refused_and_nothing_is_lost(self, change, message):
        store, source = TransitionStore(S, A), TransitionStore(S, A)
        store.extend(**rows(7))
        source.extend(**rows(5, seed=1))
        state = source.state_dict()
        change(state)
        with pytest.raises(CheckpointError, match=message):
            store.load_state_dict(state)
        assert_holds(store, rows(7))

    def test_double_precision_is_saved_and_what_contradicts_it_is_refused(self):
        data = rows(6)
        data["next_observation"] += 1e9
        source, other = (TransitionStore(S, A, observation_dtype=torch.float64) for _ in range(2))
        source.extend(**data)
        state = source.state_dict()
        other.load_state_dict(state)
        np.testing.assert_array_equal(other.exact_transitions().next_observation, data["next_observation"])
        assert_holds(other, data)
        # A file of a store that had float32 alone is what the float32 say.
        single = {name: value for name, value in state.items() if not name.startswith("exact")}
        other.load_state_dict(single)
        assert torch.equal(other.exact_transitions().next_observation, state["next_observation"].double())
        for name in ("observation", "next_observation"):
            with pytest.raises(CheckpointError, match=rf"stored {name} "):
                other.load_state_dict(state | {name: state[name] + 1000.0})
        with pytest.raises(CheckpointError, match="'exact_observation'"):
            other.load_state_dict(single | {"exact_observation": state["exact_observation"]})
        with pytest.raises(CheckpointError, match="'exact_observation'"):
            TransitionStore(S, A).load_state_dict(state)
        assert_holds(other, data)
