"""What the model reads and predicts, and the way back to the next observation."""

import math
import re

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.types import ObservationSpec
from tests.oracles.models import normal, seeded

CARTPOLE = ObservationSpec(angles=(1,))


def decoded(encoder, observation, target):
    """The way back, as rollouts take it, from targets that are not standardised."""
    inputs, targets = (
        Normaliser(torch.zeros(size), torch.ones(size)) for size in (encoder.input_size, encoder.target_size)
    )
    return Coordinates(encoder, inputs, targets, torch.float64).decode(observation, target)


def test_the_cart_pole_has_the_layout_of_pets():
    encoder = Encoder(4, 1, CARTPOLE)
    assert (encoder.input_size, encoder.target_size) == (6, 4)
    observation, action = torch.tensor([[1.0, 0.5, 2.0, 3.0]]), torch.tensor([[-4.0]])
    expected = torch.tensor([[1.0, 2.0, 3.0, math.sin(0.5), math.cos(0.5), -4.0]])
    torch.testing.assert_close(encoder.inputs(observation, action), expected)
    after = observation + torch.tensor([[0.1, 0.2, 0.3, 0.4]])
    torch.testing.assert_close(encoder.targets(observation, after), torch.tensor([[0.1, 0.2, 0.3, 0.4]]))


def test_every_kind_of_dimension_at_once():
    """A velocity that is predicted itself and not fed, an angle, a goal that is fed but fixed, a plain number."""
    encoder = Encoder(4, 2, ObservationSpec(angles=(1,), absolute=(0,), not_inputs=(0,), constant=(2,)))
    assert (encoder.input_size, encoder.target_size) == (2 + 2 + 2, 3)
    observation = torch.tensor([9.0, 0.25, 5.0, 7.0], dtype=torch.float64)
    after = torch.tensor([8.0, 0.5, -1.0, 7.5], dtype=torch.float64)
    inputs = encoder.inputs(observation, torch.tensor([1.0, 2.0], dtype=torch.float64))
    assert inputs.tolist() == [5.0, 7.0, math.sin(0.25), math.cos(0.25), 1.0, 2.0]
    target = encoder.targets(observation, after)
    assert target.tolist() == [8.0, 0.25, 0.5]
    assert decoded(encoder, observation, target).tolist() == [8.0, 0.5, 5.0, 7.5]
    assert observation[0] == 9.0, "the argument is left alone"


@pytest.mark.parametrize(
    ("before", "after"), [(3.1, -3.1), (-3.1, 3.1), (0.1, 2 * math.pi - 0.1), (40.0, 3.0), (0.0, 3.0)]
)
def test_the_change_of_an_angle_is_the_smaller_way_round(before, after):
    encoder = Encoder(1, 1, ObservationSpec(angles=(0,)))
    observation, next_observation = (torch.tensor([[value]], dtype=torch.float64) for value in (before, after))
    change = encoder.targets(observation, next_observation)
    assert abs(change.item()) <= math.pi
    reached = decoded(encoder, observation, change).item()
    turns = (reached - after) / (2 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-12)


def test_an_absolute_angle_is_predicted_as_it_is():
    encoder = Encoder(1, 1, ObservationSpec(angles=(0,), absolute=(0,)))
    assert encoder.targets(torch.tensor([[0.0]]), torch.tensor([[7.0]])).item() == 7.0
    assert decoded(encoder, torch.tensor([[1.0]]), torch.tensor([[7.0]])).item() == 7.0


@st.composite
def specs(draw):
    size = draw(st.integers(1, 6))

    def subset():
        return tuple(sorted(draw(st.sets(st.integers(0, size - 1)))))

    constant = subset()
    if len(constant) == size:
        constant = constant[1:]
    fields = {"angles": subset(), "absolute": subset(), "not_inputs": subset(), "constant": constant}
    if size >= 3 and draw(st.booleans()):
        heading, x, y = draw(st.permutations(range(size)))[:3]
        fields = {name: tuple(i for i in indices if i not in (x, y)) for name, indices in fields.items()}
        for name in ("absolute", "not_inputs", "constant"):
            something_is_left = name != "constant" or len(fields[name]) + 2 < size
            fields[name] += (x, y) if draw(st.booleans()) and something_is_left else ()
        fields["body_frame"] = ((heading, x, y),)
    return size, fields


@settings(max_examples=60, deadline=None)
@given(
    case=specs(), action_size=st.integers(1, 3), seed=st.integers(0, 1000), batch=st.sampled_from([(), (3,), (2, 3)])
)
def test_the_next_observation_is_recovered_from_the_targets(case, action_size, seed, batch):
    size, spec = case[0], ObservationSpec(**case[1])
    encoder, generator = Encoder(size, action_size, spec), seeded(seed)
    observation, after = 3.0 * normal(generator, *batch, size), 3.0 * normal(generator, *batch, size)
    target = encoder.targets(observation, after)
    assert target.shape == (*batch, encoder.target_size)
    recovered = decoded(encoder, observation, target)
    for i in range(size):
        if i in spec.constant:
            assert torch.equal(recovered[..., i], observation[..., i])
            continue
        error = recovered[..., i] - after[..., i]
        if i in spec.angles and i not in spec.absolute:
            error = torch.sin(0.5 * error)  # zero for whole turns
        assert error.abs().max() < 1e-12
    inputs = encoder.inputs(observation, normal(generator, *batch, action_size))
    assert inputs.shape == (*batch, encoder.input_size)


