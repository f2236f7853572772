"""The report of the contact study on results that were made up, whose differences are known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.contact.report import (
    _study,
    estimate,
    paired_differences,
    report_contact_study,
    verdict,
)
from benchmarks.contact.result_files import PHASES, ContactKey
from benchmarks.contact.scores import SCORES
from benchmarks.report.statistics import Estimate
from tests.benchmarks.contact.made_up import OFFSETS, made_up

KERNELS = ("matern12", "rbf")
BETTER = {("rbf", 1): 0.0, ("rbf", 2): -1.0, ("matern12", 1): -3.0, ("matern12", 2): -3.5}
"""What a setting adds to a seed's score."""

SEEDS = range(4)
OTHERS = ("position", "angle", "velocity", "change of angular velocity")


def runs(case="a", missing=()):
    """Runs whose scores vary far more with the seed than with the setting."""
    return [
        made_up(ContactKey(case, kernel, layers, seed), 100.0 * seed + added, starts_after=0 if case == "b" else 1)
        for (kernel, layers), added in BETTER.items()
        for seed in SEEDS
        if (kernel, layers, seed) not in missing
    ]


def test_differences_are_taken_seed_by_seed():
    study = _study(runs(), "a")
    found = paired_differences(study, [(("rbf", 2), ("rbf", 1))], "crps")
    np.testing.assert_allclose(found, [-1.0] * 4)
    both = [(("rbf", 2), ("rbf", 1)), (("matern12", 2), ("matern12", 1))]
    np.testing.assert_allclose(paired_differences(study, both, "nlpd"), [-0.75] * 4)


def test_only_seeds_with_all_runs_are_compared():
    study = _study(runs(missing=[("matern12", 2, 1)]), "a")
    both = [(("rbf", 2), ("rbf", 1)), (("matern12", 2), ("matern12", 1))]
    assert len(paired_differences(study, both[:1], "crps")) == 4
    assert len(paired_differences(study, both, "crps")) == 3
    assert len(paired_differences(study, [(("matern32", 1), ("rbf", 1))], "crps")) == 0


def test_differences_can_be_of_the_steps_from_the_contact_on():
    one = made_up(ContactKey("a", "rbf", 2, 0), 1.0, after=5.0)
    study = _study([one, made_up(ContactKey("a", "rbf", 1, 0), 1.0)], "a")
    pair = [(("rbf", 2), ("rbf", 1))]
    assert paired_differences(study, pair, "crps", "after") == pytest.approx([4.0])
    assert paired_differences(study, pair, "crps", "before") == pytest.approx([0.0])


def test_seeds_without_a_contact_have_no_difference_from_it_on():
    study = _study(runs("b"), "b")
    assert len(paired_differences(study, [(("rbf", 2), ("rbf", 1))], "crps", "after")) == 0


def test_one_seed_has_no_interval_and_none_no_mean():
    assert estimate(np.array([2.0])) == Estimate(2.0)
    assert np.isnan(estimate(np.array([])).value)


@pytest.mark.parametrize(
    ("difference", "says"),
    [
        (Estimate(-1.0, -2.0, -0.5), "better"),
        (Estimate(1.0, 0.5, 2.0), "worse"),
        (Estimate(-1.0, -2.0, 0.5), "undecided"),
        (Estimate(-1.0), "too few seeds"),
    ],
)
def test_a_difference_says_something_if_its_interval_leaves_out_zero(difference, says):
    assert verdict(difference) == says


def test_a_report_holds_levels_and_differences(tmp_path):
    for run in [*runs(), *runs("b")]:
        run.write(tmp_path / "runs")
    files = report_contact_study(tmp_path / "runs", tmp_path / "out")
    assert [path.name for path in files] == [
        "out.md", "fans_a.png", "steps_a.png", "fans_b.png", "steps_b.png",
    ]  # fmt: skip
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in files[1:])
    text = files[0].read_text()
    for picture in files[1:]:
        assert f"](out/{picture.name})" in text
    assert "| L = 2 less L = 1 | RBF | 4 | −1.000 [−1.000, −1.000] | better |" in text
    assert "| L = 2 less L = 1 | all kernels | 4 | −0.750 [−0.750, −0.750] | better |" in text
    assert "| Matérn-1/2 less RBF | 2 | 4 | −2.500 [−2.500, −2.500] | better |" in text
    assert "| RBF | 1 | 4 | 150.000 [" in text
    assert (
        "| kernel | L | position: NLPD | CRPS (m) | inside 90% | angle: NLPD | CRPS (rad) | inside 90% "
        "| velocity: NLPD | CRPS (m/s) | inside 90% | change of angular velocity: NLPD | CRPS (rad/s) | inside 90% |"
    ) in text
    # 150 of the first setting, and the offsets of made-up runs.
    cells = [150 + OFFSETS[quantity, score] for quantity in OTHERS for score in ("nlpd", "crps", "inside_90")]
    assert f"| RBF | 1 | {' | '.join(f'{cell:.3f}' for cell in cells)} |" in text
    case_b = text[text.index("## Case b") :]
    assert "steps from the contact on" in text[: text.index("## Case b")] and "steps from the contact on" not in case_b
    assert "seeds 0, 1, 2, 3" in text and "num_inducing 15" in text


def test_curves_by_step_are_of_the_seeds_of_a_setting(drawn, tmp_path):
    """The mean over seeds at each step, and its interval, of steps that differ."""
    for run in runs():
        later = replace(run, scores=json.loads(json.dumps(run.scores)))
        for score in SCORES:
            by_phase = later.scores["angular velocity"]
            for phase in PHASES:
                values = by_phase[phase][score]
                by_phase[phase][score] = [None if v is None else v + 1000.0 * step for step, v in enumerate(values)]
        later.write(tmp_path / "runs")
    report_contact_study(tmp_path / "runs", tmp_path / "out")
    fans, steps = drawn
    assert "seed 0" in fans.get_suptitle()
    rbf = next(line for line in steps.axes[0].lines if line.get_label() == "RBF")
    np.testing.assert_allclose(rbf.get_ydata(), 150.0 + 1000.0 * np.arange(15))
    band = steps.axes[0].collections[0].get_paths()[0].vertices
    first_step = band[band[:, 0] == 1, 1]
    assert 0.0 <= first_step.min() < 100.0 and 200.0 < first_step.max() <= 300.0


def test_a_report_can_be_made_of_what_there_is(tmp_path):
    made_up(ContactKey("c", "matern32", 3, 5), 1.0).write(tmp_path)
    page, *figures = report_contact_study(tmp_path, tmp_path / "out", ["svg", "png"])
    text = page.read_text()
    assert "| Matérn-3/2 | 3 | 1 | 1.000 | 1.000 |" in text
    assert "(out/fans_c.svg)" in text
    assert [path.name for path in figures] == ["fans_c.svg", "fans_c.png", "steps_c.svg", "steps_c.png"]
    assert all(path.stat().st_size > 0 for path in figures)
