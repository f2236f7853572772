"""What bounds a step: what was seen, and one and a half times its range on either side."""

import math

import pytest
import torch

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.bounds import SeenTargets, take_seen
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.types import ObservationSpec

CPU = torch.device("cpu")


def doubles(*values):
    return torch.tensor(values, dtype=torch.float64)


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_more_data_widen_what_was_seen_and_never_narrow_it():
    seen = SeenTargets.of(doubles([-1.0, 0.0], [3.0, 0.0], [2.0, 0.0]))
    assert same(seen, (doubles(-1.0, 0.0), doubles(3.0, 0.0)))
    assert same(seen.bounds(), (doubles(-7.0, 0.0), doubles(9.0, 0.0)))
    assert same(seen.and_of(doubles([0.0, 0.0])), seen)
    assert same(seen.and_of(torch.empty(0, 2).double()), seen)
    assert same(seen.and_of(doubles([7.0, -2.0], [0.0, 0.0])), (doubles(-1.0, -2.0), doubles(7.0, 0.0)))


def test_what_is_unbounded_stays_so():
    seen = SeenTargets.unbounded(2, CPU).and_of(doubles([1.0, 2.0]))
    assert same(seen.bounds(), (doubles(-math.inf, -math.inf), doubles(math.inf, math.inf)))


def test_a_state_gives_what_was_seen_and_an_older_one_no_bounds():
    seen = SeenTargets(doubles(-1.0, 0.0), doubles(3.0, 0.5))
    assert same(take_seen(seen.state(), 2, CPU), seen)
    assert same(take_seen({}, 2, CPU), SeenTargets.unbounded(2, CPU))
    with pytest.raises(ValueError, match=r"seen\.lowest"):
        take_seen({"seen.highest": seen.highest}, 2, CPU)


@pytest.mark.parametrize("states", [torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coordinates_keep_targets_within_their_bounds(dtype, states):
    """NaN stays, and spreads over its row; a change and a number that is predicted itself are bounded alike."""
    encoder = Encoder(2, 1, ObservationSpec(absolute=(1,)))
    inputs, targets = Normaliser(doubles(0, 0, 0), doubles(1, 1, 1)), Normaliser(doubles(0.5, 1.0), doubles(2.0, 0.25))
    coordinates = Coordinates(encoder, inputs, targets, dtype, SeenTargets(doubles(-1.0, 0.0), doubles(1.0, 2.0)))
    before = torch.tensor([8.0, 4.0], dtype=states).expand(1, 4, 2)
    target = torch.tensor([[-1.5, 2.5], [9.0, -math.inf], [-9.0, 5.5], [math.nan, 9.0]], dtype=dtype)
    after = coordinates.decode(before, target.unsqueeze(0))[0]
    # Bounds of -4 and 4, of -3 and 5: sums of powers of two, exact in any precision.
    expected = [[8 + 0.5 - 3, 1 + 2.5 / 4], [8 + 0.5 + 8, 1 - 3 / 4], [8 + 0.5 - 8, 1 + 5 / 4], [math.nan] * 2]
    torch.testing.assert_close(after, torch.tensor(expected, dtype=states), rtol=0, atol=0, equal_nan=True)