def test_inputs_do_not_see_a_whole_turn_nor_what_is_not_fed():
    encoder = Encoder(4, 1, ObservationSpec(angles=(1,), not_inputs=(3,)))
    observation, action = normal(seeded(), 5, 4), normal(seeded(1), 5, 1)
    moved = observation + torch.tensor([0.0, 2 * math.pi, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(encoder.inputs(moved, action), encoder.inputs(observation, action), rtol=0, atol=1e-14)


def rigidly_turned(vectors, angle):
    """Vectors "*b 2" turned anticlockwise, as complex numbers."""
    turned = torch.view_as_complex(vectors.contiguous()) * torch.exp(1j * torch.as_tensor(angle))
    return torch.view_as_real(turned)


def test_turning_the_whole_world_changes_neither_inputs_nor_targets():
    """The swimmer's layout with its places: they are no inputs, like the heading, but change along the body."""
    encoder = Encoder(7, 2, ObservationSpec(angles=(2,), not_inputs=(0, 1, 2), body_frame=((2, 0, 1), (2, 4, 5))))
    assert (encoder.input_size, encoder.target_size) == (4 + 2, 7)
    observation, after, action = (normal(seeded(i), 20, n) for i, n in enumerate((7, 7, 2)))
    turned = [state.clone() for state in (observation, after)]
    for state in turned:
        for first in (0, 4):
            state[:, first : first + 2] = rigidly_turned(state[:, first : first + 2], 0.7)
        state[:, 2] += 0.7
    torch.testing.assert_close(encoder.inputs(turned[0], action), encoder.inputs(observation, action))
    target = encoder.targets(observation, after)
    torch.testing.assert_close(encoder.targets(*turned), target)
    torch.testing.assert_close(decoded(encoder, turned[0], target)[:, :2], turned[1][:, :2])


def test_a_targets_magnitude_is_that_of_the_numbers_it_was_computed_from():
    spec = ObservationSpec(absolute=(1,), constant=(2,), body_frame=((0, 3, 4),))
    observation = torch.tensor([[1.0, 90.0, 5.0, -30.0, 0.5], [-2.0, 80.0, 5.0, 20.0, 0.5]])
    after = torch.tensor([[1.5, 7.0, 5.0, -29.0, 0.5], [-3.0, -8.0, 5.0, 20.0, 0.5]])
    found = Encoder(5, 1, spec).target_magnitudes(observation, after)
    assert found.tolist() == [3.0, 8.0, 30.0, 30.0], "turning mixes the two numbers of a vector"


def test_a_body_that_heads_north_moves_forwards_northwards():
    encoder = Encoder(3, 0, ObservationSpec(not_inputs=(0,), body_frame=((0, 1, 2),)))
    north = torch.tensor([math.pi / 2, 0.0, 2.0], dtype=torch.float64)
    assert encoder.inputs(north, north[:0]).tolist() == pytest.approx([2.0, 0.0], abs=1e-15)
    faster = north + torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)
    assert encoder.targets(north, faster).tolist() == pytest.approx([0.0, 0.5, 0.0], abs=1e-15)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"body_frame": ((0, 1, 4),)}, r"body_frame .*\b3\b.*\(0, 1, 4\)"),
        ({"body_frame": ((0, 1, 1),)}, r"body_frame .*\(0, 1, 1\)"),
        ({"body_frame": ((0, 1, 2), (0, 2, 3))}, r"body_frame .*\(\(0, 1, 2\), \(0, 2, 3\)\)"),
        ({"body_frame": ((0, 1, 2), (1, 0, 3))}, r"body_frame .*\(\(0, 1, 2\), \(1, 0, 3\)\)"),
        ({"body_frame": ((0, 1, 2),), "absolute": (1,)}, r"absolute .*\b1 and 2\b.*\(1,\)"),
        ({"body_frame": ((0, 1, 2),), "constant": (2, 3)}, r"constant .*\b1 and 2\b.*\(2, 3\)"),
        ({"body_frame": ((0, 1, 2),), "not_inputs": (2,)}, r"not_inputs .*\b1 and 2\b.*\(2,\)"),
        ({"body_frame": ((0, 1, 2),), "angles": (2,)}, r"angles .*\b1 or 2\b.*\(2,\)"),
    ],
)
def test_bad_vectors_are_named(fields, message):
    with pytest.raises(ValueError, match=message):
        Encoder(4, 1, ObservationSpec(**fields))


@pytest.mark.parametrize("field", ["angles", "absolute", "not_inputs", "constant"])
@pytest.mark.parametrize("indices", [(4,), (-1,), (0, 0)])
def test_bad_indices_are_named(field, indices):
    with pytest.raises(ValueError, match=rf"{field} .*\b3\b.*{re.escape(str(indices))}$"):
        Encoder(4, 1, ObservationSpec(**{field: indices}))


def test_nothing_to_predict_is_an_error():
    with pytest.raises(ValueError, match=r"predict.*constant=\(0, 1\)"):
        Encoder(2, 1, ObservationSpec(constant=(0, 1)))


def test_nothing_to_feed_is_an_error():
    with pytest.raises(ValueError, match=r"feed.*not_inputs=\(0, 1\)"):
        Encoder(2, 0, ObservationSpec(not_inputs=(0, 1)))


def test_the_action_alone_can_be_fed():
    encoder = Encoder(2, 1, ObservationSpec(not_inputs=(0, 1)))
    assert encoder.inputs(torch.zeros(3, 2), torch.full((3, 1), 2.0)).tolist() == [[2.0]] * 3
