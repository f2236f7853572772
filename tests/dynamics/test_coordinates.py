"""From raw states to standardised coordinates and back: what a model that knows the targets exactly would roll out."""

import math

import pytest
import torch

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.types import ObservationSpec
from tests.oracles.models import normal, seeded

SPECS = {
    "plain": ObservationSpec(),
    "angles": ObservationSpec(angles=(0, 3), not_inputs=(1,)),
    "absolute and constant": ObservationSpec(absolute=(1,), constant=(2, 4)),
    "vectors": ObservationSpec(angles=(0,), body_frame=((0, 1, 2),), absolute=(1, 2)),
    "vectors that change": ObservationSpec(angles=(0,), body_frame=((0, 4, 3),)),
}


@pytest.mark.parametrize("states", [torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_decoding_exact_targets_gives_the_next_state(spec, dtype, states):
    generator, encoder = seeded(), Encoder(5, 2, spec)
    before, action = normal(generator, 40, 5), normal(generator, 40, 2)
    after = before + 0.3 * normal(generator, 40, 5)
    constant = list(spec.constant)
    after[:, constant] = before[:, constant]
    x, y = encoder.inputs(before, action), encoder.targets(before, after)
    inputs, targets = Normaliser.fit(x), Normaliser.fit(y)
    coordinates = Coordinates(encoder, inputs, targets, dtype)
    rounding = 64 * torch.finfo(torch.float32).eps
    if dtype == states == torch.float64:
        rounding = 64 * torch.finfo(torch.float64).eps

    start = before.to(states).unsqueeze(0).expand(3, -1, -1)
    encoded = coordinates.encode(start, action.to(states))
    assert encoded.dtype == dtype and encoded.shape == (3, 40, encoder.input_size)
    torch.testing.assert_close(encoded.double(), inputs(x).expand(3, -1, -1), rtol=0, atol=10 * rounding)

    decoded = coordinates.decode(start, targets(y).to(dtype).expand(3, -1, -1))
    assert decoded.dtype == states
    turns = (decoded.double() - after) / (2 * math.pi)
    error = decoded.double() - after - 2 * math.pi * turns.round() * torch.tensor([i in spec.angles for i in range(5)])
    assert error.abs().max() < rounding * 4


def test_large_float64_states_lose_nothing_but_what_is_added_to_them():
    """With an offset of 1e9, where float32 has steps of 64, what is added is rounded and the state is not."""
    generator, encoder = seeded(), Encoder(2, 1, ObservationSpec(absolute=(1,)))
    before, action = 1e9 + normal(generator, 30, 2), normal(generator, 30, 1)
    after = before + normal(generator, 30, 2)
    inputs = Normaliser.fit(encoder.inputs(before, action), precision=torch.float64)
    targets = Normaliser.fit(encoder.targets(before, after), precision=torch.float64)
    coordinates = Coordinates(encoder, inputs, targets, torch.float32)
    standardised = targets(encoder.targets(before, after)).float()
    decoded = coordinates.decode(before.unsqueeze(0), standardised.unsqueeze(0))[0]
    rounding = 1e9 * 2**-52 + 8 * 2**-23  # of the state, and of a change of up to some units
    assert (decoded - after).abs().max() < 2 * rounding
    encoded = coordinates.encode(before.unsqueeze(0), action)[0].double()
    assert (encoded - inputs(encoder.inputs(before, action))).abs().max() < 2 * rounding
