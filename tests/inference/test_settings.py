"""The sampler's settings."""

import pytest

from gym_dgpmpc.inference.settings import InferenceSettings


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("decay", (0.0, 1.0), (-1e-9, 1.0 + 1e-9)),
        ("step_size", (1e-300, 10.0), (0.0, -1.0, float("inf"), float("nan"))),
        ("hyperparameter_step_size", (1e-300, 10.0), (0.0, -1.0, float("inf"), float("nan"))),
        ("learning_rate", (1e-300, 10.0), (0.0, -1.0, float("inf"), float("nan"))),
        ("gibbs_every", (0, 1), (-1,)),
        ("patience", (None, 1), (0,)),
        ("window_size", (1,), (0,)),
        ("hyperparameters_every", (1,), (0,)),
        ("hyperparameters", ("sampled", "optimised"), ("fixed",)),
    ],
)
def test_settings_have_ranges_of_which_the_ends_are_told(name, good, bad):
    for value in good:
        assert getattr(InferenceSettings(**{name: value}), name) == value
    for value in bad:
        with pytest.raises(ValueError, match=rf"{name} .*{value}"):
            InferenceSettings(**{name: value})
