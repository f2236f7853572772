"""The figures show the numbers that they are given, and say what they leave out."""

import numpy as np
import pytest
from PIL import Image

from benchmarks.report import charts
from benchmarks.report.scores import PEERS
from benchmarks.report.styles import COLOURS, styles
from tests.benchmarks.made_up import grouped, run

OWN = "DGP-MPC L=2 matern32"


@pytest.fixture
def study():
    return grouped(
        run(OWN, [1.0, 3.0], random=0.0), run(OWN, [3.0, 5.0], seed=1, random=0.0), run("SAC", [0.0] * 30),
        run("true dynamics", [9.0, 7.0]), run(OWN, [4.0, 4.0], task="b"), run("SAC", [2.0, 3.0], task="b"),
    )  # fmt: skip


def lines_of(axes):
    return {line.get_label(): line for line in axes.lines}


def legend_of(figure):
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def test_one_panel_per_task(drawn, study, tmp_path):
    methods = {task: [OWN, "SAC"] for task in study}
    charts.plot_tasks(methods, study, dict.fromkeys(study, OWN), tmp_path / "a.png", "return")
    first, second = drawn[0].axes
    assert [axes.get_title() for axes in (first, second)] == ["Pendulum-v1", "b"]
    np.testing.assert_array_equal(lines_of(first)[OWN].get_xydata(), [[200, 2], [300, 4]])
    np.testing.assert_array_equal(lines_of(second)[OWN].get_xydata(), [[100, 4], [200, 4]])
    np.testing.assert_array_equal(lines_of(first)[charts.CEILING_LABEL].get_ydata(), [8, 8])
    assert charts.CEILING_LABEL not in lines_of(second)  # it was not run there
    # Ten times the steps on the same axis: a logarithmic one.
    assert (first.get_xscale(), second.get_xscale()) == ("log", "linear")
    assert [axes.get_xlabel() for axes in (first, second)] == [charts.AXIS["steps"]] * 2
    assert first.get_ylabel() == charts.EARNED["return"]
    assert legend_of(drawn[0]) == [f"{OWN} (1 to 2 seeds)", "SAC (1 seed)", f"{charts.CEILING_LABEL} (1 seed)"]
    assert Image.open(tmp_path / "a.png").size[0] > 800


def test_maximum_seen(drawn, tmp_path):
    study = grouped(run(OWN, [1.0, -3.0, 2.0]), run("SAC", [0.0, -1.0, -2.0]))
    charts.plot_tasks({"Pendulum-v1": [OWN, "SAC"]}, study, {}, tmp_path / "a.png", "best")
    (axes,) = drawn[0].axes
    np.testing.assert_array_equal(lines_of(axes)[OWN].get_ydata(), [1, 1, 2])
    np.testing.assert_array_equal(lines_of(axes)["SAC"].get_ydata(), [0, 0, 0])


def test_what_lies_far_below_is_cut_off_and_said(drawn, tmp_path):
    study = grouped(run(OWN, [-30.0, -32.0]), run("PETS TS1", [-50.0, -40.0]), run("SAC", [-1400.0, -900.0]))
    charts.plot_tasks({"Pendulum-v1": [OWN, "PETS TS1", "SAC"]}, study, {}, tmp_path / "a.png", "return")
    (axes,) = drawn[0].axes
    # The usual lowest is -50; the axis goes half of its distance from the top further down.
    assert axes.get_ylim()[0] == pytest.approx(-60.0)
    assert axes.get_ylim()[1] > -30.0
    assert "−1,400" in axes.get_xlabel()
    np.testing.assert_array_equal(lines_of(axes)["SAC"].get_ydata(), [-1400, -900])  # cut by the axis, not changed


def test_a_band_is_the_interval_of_the_mean(drawn, study, tmp_path):
    charts.plot_tasks({"Pendulum-v1": [OWN, "SAC"]}, study, {}, tmp_path / "a.png", "return")
    (band,) = drawn[0].axes[0].collections  # one seed has none
    # Of two runs: from the one to the other, at each of the two steps.
    assert {(200, 1), (200, 3), (300, 3), (300, 5)} == {(x, y) for x, y in band.get_paths()[0].vertices.tolist()}


def test_what_lies_far_below_leaves_room_for_the_ceiling(drawn, tmp_path):
    study = grouped(
        run(OWN, [-30.0, -32.0]), run("PETS TS1", [-50.0, -40.0]), run("SAC", [-1400.0, -900.0]),
        run("true dynamics", [-10.0]),
    )  # fmt: skip
    charts.plot_tasks({"Pendulum-v1": [OWN, "PETS TS1", "SAC"]}, study, {}, tmp_path / "a.png", "return")
    low, high = drawn[0].axes[0].get_ylim()
    assert low == pytest.approx(-50.0 - 0.5 * 40.0)  # the ceiling is the top that distances are taken from
    assert high == pytest.approx(-10.0 + 0.06 * 60.0)


