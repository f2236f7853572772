"""Counts are whole numbers of at least one, reals lie in their intervals, and what does not is named."""

import re

import numpy as np
import pytest

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.checks import check_counts, check_reals
from tests.agents.point_mass import KnownPointMass


def test_counts_of_any_integer_type():
    check_counts(a=1, b=np.int64(3))


@pytest.mark.parametrize("value", ["2", 2.0, True, None, np.float32(3)])
def test_what_is_no_whole_number(value):
    with pytest.raises(TypeError, match=rf"size .*{re.escape(repr(value))}$"):
        check_counts(size=value)


@pytest.mark.parametrize("value", [0, -3])
def test_less_than_one(value):
    with pytest.raises(ValueError, match=f"size .*{value}$"):
        check_counts(size=value)


@pytest.mark.parametrize(
    ("name", "value"),
    [("num_layers", 2.0), ("num_candidates", "300"), ("horizon", 20.5), ("num_particles", "5"), ("train_freq", 1e2),
     ("first_training_iterations", 1e1)],
)  # fmt: skip
def test_an_agent_refuses_them_when_it_is_made(name, value, unchecked):
    with pytest.raises(TypeError, match=rf"{name} .*{re.escape(repr(value))}$"):
        DGPMPCAgent(KnownPointMass(), **{name: value})


def test_a_time_budget_that_is_no_number(unchecked):
    with pytest.raises(ValueError, match=r"time_budget .*'0\.04'$"):
        DGPMPCAgent(KnownPointMass(), time_budget="0.04")


@pytest.mark.parametrize(
    ("interval", "inside", "outside"),
    [
        ("[0, 1)", [0, 0.5, np.float32(0.9)], [1.0, -1e-9, float("nan")]),
        ("(0, inf)", [1e-300, 1e300], [0.0, float("inf")]),
        ("(-1, 1]", [1, -0.99], [-1.0, 1.01]),
    ],
)
def test_reals_in_an_interval(interval, inside, outside):
    for value in inside:
        check_reals(interval, share=value)
    for value in outside:
        with pytest.raises(ValueError, match=re.escape(f"share must lie in {interval}, got {value}")):
            check_reals(interval, share=value)
    for value in ("0.5", None, True, 1j):
        with pytest.raises(TypeError, match=rf"share .*{re.escape(repr(value))}$"):
            check_reals(interval, share=value)
