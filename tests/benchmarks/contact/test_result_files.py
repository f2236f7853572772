"""Result files of the contact study, and means over their steps and starts."""

import json
import re

import numpy as np
import pytest

from benchmarks.contact.result_files import (
    QUANTITIES,
    ContactKey,
    ContactResult,
    ResultError,
    phase_means,
    read_contact_results,
)
from tests.benchmarks.contact.made_up import TINY, made_up

KEY = ContactKey("a", "matern32", 2, 7)


def test_what_is_written_is_read_again(tmp_path):
    path = made_up(KEY, 0.25).write(tmp_path / "runs")
    assert path.name == "contact_a_matern32_L2_seed7.json"
    assert ContactResult.read(path) == made_up(KEY, 0.25)


def test_numbers_are_kept_to_six_figures(tmp_path):
    found = ContactResult.read(made_up(KEY, 1234.56789e-9).write(tmp_path))
    assert found.mean("angular velocity", "crps") == pytest.approx(1234.57e-9, rel=1e-12)


def test_what_is_not_finite_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        made_up(KEY, float("nan")).write(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_means_are_over_the_starts_of_a_phase():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(4, 6, len(QUANTITIES)))  # "H K Q"
    in_contact = np.array([[False] * 6, [True] + [False] * 5, [True] * 4 + [False] * 2, [True] * 6])
    scores, counts = phase_means({"crps": values}, in_contact)
    assert counts == {"before": [6, 5, 2, 0], "after": [0, 1, 4, 6]}
    angle = scores["angle"]
    assert angle["before"]["crps"][3] is None and angle["after"]["crps"][0] is None
    assert angle["before"]["crps"][2] == pytest.approx(values[2, 4:, 1].mean())
    assert angle["after"]["crps"][2] == pytest.approx(values[2, :4, 1].mean())


def test_means_over_steps_count_every_start_alike():
    rng = np.random.default_rng(1)
    values, in_contact = rng.normal(size=(15, 3, len(QUANTITIES))), np.zeros((15, 3), dtype=bool)
    in_contact[9:, 0], in_contact[12:, 1] = True, True
    scores, counts = phase_means({"nlpd": values}, in_contact)
    result = ContactResult(**{**vars(made_up(KEY, 0.0)), "scores": scores, "counts": counts})
    velocity = values[..., 2]
    assert result.mean("velocity", "nlpd") == pytest.approx(velocity.mean())
    assert result.mean("velocity", "nlpd", "after") == pytest.approx(velocity[in_contact].mean())
    assert result.mean("velocity", "nlpd", "before") == pytest.approx(velocity[~in_contact].mean())
    np.testing.assert_allclose(result.by_step("velocity", "nlpd"), velocity.mean(axis=1))
    after = result.by_step("velocity", "nlpd", "after")
    assert np.isnan(after[:9]).all()
    np.testing.assert_allclose(after[9:12], velocity[9:12, 0])


def test_a_phase_without_steps_has_no_mean():
    assert np.isnan(made_up(KEY, 1.0, starts_after=0).mean("angle", "crps", "after"))


def test_all_results_of_a_folder_are_read(tmp_path):
    keys = [ContactKey(case, "rbf", 1, seed) for case in "ba" for seed in (1, 0)]
    for key in keys:
        made_up(key, 1.0).write(tmp_path)
    (tmp_path / "other_seed0.json").write_text("{}")
    assert [result.key for result in read_contact_results(tmp_path)] == sorted(keys)


def test_an_empty_folder_is_an_error(tmp_path):
    with pytest.raises(ResultError, match=re.escape(str(tmp_path))):
        read_contact_results(tmp_path)


def test_results_of_two_studies_are_not_mixed(tmp_path):
    made_up(KEY, 1.0).write(tmp_path)
    other = made_up(ContactKey("b", "rbf", 1, 0), 1.0)
    ContactResult(**{**vars(other), "settings": type(TINY)(num_starts=9, num_particles=19)}).write(tmp_path)
    with pytest.raises(ResultError, match=r"contact_b_rbf_L1_seed0\.json.*num_starts 9"):
        read_contact_results(tmp_path)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.pop("scores"),
        lambda content: content.update(schema=2),
        lambda content: content.update(more=1),
        lambda content: content["settings"].pop("num_starts") and content["settings"].update(starts=1),
        lambda content: content["key"].update(seed=5),
    ],
    ids=["missing", "other schema", "unknown", "unknown setting", "another run's name"],
)
def test_what_is_no_result_is_refused_by_name(tmp_path, damage):
    path = made_up(KEY, 1.0).write(tmp_path)
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError, match="contact_a_matern32_L2_seed7"):
        ContactResult.read(path)


def test_half_a_file_is_refused_by_name(tmp_path):
    path = made_up(KEY, 1.0).write(tmp_path)
    path.write_text(path.read_text()[:50])
    with pytest.raises(ResultError, match=re.escape(str(path))):
        ContactResult.read(path)
