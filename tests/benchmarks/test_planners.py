"""`python -m benchmarks.planners`: what is measured, once, and which planners are the best for their time."""

import json
import sys

import pytest

from benchmarks import planners


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Runs the benchmark with measurements that take no time; gives what it measured."""
    measured = []

    def measure(wanted):
        measured.append(wanted)
        return {"return": float(wanted["seed"]), "plan_cpu_ms": float(wanted["num_candidates"])}

    def run(*arguments):
        measured.clear()
        monkeypatch.setattr(sys, "argv", ["x", *arguments, "--results", str(tmp_path)])
        planners.main()
        return list(measured)

    monkeypatch.setattr(planners, "measure", measure)
    monkeypatch.setattr(planners.torch, "set_num_threads", lambda _: None)
    run.folder = tmp_path
    return run


def test_what_is_there_is_not_measured_again(run):
    sizes = ("--budgets", "10x2", "20x3", "--planners", "CEM", "MPPI")
    first = run(*sizes, "--seeds", "100")
    assert len(first) == 2 * 2 * 2 and {row["seed"] for row in first} == {100}
    again = run(*sizes, "--seeds", "100", "101")
    assert len(again) == 8 and {row["seed"] for row in again} == {101}
    assert len(run(*sizes, "--seeds", "100", "--steps", "50")) == 8
    rows = json.loads((run.folder / "planners.json").read_text())["rows"]
    assert len(rows) == 24 and {(row["num_candidates"], row["num_iterations"]) for row in rows} == {(10, 2), (20, 3)}
    page = (run.folder / "planners.md").read_text()
    assert "| ModCartPole-v0 | true | 200 | MPPI | 20 | 3 | 2 | 100.5 | 0.7 | 20.0 |  |" in page
    assert "| ModCartPole-v0 | true | 50 | CEM | 10 | 2 | 1 | 100.0 | – | 10.0 | best |" in page
    assert len(run(*sizes, "--seeds", "100", "--dynamics", "learned")) == 8


def test_planners_by_gradients_are_left_to_learned_models(run, capsys):
    sizes = ("--budgets", "10x2", "--envs", "ModCartPole-v0", "--seeds", "100")
    by_values = {row["planner"] for row in run(*sizes)}
    more = {row["planner"] for row in run(*sizes, "--dynamics", "learned")} - by_values
    assert by_values and more == {"gradient", "gradient, Adam", "gradient from CEM"}
    with pytest.raises(SystemExit):
        run(*sizes, "--planners", "CEM", "gradient")
    assert "no gradients: ask for --dynamics learned, or without ['gradient']" in capsys.readouterr().err


def test_the_best_earn_more_than_all_that_are_quicker():
    about = {
        "environment": "E",
        "dynamics": "true",
        "steps": 1,
        "num_candidates": 1,
        "num_iterations": 1,
        "seed": 0,
        "command": "x",
    }
    found = {"slow": (5.0, 30.0), "quick": (1.0, 10.0), "poor": (0.5, 20.0), "equal": (5.0, 40.0)}
    rows = [{**about, "planner": name, "return": value, "plan_cpu_ms": cost} for name, (value, cost) in found.items()]
    rows.append({**rows[0], "environment": "F"})
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in planners.page(rows).splitlines()[4:]]
    assert [(line[3], line[-1]) for line in lines] == [
        ("quick", "best"), ("poor", ""), ("slow", "best"), ("equal", ""), ("slow", "best"),
    ]  # fmt: skip


@pytest.mark.parametrize("dynamics", ["true", "learned"])
def test_every_planner_is_measured(dynamics, monkeypatch):
    about = {"environment": "ModCartPole-v0", "dynamics": dynamics, "steps": 3, "seed": 100}
    small = {"num_inducing": 10, "first_training_iterations": 20, "num_samples": 10, "sample_spacing": 1}
    task = dict(planners.settings_for("ModCartPole-v0"))
    monkeypatch.setattr(planners, "settings_for", lambda env_id: {**task, **small})
    monkeypatch.setattr(planners, "NUM_RECORDED", 1)
    for planner in planners.OF_VALUES if dynamics == "true" else ("CEM", "iCEM, beta 1", "MPPI", "gradient from CEM"):
        row = planners.measure({**about, "planner": planner, "num_candidates": 6, "num_iterations": 1})
        assert -3 < row["return"] < 3 and row["plan_cpu_ms"] > 0
