"""Counts are whole numbers of at least one, and what is none is named."""

import re

import numpy as np
import pytest

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.checks import check_counts
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
