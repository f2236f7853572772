"""Settings are read from the one place where they are named, documented and defaulted."""

from dataclasses import dataclass, replace
from functools import partial

import pytest

from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.dynamics.ensemble import EnsembleDynamics
from gym_dgpmpc.dynamics.sparse_gp import SparseGPDynamics
from gym_dgpmpc.planning import CEM
from gym_dgpmpc.settings import LARGEST_NUMBER, argument_texts, joined, of_member, refuse_unknown, settings_of


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


def test_members_have_their_settings_under_their_names():
    """With the limits that they have themselves, and with the defaults of a partial."""

    class Pair:
        """Two of them.

        Args:
            ratio: of the two.
        """

        members_by_name = {"first-model": Model, "second": partial(Model, width=5)}  # noqa: RUF012

        def __init__(self, *, ratio: float = 1.0, **settings):
            pass

    found, own = settings_of(Pair), settings_of(Model)
    named = [f"{member}_{name}" for member in ("first_model", "second") for name in own]
    assert list(found) == ["ratio", *named]
    assert found["first_model_width"] == replace(own["width"], name="first_model_width")
    assert found["second_width"] == replace(own["width"], name="second_width", default=5)
    assert not found["second_high"].is_saved
    assert of_member("first-model", "step_size") == "first_model_step_size" in found


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


@pytest.mark.parametrize(
    ("part", "published"),
    [
        # The paper's planner on its cart-pole.
        (CEM, {"horizon": 30, "num_candidates": 300, "num_elites": None, "num_iterations": 5, "smoothing": 0.1}),
        # Its model; how it is trained, and what of that is not the paper's, is in docs/deviations.md.
        (
            DeepGPDynamics,
            {
                "num_layers": 2, "num_inducing": 100, "refresh": "plan", "num_features": 64,
                "first_training_iterations": 1000, "training_iterations": 300, "num_chains": 5, "num_samples": 100,
                "sample_spacing": 20, "resample_samples": 5, "relocate": True, "add_noise": True, "split_noise": True,
                "compile": True, "step_size": 0.1, "decay": 0.05, "hyperparameters": "optimised",
                "hyperparameter_step_size": 0.02, "learning_rate": 0.1, "hyperparameters_every": 1, "window_size": 1,
                "batch_size": 256, "gibbs_every": 20, "gibbs_rows": 4096, "patience": None, "look_every": 100,
            },
        ),
        # PETS's networks, their decays and their training, as its published code has them.
        (
            EnsembleDynamics,
            {
                "num_members": 5, "num_hidden_layers": 3, "hidden_size": 500, "batch_size": 32, "num_epochs": 5,
                "weight_decay": (1e-4, 2.5e-4, 2.5e-4, 5e-4), "learning_rate": 1e-3, "half_precision": False,
            },
        ),
        (
            SparseGPDynamics,
            {
                "num_inducing": 200, "exact": False, "max_training_iterations": 200, "add_noise": False,
                "update_within_episode": False,
            },
        ),
    ],
)  # fmt: skip
def test_defaults_are_what_the_results_were_published_with(part, published):
    """A result file says only what it was asked for, so another default would be another result of the same name."""
    defaults = {name: setting.default for name, setting in settings_of(part).items()}
    assert {name: defaults[name] for name in published} == published


@pytest.mark.parametrize(
    ("part", "largest"),
    [
        (CEM, {"horizon": 10_000, "num_candidates": 100_000}),
        (DeepGPDynamics, {"num_layers": 100, "num_features": 100_000}),
    ],
)
def test_files_with_numbers_up_to_these_were_written_and_have_to_be_read(part, largest):
    settings = settings_of(part)
    assert {name: settings[name].largest for name in largest} == largest
