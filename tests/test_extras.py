"""What is missing is named with an extra that there is."""

import re
from pathlib import Path

import pytest

from gym_dgpmpc.extras import EXTRAS, how_to_install, missing_module


def test_the_extras_are_those_of_the_package():
    lines = Path(__file__).parents[1].joinpath("pyproject.toml").read_text(encoding="utf-8")
    assert set(EXTRAS.values()) <= set(re.findall(r"^(\w+) = \[", lines, re.MULTILINE))


@pytest.mark.parametrize(
    ("module", "told"),
    [("pygame.gfxdraw", 'pip install "gym-dgpmpc[classic]"'), ("pygamelike", "install it")],
)
def test_how_to_install(module, told):
    assert how_to_install(module) == told


def test_the_module_is_found_behind_an_error_without_a_name():
    with pytest.raises(ModuleNotFoundError) as found:
        try:
            raise ModuleNotFoundError("No module named 'x'", name="x")
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("registration failed") from error
    assert missing_module(found.value) == "x"
    assert missing_module(ModuleNotFoundError("registration failed")) is None
