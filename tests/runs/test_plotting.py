"""Figures of runs that have ended, from their folders: what is drawn, and which runs are one method."""

import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from gym_dgpmpc.formats import FORMATS
from gym_dgpmpc.runs.figures import Forecast
from gym_dgpmpc.runs.folder import EpisodeRow, RunFolder, RunFolderError
from gym_dgpmpc.runs.forecasts import KeptForecasts
from gym_dgpmpc.runs.plotting import (
    RecordedRun,
    by_method,
    draw_run,
    draw_runs,
    earned_by_then,
    model_of,
    plot_learning_curves,
    title_of,
)

SETTINGS = {"environment": "ToyPush-v0", "agent": "dgp-mpc", "num_layers": 2, "kernel": "rbf"}


def rows(*returns, steps=10):
    """The first at random, the others planned, each of so many steps."""
    return [
        EpisodeRow(i, "random" if i == 1 else "planned", value, steps, steps * i, 1.0)
        for i, value in enumerate(returns, start=1)
    ]


def recorded(seed, *returns, steps=10, **settings):
    return RecordedRun(f"seed{seed}", {**SETTINGS, "seed": seed, **settings}, rows(*returns, steps=steps))


@pytest.fixture
def folder(tmp_path):
    """What a run leaves in its folder, but for the agent and the figures."""
    path = tmp_path / "run"
    held = RunFolder(path, {**SETTINGS, "seed": 3})
    held.write_settings()
    held.write_rows(rows(-5.0, 1.0, 2.5))
    held.close()
    return path


def forecasts(seed=0):
    random = np.random.default_rng(seed)
    kept = [Forecast(start, random.normal(size=(5, 20, 2)), random.normal(size=(5, 2))) for start in (1, 4)]
    return KeptForecasts(kept, ["place (m)", "Geschwindigkeit ẋ (m/s)"], episode=3, step_seconds=0.04)


def test_a_run_is_read_as_it_was_written(folder):
    run = RecordedRun.read(folder)
    assert run == RecordedRun(folder, {**SETTINGS, "seed": 3}, rows(-5.0, 1.0, 2.5))
    assert title_of(run.settings) == "ToyPush-v0, L = 2, rbf, seed 3"


@pytest.mark.parametrize(
    ("settings", "model"),
    [
        (SETTINGS, "L = 2, rbf"),
        ({**SETTINGS, "method": "PETS TS1"}, "PETS TS1"),
        ({"members": ["deep-gp", "ensemble"]}, "deep-gp and ensemble"),
        ({"agent": "another"}, "another"),
    ],
)
def test_what_a_method_is_called(settings, model):
    assert model_of(settings) == model


def test_what_is_no_run_is_refused(folder, tmp_path):
    with pytest.raises(RunFolderError, match=r"nothing/settings\.json"):
        RecordedRun.read(tmp_path / "nothing")
    (folder / "episodes.csv").write_text("episode,actions\n1,random\n")
    with pytest.raises(RunFolderError, match=r"episodes\.csv cannot be read"):
        RecordedRun.read(folder)
    (folder / "episodes.csv").unlink()
    with pytest.raises(RunFolderError, match="no episode"):
        RecordedRun.read(folder)
    for text in ("{", "[]", '{"settings": 1}'):
        (folder / "settings.json").write_text(text)
        with pytest.raises(RunFolderError, match=r"settings\.json"):
            RecordedRun.read(folder)


def test_forecasts_are_kept_exactly(tmp_path):
    written, path = forecasts(), tmp_path / "a.npz"
    written.write(path)
    read = KeptForecasts.read(path)
    assert read[1:] == written[1:]
    assert len(read.forecasts) == 2
    for one, other in zip(read.forecasts, written.forecasts, strict=True):
        assert one.start_step == other.start_step
        np.testing.assert_array_equal(one.predicted, other.predicted)
        np.testing.assert_array_equal(one.observed, other.observed)
    written._replace(step_seconds=None).write(path)
    assert KeptForecasts.read(path).step_seconds is None


def test_forecasts_run_no_code_and_damage_is_named(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, start_steps=np.array([None]), labels=np.array(["a"]))  # an object, which is pickled
    with pytest.raises(ValueError, match=r"a\.npz does not hold the forecasts"):
        KeptForecasts.read(path)
    path.write_bytes(b"half a file")
    with pytest.raises(ValueError, match=r"a\.npz does not hold the forecasts"):
        KeptForecasts.read(path)


def test_a_run_is_drawn_in_every_format(folder, tmp_path, drawn):
    forecasts().write(folder / "prediction_fan.npz")
    written = draw_run(folder, "a title", FORMATS, tmp_path / "out")
    names = [f"{name}.{kind}" for name in ("learning_curve", "prediction_fan") for kind in FORMATS]
    assert written == [tmp_path / "out" / name for name in names]
    for path in written:
        if path.suffix == ".svg":
            assert ElementTree.parse(path).getroot().tag.endswith("svg")
        else:
            assert path.read_bytes().startswith({".png": b"\x89PNG", ".pdf": b"%PDF"}[path.suffix])
    curve, fan = dict.fromkeys(drawn)  # each figure is saved once for each format
    np.testing.assert_array_equal(curve.axes[0].lines[0].get_ydata(), [-5.0, 1.0, 2.5])
    assert fan.get_suptitle() == "Predicted before it happened: episode 3, a title"
    assert fan.axes[0].get_ylabel() == "place (m)"


