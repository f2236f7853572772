"""The figures of the contact study show the numbers that they are given, each in its panel."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.contact.figures import KERNEL_COLOURS, SAMPLE_COLOUR, TRUTH_COLOUR, plot_fans, plot_scores_by_step
from benchmarks.contact.result_files import ContactKey
from tests.benchmarks.contact.made_up import made_up

STEPS = np.arange(1, 16)


def fan(kernel, layers, seed=0):
    """A run whose paths and truth are unlike those of every other setting and at every step."""
    rng = np.random.default_rng([layers, len(kernel), seed])
    paths, truth = rng.normal(size=(5, 15)), rng.normal(size=15)
    return replace(made_up(ContactKey("a", kernel, layers, seed), 0.0), paths=paths.tolist(), truth=truth.tolist())


def test_each_panel_has_its_settings_samples_and_truth(drawn, tmp_path):
    results = {(kernel, layers): fan(kernel, layers) for kernel, layers in [("matern12", 1), ("rbf", 1), ("rbf", 3)]}
    plot_fans(results, tmp_path / "a.png")
    grid = np.array(drawn[0].axes).reshape(2, 2)  # smooth kernels first, depth to the right
    for (kernel, layers), (row, column) in {("rbf", 1): (0, 0), ("rbf", 3): (0, 1), ("matern12", 1): (1, 0)}.items():
        *samples, truth = grid[row, column].lines
        result = results[kernel, layers]
        np.testing.assert_array_equal([line.get_ydata() for line in samples], result.paths)
        np.testing.assert_array_equal(truth.get_ydata(), result.truth)
        for line in (*samples, truth):
            np.testing.assert_array_equal(line.get_xdata(), STEPS)
        assert {line.get_color() for line in samples} == {SAMPLE_COLOUR}
        assert (truth.get_color(), truth.get_label()) == (TRUTH_COLOUR, "truth")
    assert not grid[1, 1].lines and grid[1, 1].texts[0].get_text() == "no run"
    assert [axes.get_title() for axes in grid[0]] == ["L = 1", "L = 3"]
    assert [axes.get_ylabel().split("\n")[0] for axes in grid[:, 0]] == ["RBF", "Matérn-1/2"]
    (legend,) = drawn[0].legends
    assert [text.get_text() for text in legend.get_texts()] == ["5 sampled trajectories", "truth"]
    assert (
        "Case a: " in drawn[0].get_suptitle() and "action 0.75 from the mean start, seed 0" in drawn[0].get_suptitle()
    )


def test_the_axes_hold_the_truth_and_nine_tenths_of_the_samples(drawn, tmp_path):
    result = fan("rbf", 1)
    result.paths[0][0], result.truth[3] = 1e6, 20.0
    plot_fans({("rbf", 1): result}, tmp_path / "a.png")
    low, high = drawn[0].axes[0].get_ylim()
    assert 20.0 < high < 30.0
    assert low < np.quantile(result.paths, 0.05)


def test_each_curve_of_scores_stands_in_its_panel_with_its_band(drawn, tmp_path):
    rng = np.random.default_rng(0)
    settings = [("rbf", 1), ("matern12", 1), ("rbf", 2)]
    curves = {
        score: {setting: tuple(np.sort(rng.normal(size=(3, 15)), axis=0)[[1, 0, 2]]) for setting in settings}
        for score in ("nlpd", "inside_90")
    }
    plot_scores_by_step(curves, "angular velocity", "a title", tmp_path / "a.png")
    grid = np.array(drawn[0].axes).reshape(2, 2)
    for row, score in enumerate(curves):
        for kernel, layers in settings:
            axes, (mean, low, high) = grid[row, layers - 1], curves[score][kernel, layers]
            (line,) = [line for line in axes.lines if line.get_color() == KERNEL_COLOURS[kernel]]
            np.testing.assert_array_equal(line.get_xydata(), np.column_stack([STEPS, mean]))
            place = [line for line in axes.lines if line.get_linestyle() == "-"].index(line)
            (band,) = axes.collections[place].get_paths()
            for limits in (low, high):
                wanted = set(zip(STEPS.tolist(), limits.tolist(), strict=True))
                assert wanted <= set(map(tuple, band.vertices.tolist()))
    dotted = [[line.get_ydata() for line in axes.lines if line.get_linestyle() == ":"] for axes in grid.flat]
    assert dotted == [[], [], [[0.9, 0.9]], [[0.9, 0.9]]]  # the wanted share, of coverages alone
    assert [axes.get_ylabel() for axes in grid[:, 0]] == [
        "negative log\npredictive density", "inside the\n90% interval",
    ]  # fmt: skip
    assert drawn[0].get_suptitle() == "a title"


@pytest.mark.parametrize(("quantity", "unit"), [("position", "m"), ("angular velocity", "rad/s")])
def test_a_crps_has_the_unit_of_its_quantity(drawn, tmp_path, quantity, unit):
    plot_scores_by_step({"crps": {("rbf", 1): (np.zeros(15),) * 3}}, quantity, "a title", tmp_path / "a.png")
    assert drawn[0].axes[0].get_ylabel() == f"CRPS ({unit})"
