"""Standardisation, and the dimensions that must not be divided by rounding."""

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings

from gym_dgpmpc.data.normaliser import Normaliser
from tests.oracles.models import normal, seeded


def test_fitted_data_have_zero_mean_and_unit_deviation():
    data = normal(seeded(), 200, 3) * torch.tensor([1e-4, 1.0, 1e6]).double() + torch.tensor([1.0, 0.0, -1e7]).double()
    standardised = Normaliser.fit(data)(data)
    torch.testing.assert_close(standardised.mean(0), torch.zeros(3).double(), rtol=0, atol=1e-9)
    torch.testing.assert_close(standardised.std(0, correction=0), torch.ones(3).double(), rtol=1e-9, atol=0)


@pytest.mark.parametrize("value", [0.0, 1.0, 0.1, -1234.5])
def test_a_constant_dimension_becomes_zero(value):
    normaliser = Normaliser.fit(torch.full((50, 1), value))
    assert normaliser.std.item() == 1.0
    assert normaliser(torch.full((50, 1), value)).abs().max() < 1e-3  # 0.1 is not the same in both precisions
    assert normaliser.mean.item() == pytest.approx(value, rel=1e-7)


@pytest.mark.parametrize("value", [1.0, 1e-3, 2.5e4])
def test_rounding_of_single_precision_is_not_a_signal(value):
    """A fixed goal that the simulator computes anew at each step differs in the last bit."""
    single = np.float32(value)
    data = torch.tensor([single, np.nextafter(single, np.float32(np.inf))] * 20).unsqueeze(1)
    assert len(data.unique()) == 2
    assert Normaliser.fit(data).std.item() == 1.0


def test_the_rounding_of_a_difference_is_that_of_its_terms():
    single = np.float32(5000.0)
    rows = torch.tensor([np.nextafter(single, np.float32(sign * np.inf)) for sign in (-1, 1)] * 20).unsqueeze(1)
    change = rows.roll(1, 0).double() - rows.double()
    # Steps of two units in the last place up and down; the sample's deviation is up to sqrt(40 / 39) of that.
    assert Normaliser.fit(change).std.item() == pytest.approx(2 * np.spacing(single), rel=0.02)
    assert Normaliser.fit(change, rows.abs().amax(0)).std.item() == 1.0
    signal = 0.1 * normal(seeded(), 40, 1)
    assert Normaliser.fit(signal, rows.abs().amax(0)).std.item() == Normaliser.fit(signal).std.item()


@pytest.mark.parametrize(
    ("precision", "magnitude", "rounding"),
    [
        (torch.float32, 1.0, 2**-21),
        (torch.float32, 1e6, 2**-21 * 1e6),
        (torch.float64, 1.0, 1e-9),
        (torch.float64, 1e9, 2**-50 * 1e9),
        (torch.float32, 0.0, 1e-12),
        (torch.float64, 1e-5, 2**-21 * 1e-5),
    ],
)
def test_four_units_in_the_last_place_are_taken_for_rounding(precision, magnitude, rounding):
    """In float64 a solver's own error too, 1e-9, unless float32 would resolve less; and 1e-12 in any case."""
    signs = torch.tensor([1.0, -1.0] * 10, dtype=torch.float64).unsqueeze(1)  # of standard deviation one
    for share, is_signal in ((0.99, False), (1.01, True)):
        data = share * rounding * signs
        std = Normaliser.fit(data, torch.tensor([magnitude], dtype=torch.float64), precision).std.item()
        assert std == pytest.approx(share * rounding if is_signal else 1.0, rel=1e-12)
    four_units = Normaliser.fit(2**-21 * signs, torch.ones(1, dtype=torch.float64))  # exactly, and still rounding
    assert four_units.std.item() == 1.0


def test_a_small_signal_on_a_large_offset_is_kept():
    data = 100.0 + 1e-2 * normal(seeded(), 500, 1)
    assert Normaliser.fit(data.float()).std.item() == pytest.approx(1e-2, rel=0.1)


def test_one_row_is_enough():
    normaliser = Normaliser.fit(torch.tensor([[3.0, -1.0]]))
    assert normaliser.mean.tolist() == [3.0, -1.0] and normaliser.std.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_statistics_are_double_precision(dtype):
    normaliser = Normaliser.fit(torch.ones(4, 2, dtype=dtype))
    assert normaliser.mean.dtype == normaliser.std.dtype == torch.float64


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float64, hnp.array_shapes(min_dims=2, max_dims=2, max_side=6), elements=st.floats(-1e6, 1e6)))
def test_the_inverse_undoes_it(data):
    data = torch.from_numpy(data)
    normaliser = Normaliser.fit(data)
    assert (normaliser.std > 0).all()
    scale = data.abs().amax().item() + normaliser.std.max().item()
    torch.testing.assert_close(normaliser.inverse(normaliser(data)), data, rtol=0, atol=1e-12 * scale)
