"""How long what is left may take, in arithmetic that can be done by hand."""

import pytest

from benchmarks.jobs import Folders
from benchmarks.listing import hours, seconds_per_step, summary, survey
from benchmarks.run import Run
from tests.benchmarks.made_up import run
from tests.benchmarks.toy import TINY, TOY
from tests.runs.toy import EPISODE_STEPS

DGP = "DGP-MPC L=1 matern32"


@pytest.fixture
def folders(tmp_path):
    """With finished runs of one method, whose three seeds took 1, 2 and 6 s for each step of a planned episode."""
    for seed, pace in ((1, 1.0), (2, 6.0), (3, 2.0)):
        finished = run(DGP, [0.0] * 4, task=TOY.name, seed=seed, steps=10, random=0.0, seconds=10 * pace)
        finished.write(tmp_path / "results")
    (tmp_path / "results" / "Diary-v0_PPO_seed1.json").write_text("{")
    return Folders(tmp_path / "results", tmp_path / "work")


def test_the_pace_is_the_median_over_the_seeds(folders):
    assert seconds_per_step(folders.results) == {(DGP, TOY.name): 2.0}


def test_what_is_left_takes_as_long_as_its_steps_at_that_pace(folders, monkeypatch):
    job, unknown = Run(DGP, TOY, 0, 4, asked=TINY[DGP]), Run("PPO", TOY, 0, 4)
    lines = survey([job, unknown], folders)
    assert [line.seconds_left for line in lines] == [2.0 * 5 * EPISODE_STEPS, None]
    expected = "2 jobs: 0 finished, 2 left; about 2 min of one process for 1 of them; no estimate for 1 of them"
    assert summary(lines).startswith(expected)
    monkeypatch.setattr(Run, "episodes_so_far", lambda *_: 3)
    (line,) = survey([job], folders)
    assert (line.state, line.seconds_left) == ("3 of 4 episodes", 2.0 * 2 * EPISODE_STEPS)


def test_a_damaged_result_is_told_of_where_it_stands(folders):
    (line,) = survey([Run("PPO", TOY, 1, 4)], folders)
    assert line.state.startswith("cannot be done: ") and "not a result of a run" in line.state
    assert (line.is_finished, line.seconds_left) == (False, None)


def test_durations():
    assert [hours(seconds) for seconds in (30 * 60, 3599, 5400)] == ["30 min", "60 min", "1.5 h"]
