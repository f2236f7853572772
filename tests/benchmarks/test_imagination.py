"""`python -m benchmarks.imagination`: the rows that it measures, with real agents at a tiny size, and its page."""

import sys

import pytest

from benchmarks import imagination
from benchmarks.tasks import Task
from tests.agents.test_dgp_mpc import TINY

TASK = "Pendulum-v1"


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Runs the benchmark on short pendulum episodes."""
    short = Task(TASK, 15, arguments={"max_episode_steps": 15})
    tiny = {name: value for name, value in TINY.items() if name != "seed"}
    monkeypatch.setitem(imagination.TASKS, TASK, short)
    monkeypatch.setattr(imagination, "settings_for", lambda _: tiny)
    monkeypatch.setattr(imagination, "PLAYED", 1)
    monkeypatch.setattr(imagination, "TIMED", 3)
    monkeypatch.setattr(imagination.torch, "set_num_threads", lambda _: None)

    def run(*arguments):
        given = ["x", "--tasks", TASK, "--episodes", "1", "--total-timesteps", "40", "--seeds", "0"]
        monkeypatch.setattr(sys, "argv", [*given, *arguments, "--results", str(tmp_path)])
        imagination.main()
        return (tmp_path / "imagination.md").read_text().splitlines()

    return run


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_planner_and_policy_play_the_same_episodes(run):
    (row,) = [cells(line) for line in run() if line.startswith(f"| {TASK}")]
    task, episodes, algorithm, seeds, planner, policy, lowest, share, fresh, steps, *costs = row
    assert (task, episodes, algorithm, seeds, share, steps) == (TASK, "1", "SAC", "0", "–", "40")
    for earned in (planner, policy, fresh):
        assert -16.3 * 15 <= float(earned.replace("−", "-")) <= 0  # what the pendulum can cost in 15 steps
    assert policy == lowest and all(float(cost) >= 0 for cost in costs)


def test_an_agent_that_acts_by_its_policy(run):
    lines = run("--dyna")
    (row,) = [cells(line) for line in lines if line.startswith(f"| {TASK}")]
    assert "## DynaAgent" in lines and row[:3] == [TASK, "SAC", "0"]
    assert -16.3 * 15 <= float(row[3].replace("−", "-")) <= 0
    assert run("--dyna") == lines  # nothing is measured twice