def test_a_file_is_the_same_whatever_was_drawn_before_it(folder, tmp_path):
    forecasts().write(folder / "prediction_fan.npz")
    together = draw_run(folder, "a title", FORMATS, tmp_path / "together")
    alone = [each for kind in reversed(FORMATS) for each in draw_run(folder, "a title", [kind], tmp_path / "alone")]
    assert len(together) == len(alone) == 6
    assert {path.name: path.read_bytes() for path in together} == {path.name: path.read_bytes() for path in alone}


def test_what_a_run_has_not_is_not_drawn(folder):
    assert draw_run(folder, "a title") == [folder / "learning_curve.png"]
    (folder / "episodes.csv").unlink()
    assert draw_run(folder, "a title") == []


def test_seeds_are_one_method_and_what_differs_names_the_others():
    two, three = [recorded(seed, 0.0, 1.0) for seed in (0, 1)], [recorded(0, 0.0, 1.0, num_layers=3)]
    assert by_method([*two, *three]) == {"L = 2, rbf": two, "L = 3, rbf": three}
    cem = [recorded(2, 0.0, 1.0, planner="cem")]
    mppi = [recorded(2, 0.0, 1.0, planner="mppi")]
    assert by_method([*cem, *mppi]) == {"planner = cem": cem, "planner = mppi": mppi}
    assert by_method([*two]) == {"L = 2, rbf": two}


def test_many_differences_and_the_same_seed_twice_are_told_apart_by_folders():
    others = {"a": 1, "b": 2, "c": 3, "d": 4}
    groups = by_method([recorded(0, 1.0), recorded(1, 1.0), recorded(5, 1.0, **others)])
    assert list(groups) == ["seed0 and 1 more", "seed5"]
    once, again = recorded(0, 1.0), recorded(0, 2.0)._replace(path="again")
    assert by_method([once, again]) == {"seed0": [once], "again": [again]}


def test_the_mean_is_of_the_same_runs_everywhere():
    one = np.array([10.0, 20.0, 30.0]), np.array([1.0, 2.0, 3.0])
    other = np.array([15.0, 25.0]), np.array([5.0, 7.0])
    at, values = earned_by_then([one, other])
    np.testing.assert_array_equal(at, [15, 20, 25])
    np.testing.assert_array_equal(values, [[1, 2, 2], [5, 5, 7]])
    at, _ = earned_by_then([one, (np.array([40.0]), np.array([1.0]))])
    assert at.size == 0


def test_the_chart_shows_every_run_its_mean_and_its_spread(drawn, tmp_path):
    methods = {"ours": [recorded(0, 0.0, 4.0), recorded(1, 2.0, 8.0)], "single": [recorded(0, 1.0, 3.0)]}
    plot_learning_curves(methods, tmp_path / "a.png", title="a title")
    (axes,) = drawn[0].axes
    curves = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert curves["ours: mean ± standard deviation of 2 seeds"] == [[10, 1], [20, 6]]
    assert curves["single"] == [[10, 1], [20, 3]]
    thin = [line.get_ydata().tolist() for line in axes.lines if line.get_label().startswith("_")]
    assert thin == [[0, 4], [2, 8]]
    band, at_random = axes.collections
    heights = {round(float(y), 12) for x, y in band.get_paths()[0].vertices if x == 20}
    spread = np.sqrt(8.0)  # of 4 and 8
    assert heights == {round(6 - spread, 12), round(6 + spread, 12)}
    np.testing.assert_array_equal(at_random.get_offsets(), [[10, 0], [10, 2], [10, 1]])


def test_runs_that_do_not_overlap_are_named_all_the_same(drawn, tmp_path):
    methods = {"ours": [recorded(0, 1.0, 2.0), recorded(1, 3.0, steps=50)]}
    plot_learning_curves(methods, tmp_path / "a.png", title="a title")
    assert "ours: 2 seeds that do not overlap" in [line.get_label() for line in drawn[0].axes[0].lines]


def test_one_chart_is_of_one_task(drawn, tmp_path):
    runs = [recorded(seed, 0.0, 1.0) for seed in (0, 1)]
    assert draw_runs(runs, tmp_path / "all", ["svg"]) == [tmp_path / "all.svg"]
    assert drawn[0].axes[0].get_title() == "ToyPush-v0, L = 2, rbf"
    draw_runs([*runs, recorded(0, 0.0, num_layers=1)], tmp_path / "all")
    assert drawn[1].axes[0].get_title() == "ToyPush-v0"
    with pytest.raises(ValueError, match="Another-v0 and ToyPush-v0"):
        draw_runs([*runs, recorded(0, 0.0, environment="Another-v0")], tmp_path / "all")


def test_settings_are_compared_as_json_has_them():
    """A tuple that a program gave and the list that a file holds are the same setting."""
    one, other = recorded(0, 1.0, members=("a", "b")), recorded(1, 1.0, members=json.loads('["a", "b"]'))
    assert list(by_method([one, other])) == ["a and b"]
