"""Settings are read from the one place where they are named, documented and defaulted."""

from dataclasses import dataclass

import pytest

from gym_dgpmpc.settings import LARGEST_NUMBER, argument_texts, joined, refuse_unknown, settings_of


@dataclass(frozen=True)
class Sampler:
    """How to sample.

    Attributes:
        step_size: of a step; smaller is
            safer.
        decay: the friction.
    """

    step_size: float = 0.5
    decay: float = 0.1


class Model:
    """A model.

    Args:
        size: is given by the agent.
        width: how wide.
        low, high: from here to there.
        **sampler: those of `Sampler`.

    Raises:
        ValueError: width: is not a setting here.
    """

    composed_of = (Sampler,)
    largest = {"width": 7}  # noqa: RUF012
    unsaved = ("high",)

    def __init__(
        self, size: int, spec=None, *, width: int = 3, low: float = 0.0, high: float = 1.0, device="cpu", **sampler
    ):
        pass


def test_settings_are_keyword_arguments_with_a_default_and_those_of_the_classes_it_is_composed_of():
    settings = settings_of(Model)
    assert list(settings) == ["width", "low", "high", "step_size", "decay"]
    assert {name: setting.default for name, setting in settings.items()} == {
        "width": 3, "low": 0.0, "high": 1.0, "step_size": 0.5, "decay": 0.1,
    }  # fmt: skip
    assert settings["width"].text == "how wide."
    assert settings["low"].text == settings["high"].text == "from here to there."
    assert settings["step_size"].text == "of a step; smaller is safer."
    assert settings["width"].annotation is int
    assert (settings["width"].largest, settings["low"].largest) == (7, LARGEST_NUMBER)
    assert [name for name, setting in settings.items() if not setting.is_saved] == ["high"]


def test_texts_end_with_their_section():
    texts = argument_texts("Says.\n\nArgs:\n    a: first.\n\nReturns:\n    b: no argument.\n")
    assert texts == {"a": "first."}


def test_two_parts_with_a_setting_of_one_name_are_refused():
    with pytest.raises(ValueError, match="step_size"):
        joined(settings_of(Model), settings_of(Sampler))


def test_an_unknown_setting_is_named_with_what_may_have_been_meant():
    with pytest.raises(TypeError, match=r"Agent.*'widht'.*'width'"):
        refuse_unknown("Agent", ["width", "widht"], settings_of(Model))
