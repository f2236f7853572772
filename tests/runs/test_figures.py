"""The figures show the numbers that they are given, and labels come from the environments' own tables."""

import gymnasium
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc.runs import figures
from gym_dgpmpc.runs.figures import Forecast, observation_labels, plot_learning_curve, plot_prediction_fan
from tests.runs.toy import ToyPush


def forecast(horizon=10, particles=200, size=2, seed=0):
    """Particles spread by N(0, 1) about a truth of zeros, save for a common starting point."""
    predicted = np.random.default_rng(seed).normal(size=(horizon + 1, particles, size))
    predicted[0] = 0.0
    return Forecast(5, predicted, np.zeros((horizon + 1, size)))


def test_learning_curve(drawn, tmp_path):
    plot_learning_curve([-3.0, 40.0, 90.0], tmp_path / "a.png", title="a title", episode_steps=[200, 200, 150])
    (axes,) = drawn[0].axes
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), [[1, -3], [2, 40], [3, 90]])
    planned, random = axes.collections
    np.testing.assert_array_equal(planned.get_offsets(), [[2, 40], [3, 90]])
    np.testing.assert_array_equal(random.get_offsets(), [[1, -3]])
    assert "550 environment steps" in axes.get_xlabel()
    assert axes.get_title() == "a title"
    assert Image.open(tmp_path / "a.png").size[0] > 500


def test_a_picture_that_cannot_be_drawn_leaves_the_old_one(tmp_path, monkeypatch):
    def full_disk(figure, file, **kwargs):
        file.write(b"half a picture")
        raise OSError(28, "no space left on device")

    path = tmp_path / "a.png"
    plot_learning_curve([-3.0, 40.0], path, title="a title")
    before = path.read_bytes()
    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(OSError, match="no space"):
        plot_learning_curve([-3.0, 90.0], path, title="a title")
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_suffix_decides_the_format(tmp_path):
    plot_learning_curve([-3.0, 40.0], tmp_path / "a.pdf", title="a title")
    plot_learning_curve([-3.0, 40.0], tmp_path / "a.svg", title="a title")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert b"<svg" in (tmp_path / "a.svg").read_bytes()


def test_learning_curve_of_nothing(tmp_path):
    with pytest.raises(ValueError, match="episode"):
        plot_learning_curve([], tmp_path / "a.png", title="")
    with pytest.raises(ValueError, match=r"episode_steps .*\b2\b.*\b1$"):
        plot_learning_curve([1.0, 2.0], tmp_path / "a.png", title="", episode_steps=[200])


def test_fan(drawn, tmp_path):
    plot_prediction_fan(
        [forecast(), forecast(horizon=4)],
        tmp_path / "a.png",
        labels=["place (m)", "speed (m/s)"],
        title="a title",
        step_seconds=0.04,
    )
    figure = drawn[0]
    panels = np.array(figure.axes).reshape(2, 2)
    assert [panel.get_ylabel() for panel in panels[:, 0]] == ["place (m)", "speed (m/s)"]
    assert "0.04 s" in panels[1, 0].get_xlabel()
    assert "10 steps ahead from step 5" in panels[0, 0].get_title()
    truth = panels[0, 0].lines[-1]
    assert truth.get_label() == "what happened"
    np.testing.assert_array_equal(truth.get_xdata(), np.arange(5, 16))
    assert "10 of 10 inside the 90% band" in panels[0, 0].texts[0].get_text()
    assert "4 of 4" in panels[0, 1].texts[0].get_text()


def test_bands_hold_what_they_say():
    predicted = np.random.default_rng(0).normal(size=(200, 400))
    for probability in (0.5, 0.9):
        low, high = figures._interval(predicted, probability)
        inside = (low[:, None] <= predicted) & (predicted <= high[:, None])
        # At most two of 400 particles more than asked for, as the bounds are particles themselves.
        assert np.all((inside.mean(1) >= probability) & (inside.mean(1) <= probability + 2 / 400 + 1e-12))


def test_a_diverged_particle_widens_the_band():
    predicted = np.zeros((2, 10))
    predicted[1, 0] = np.nan
    low, high = figures._interval(predicted, 0.9)
    np.testing.assert_array_equal(low, [0, -np.inf])
    np.testing.assert_array_equal(high, [0, np.inf])


def test_fan_of_a_diverging_model_still_shows_the_truth(drawn, tmp_path):
    exploding = forecast()
    observed = np.linspace([0, 0], [1, 1], 11)
    exploding.predicted[5:, :50] = 1e30
    exploding.predicted[8:, :30] = np.nan
    plot_prediction_fan([exploding._replace(observed=observed)], tmp_path / "a.png", labels=["a", "b"], title="")
    low, high = drawn[0].axes[0].get_ylim()
    assert low < 0
    assert 1 < high < 10


def test_fan_leaves_out_what_never_changes(drawn, tmp_path):
    still = forecast()
    still.predicted[:, :, 0] = 7.0
    plot_prediction_fan([still], tmp_path / "a.png", labels=["still", "moving"], title="t")
    assert [panel.get_ylabel() for panel in drawn[0].axes] == ["moving"]
    assert "1 of 2 dimensions not shown" in drawn[0].get_suptitle()


def test_fan_of_nothing(tmp_path):
    with pytest.raises(ValueError, match="forecast"):
        plot_prediction_fan([], tmp_path / "a.png", labels=[], title="")
    with pytest.raises(ValueError, match=r"labels .*\b2\b.*\b1$"):
        plot_prediction_fan([forecast()], tmp_path / "a.png", labels=["a"], title="")


@pytest.mark.parametrize("env_id", sorted(id for id in gymnasium.registry if "CartPole-v0" in id and "Mod" in id))
def test_labels_of_this_packages_environments(env_id):
    env = gymnasium.make(env_id).unwrapped
    labels = observation_labels(type(env), env.observation_space.shape[0])
    assert labels[1] == "Angle theta of the pole (rad)"
    assert labels[2] == "Velocity of the cart (m/s)"


def test_labels_of_gymnasiums_environments():
    env = gymnasium.make("HalfCheetah-v5").unwrapped
    assert observation_labels(type(env), 17)[1] == "angle of the front tip (rad)"


def test_labels_only_count_where_no_table_fits():
    assert observation_labels(ToyPush, 2) == ["place (m)", "last push (N)"]
    assert observation_labels(ToyPush, 3) == ["observation 0", "observation 1", "observation 2"]
    assert observation_labels(object, 1) == ["observation 0"]
