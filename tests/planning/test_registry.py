"""Planners by name."""

import re

import numpy as np
import pytest
import torch
from gymnasium import spaces

from gym_dgpmpc.planning import CEM, PLANNERS, make_planner, planner_factory, register_planner
from tests.planning.toy_planners import RandomShooting

SPACE = spaces.Box(np.array([[-1.0, -2.0]]), np.array([[1.0, 3.0]]), dtype=np.float64)


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setattr("gym_dgpmpc.planning.registry.PLANNERS", dict(PLANNERS))
    register_planner("random-shooting", RandomShooting)


def test_by_name_class_function_and_object(registered):
    def function(low, high, **settings):
        return RandomShooting(low, high, **settings)

    for given in ("random-shooting", RandomShooting, function):
        planner = make_planner(given, SPACE, horizon=3, num_candidates=7)
        assert isinstance(planner, RandomShooting)
        assert (planner.horizon, planner.num_candidates) == (3, 7)
        assert torch.equal(planner.low, torch.tensor([-1.0, -2.0]))
        assert torch.equal(planner.high, torch.tensor([1.0, 3.0]))
        assert make_planner(planner, SPACE) is planner
    assert isinstance(make_planner("cem", SPACE), CEM)
    assert planner_factory("cem") is CEM


def test_a_ready_made_planner_has_its_settings():
    with pytest.raises(TypeError, match=r"\['horizon', 'num_elites'\]"):
        make_planner(make_planner("cem", SPACE), SPACE, num_elites=3, horizon=2)


def test_an_unknown_name_is_answered_with_those_there_are(registered):
    with pytest.raises(ValueError) as error:
        make_planner("simplex", SPACE)
    assert all(repr(name) in str(error.value) for name in ("simplex", *PLANNERS, "random-shooting"))


@pytest.mark.parametrize("given", [None, 3, torch.zeros(2)])
def test_what_makes_no_planner_is_refused(given, unchecked):
    with pytest.raises(TypeError, match=rf"planner must be.*{re.escape(str(given))}"):
        make_planner(given, SPACE)


def test_a_setting_that_the_planner_does_not_have():
    with pytest.raises(TypeError, match="temperature"):
        make_planner("cem", SPACE, temperature=1.0)


@pytest.mark.parametrize("name", ["", "CEM", "a b", "-a", "a-", "3d", "a--b", "a.b", "../a"])
def test_names_are_words(name):
    with pytest.raises(ValueError, match="lower-case words"):
        register_planner(name, RandomShooting)


def test_a_name_has_one_planner(registered):
    register_planner("random-shooting", RandomShooting)  # again, as when a module is run twice
    with pytest.raises(ValueError, match="'cem' is taken"):
        register_planner("cem", RandomShooting)


def test_a_factory_can_be_called(registered, unchecked):
    with pytest.raises(TypeError, match="factory"):
        register_planner("nothing", None)
