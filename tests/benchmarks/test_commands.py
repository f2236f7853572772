"""`dgpmpc bench` does what is left of a suite, and says what is finished, what failed and what is wrong."""

import os
import re
import signal
from typing import get_type_hints

import pytest
from typer.testing import CliRunner

from benchmarks import commands, suites
from benchmarks.methods import METHODS, PlanningMethod
from benchmarks.suites import Cell, RunSuite
from benchmarks.tasks import TASKS
from gym_dgpmpc import cli
from tests.benchmarks.toy import TINY, TOY, Diary, Errand, toy
from tests.command_line import is_one_line_error

DGP = "DGP-MPC L=1 matern32"


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Calls `dgpmpc bench tiny` in an empty folder; the suite has two methods on one task."""
    monkeypatch.chdir(tmp_path)
    tiny = METHODS[DGP]
    tiny = PlanningMethod("tiny", tiny.make_agent, lambda task: TINY[DGP] | {"num_layers": 1})
    monkeypatch.setitem(METHODS, "tiny", tiny)
    monkeypatch.setitem(TASKS, TOY.name, TOY)
    cells = (Cell("tiny", TOY.name, 1), Cell("PPO", TOY.name, 1))
    monkeypatch.setitem(suites.SUITES, "tiny", RunSuite("tiny", "for the tests", cells, seeds=(0, 1)))
    runner = CliRunner()
    places = ["--results", "results", "--work", "work"]
    return lambda *arguments: runner.invoke(cli.app, ["bench", "tiny", *map(str, arguments), *places])


def test_a_suite_is_done_once(bench, tmp_path):
    first = bench()
    assert first.exit_code == 0, first.output
    assert first.stdout.startswith("4 jobs: 0 finished, 4 left; no estimate for 4 of them\n")
    assert len(re.findall(r"^\d of 4 \| Diary-v0 \| (tiny|PPO) \| seed [01]: mean return", first.stdout, re.M)) == 4
    assert len(list((tmp_path / "results").iterdir())) == 4
    again = bench()
    assert again.exit_code == 0
    assert again.stdout == "4 jobs: 4 finished, 0 left\n"


def test_the_list(bench, monkeypatch, tmp_path):
    assert bench("--seeds", 0, "--methods", "PPO").exit_code == 0
    monkeypatch.setitem(TASKS, TOY.name, toy(diary=str(tmp_path / "diary"), ends_at=30, end="interrupt"))
    assert bench("--seeds", 0, "--methods", "tiny", "--episodes", 2).exit_code == 130
    listed = bench("--list", "--episodes", 2, "--seeds", "0-1")
    assert listed.exit_code == 0
    assert listed.stdout.splitlines()[:4] == [
        "Diary-v0 | tiny | seed 0: 1 of 2 episodes",
        "Diary-v0 | PPO | seed 0: to do",
        "Diary-v0 | tiny | seed 1: to do",
        "Diary-v0 | PPO | seed 1: to do",
    ]
    expected = r"4 jobs: 0 finished, 4 left; about \d+ min of one process for 2 of them; no estimate for 2"
    assert re.match(expected, listed.stdout.splitlines()[4])
    assert "PPO | seed 0: finished" in bench("--list").stdout


def test_a_failure_is_told_of_and_the_others_go_on(bench, monkeypatch, tmp_path):
    step = Diary.step

    def failing(self, action):
        if self.penalise:
            raise ConnectionError("the plant is gone")
        return step(self, action)

    monkeypatch.setattr(Diary, "step", failing)
    result = bench("--seeds", "0")
    assert result.exit_code == 1
    assert "seed 0: ConnectionError: the plant is gone" in result.stdout
    assert "seed 0: mean return" in result.stdout
    log = tmp_path / "results" / "Diary-v0_PPO_seed0.log"
    assert f"\n1 failed:\n  Diary-v0 | PPO | seed 0: see {log}\n" in result.stderr
    assert "Traceback" in log.read_text()
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)


def test_an_interrupted_suite_goes_on(bench, monkeypatch):
    step, sent = Diary.step, []

    def terminated(self, action):
        if not self.penalise and self.time == 3 and not sent:
            sent.append(os.kill(os.getpid(), signal.SIGTERM))
        return step(self, action)

    monkeypatch.setattr(Diary, "step", terminated)
    before = signal.getsignal(signal.SIGTERM)
    result = bench("--seeds", 0)
    assert result.exit_code == 143, result.output
    assert "the same command continues" in result.stdout
    assert signal.getsignal(signal.SIGTERM) == before
    result = bench("--seeds", 0)
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("2 jobs: 0 finished, 2 left")


def test_the_help_names_the_suites_that_there_are():
    suite = get_type_hints(commands.bench, include_extras=True)["suite"]
    assert re.split(r", | or ", suite.__metadata__[0].help.rstrip(".")) == [*suites.SUITES]


def test_jobs_that_are_no_runs(bench, monkeypatch, tmp_path):
    class Errands:
        title, results = "errands", tmp_path

        def jobs(self, selection):
            return [Errand(f"errand {seed}", str(tmp_path / "diary")) for seed in selection.seeds or (0,)]

    monkeypatch.setitem(suites.SUITES, "tiny", Errands())
    listed = bench("--list")
    assert listed.stdout.startswith("errand 0: to do\n1 jobs: 0 finished, 1 left")
    done = bench("--seeds", "1,2", "--jobs", 1)
    assert done.exit_code == 0, done.output
    assert "2 of 2 | errand 2: done\n" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--methods", "SAC"], ["'SAC'", "PPO, tiny"]),
        (["--seeds", "a"], ["'a'"]),
        (["--seeds", "0,-1"], ["'0,-1'"]),
        (["--seeds", "5-3"], ["'5-3'"]),
        (["--seeds", "1-"], ["'1-'"]),
        (["--cluster", "mars"], ["'mars'"]),
    ],
)
def test_what_is_wrong_is_said_in_one_line(bench, arguments, texts):
    assert is_one_line_error(bench(*arguments), *texts)
