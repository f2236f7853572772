"""Result files: what is written is what is read, and what is none is refused by name."""

import json
import re
from dataclasses import replace

import pytest

from benchmarks.result_files import Episode, ResultError, RunKey, RunResult, read_results


def result(seed: int = 0, method: str = "DGP-MPC L=2 matern32", task: str = "Pendulum-v1") -> RunResult:
    return RunResult(
        key=RunKey(method, task, seed),
        episodes=(Episode("random", -1.5, 3, 3, 0.25), Episode("planned", 2.5, 3, 6, 1.0, success=True)),
        settings={"horizon": 30, "weight_decay": [0.1, 0.2]},
        milliseconds_per_action=3.5,
        started="2026-01-01T00:00:00+00:00",
        command="dgpmpc bench table",
        revision="unknown",
        versions={"python": "3.11"},
        machine={"cores": 2},
    )


def test_what_is_written_is_read_again(tmp_path):
    assert RunResult.read(result().write(tmp_path / "runs")) == result()


def test_what_is_not_finite_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        replace(result(), milliseconds_per_action=float("nan")).write(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_files_that_do_not_say_how_long_was_trained_are_read(tmp_path):
    path = result().write(tmp_path)
    content = json.loads(path.read_text())
    del content["num_steps"]
    path.write_text(json.dumps(content))
    assert RunResult.read(path) == result()


def test_random_episodes_do_not_count():
    assert [episode.episode_return for episode in result().counted] == [2.5]


def test_file_names_tell_the_run_and_differ():
    assert RunKey("PETS TSinf", "ModCartPole-v0", 1).file_name == "ModCartPole-v0_PETS-TSinf_seed1.json"
    assert RunKey("SAC", "a/b:c", 1).file_name == "a-b-c_SAC_seed1.json"


def test_all_results_of_a_folder_are_read_in_order(tmp_path):
    wanted = [result(0, "A", "x"), result(1, "A", "x"), result(0, "B", "x"), result(0, "A", "y")]
    for one in reversed(wanted):
        one.write(tmp_path)
    assert read_results(tmp_path) == wanted


def test_an_empty_folder_is_an_error(tmp_path):
    with pytest.raises(ResultError, match=re.escape(str(tmp_path))):
        read_results(tmp_path)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.pop("episodes"),
        lambda content: content.update(schema=2),
        lambda content: content.update(more=1),
        lambda content: content["episodes"].append({"steps": 3}),
        lambda content: content["key"].update(seed=5),
    ],
    ids=["missing", "other schema", "unknown", "half an episode", "another run's name"],
)
def test_what_is_no_result_is_refused_by_name(tmp_path, damage):
    path = result().write(tmp_path)
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError, match="Pendulum"):
        RunResult.read(path)


def test_half_a_file_is_refused_by_name(tmp_path):
    path = result().write(tmp_path)
    path.write_text(path.read_text()[:50])
    with pytest.raises(ResultError, match=re.escape(str(path))):
        RunResult.read(path)