def test_steps_and_wall_clock(drawn, study, tmp_path):
    charts.plot_clocks([OWN, "SAC"], "Pendulum-v1", study["Pendulum-v1"], OWN, tmp_path / "a.png")
    steps, minutes = drawn[0].axes
    np.testing.assert_array_equal(lines_of(steps)[OWN].get_xdata(), [200, 300])
    np.testing.assert_array_equal(lines_of(minutes)[OWN].get_xdata(), [2, 3])
    assert minutes.get_xlabel() == charts.AXIS["minutes"]
    assert charts.CEILING_LABEL in lines_of(minutes)


@pytest.mark.parametrize(("seconds", "between"), [(600.0, True), (60_000.0, False)])
def test_numbers_of_a_wide_axis_do_not_overlap(drawn, tmp_path, seconds, between):
    study = grouped(run(OWN, [1.0, 2.0], seconds=seconds), run("SAC", [0.0, 0.0], seconds=6.0))
    charts.plot_clocks([OWN, "SAC"], "Pendulum-v1", study["Pendulum-v1"], OWN, tmp_path / "a.png")
    decades = np.log10(drawn[0].axes[1].xaxis.get_majorticklocs())
    assert np.allclose(decades, decades.round()) != between


def test_one_panel_per_kernel(drawn, tmp_path):
    study = grouped(
        run("DGP-MPC L=1 rbf", [1.0, 2.0]), run("DGP-MPC L=1 rbf", [3.0, 4.0], seed=1),
        run("DGP-MPC L=3 rbf", [5.0, 6.0]), run("DGP-MPC L=1 matern12", [7.0, 8.0]),
        run("SAC", [0.0, 0.0]), run("true dynamics", [9.0]),
    )  # fmt: skip
    charts.plot_settings("Pendulum-v1", study["Pendulum-v1"], tmp_path / "a.png")
    rbf, matern = drawn[0].axes
    assert [axes.get_title() for axes in (rbf, matern)] == ["squared exponential (1 to 2 seeds)", "Matérn-1/2 (1 seed)"]
    np.testing.assert_array_equal(lines_of(rbf)["L = 1"].get_ydata(), [2, 3])
    thin = [line.get_ydata().tolist() for line in rbf.lines if line.get_label().startswith("_")]
    assert thin == [[1, 2], [3, 4], [5, 6]]
    np.testing.assert_array_equal(lines_of(matern)["L = 1"].get_ydata(), [7, 8])
    assert legend_of(drawn[0]) == ["L = 1", "L = 3", charts.CEILING_LABEL]
    assert rbf.get_ylim() == matern.get_ylim()


def test_variability(drawn, tmp_path):
    returns = [[0.0] * 10 + [99.0], [4.0] * 10]  # only the first ten count
    study = grouped(
        *(run(OWN, values, seed=seed) for seed, values in enumerate(returns)), run("PETS TS1", [-10.0] * 10),
        run("SAC", [-1000.0] * 10), run("true dynamics", [9.0]),
    )  # fmt: skip
    charts.plot_variability({"Pendulum-v1": [OWN, "PETS TS1", "SAC"]}, study, {}, tmp_path / "a.png")
    (axes,) = drawn[0].axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["SAC", "PETS TS1", OWN]
    (own, _) = axes.containers
    np.testing.assert_allclose(own[0].get_xydata(), [[2, 2]])  # the mean, in the row of the third label
    np.testing.assert_allclose(own[2][0].get_segments()[0][:, 0], [2 - np.sqrt(8), 2 + np.sqrt(8)])
    np.testing.assert_array_equal(axes.collections[0].get_offsets()[:, 0], [0, 4])
    assert [text.get_text() for text in axes.texts] == ["◂ −1,000"]
    assert axes.get_xlim()[0] > -100


def test_four_panels_are_two_rows_of_two(drawn, tmp_path):
    study = grouped(*(run(method, [1.0, 2.0], task=task) for task in "abcd" for method in (OWN, "SAC")))
    methods = {task: [OWN, "SAC"] for task in study}
    charts.plot_tasks(methods, study, dict.fromkeys(study, OWN), tmp_path / "a.png", "return")
    width, height = drawn[0].get_size_inches()
    assert len(drawn[0].axes) == 4
    assert width < 8 < height + 3


def test_the_same_numbers_give_the_same_file(study, tmp_path):
    for name in ("a.png", "b.png"):
        charts.plot_clocks([OWN, "SAC"], "Pendulum-v1", study["Pendulum-v1"], OWN, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_method_looks_the_same_whatever_else_is_drawn():
    alone = styles(["SAC"])["SAC"]
    among = styles([OWN, *PEERS, "new", "newer"], [OWN])
    assert among["SAC"] == alone
    assert among[OWN].colour == COLOURS[0]
    assert among[OWN].width > among["SAC"].width
    assert len({(look.colour, look.marker) for look in among.values()}) == len(among)
    many = styles([f"method {i}" for i in range(20)])
    assert len({(look.colour, look.marker) for look in many.values()}) == 20
