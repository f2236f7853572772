"""`python -m benchmarks.speed`: the cases are the environments', and a run's rows reach its files."""

import json
import subprocess
import sys
from types import SimpleNamespace

import gymnasium
import pytest
import torch

from benchmarks.speed import __main__ as speed
from benchmarks.speed.cases import CASES, transitions
from benchmarks.speed.report import document
from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.runs.provenance import processor

TASKS = {
    "cart-pole": ("ModCartPole-v0", 30, 5),
    "reacher": ("BiasedReacher-v0", 20, 5),
    "half-cheetah": ("RiskSensitiveHalfCheetah-v0", 40, 10),
}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_case_has_the_sizes_of_its_environment(case):
    env_id, *planning = TASKS[case.name]
    env = gymnasium.make(env_id)
    assert case.spec == env.get_wrapper_attr("observation_spec")
    assert (case.observation_size,) == env.observation_space.shape
    assert (case.action_size,) == env.action_space.shape
    assert [case.horizon, case.num_iterations] == planning


def test_sizes_of_the_models():
    """12 plain numbers of the reacher, two free rolls as sine and cosine, and 7 torques; its target is not fed."""
    encoders = [Encoder(case.observation_size, case.action_size, case.spec) for case in CASES]
    assert [(encoder.input_size, encoder.target_size) for encoder in encoders] == [(6, 4), (23, 14), (24, 18)]


def test_data_keep_what_is_constant():
    case = next(case for case in CASES if case.name == "reacher")
    data = transitions(case, 20)
    same = (data.observation == data.next_observation).all(0)
    assert torch.nonzero(same).flatten().tolist() == [7, 8, 9]


def row(worker, what, milliseconds, **others):
    about = {"case": "cart-pole", "threads": 1, "worker": worker, "L": 3, "what": what}
    return about | {"p50_ms": milliseconds, "p95_ms": 2 * milliseconds, "repeats": 20} | others


def test_rows_of_the_workers_reach_the_files(monkeypatch, tmp_path):
    started = []

    def worker(command, **_):
        started.append(command[command.index("--worker") :])
        return SimpleNamespace(stdout="a warning\n" + json.dumps(row("plans", "plan", 12.0, how="joint")) + "\n")

    monkeypatch.setattr(subprocess, "run", worker)
    # Both ask other programs, by `run` too.
    monkeypatch.setattr(speed.compiled_rollout, "is_available", lambda: True)
    monkeypatch.setattr(speed, "revision", lambda: "abc")
    narrowed = ["--cases", "cart-pole", "--layers", "3", "--threads", "1", "--repeats", "7"]
    options = ["--parts", "plans", *narrowed, "--results", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["x", *options])
    speed.main()
    assert started == [["--worker", "plans", *narrowed]]
    facts = json.loads((tmp_path / "speed.json").read_text())
    assert facts["rows"] == [row("plans", "plan", 12.0, how="joint")]
    assert (facts["processor"], facts["revision"]) == (processor(), "abc")
    assert facts["command"] == f"python -m benchmarks.speed {' '.join(options)}"
    assert (tmp_path / "speed.md").read_text() == document(facts, facts["rows"])


def test_the_page_compares_medians():
    rows = [
        row("plans", "plan", 12.0, how="joint"),
        row("plans", "plan", 4.0, how="pathwise, step"),
        row("pets", "plan", 40.0, how="PETS, float32"),
    ]
    facts = {
        "command": "x", "processor": "A Fast One", "cores": 2, "load_average_1_min_before": 0.04,
        "load_average_1_min_after": 1.26, "revision": "abc", "versions": {"torch": "2.13.0"},
    }  # fmt: skip
    page = document(facts, rows).splitlines()
    assert "A Fast One, 2 cores, load 0.0 before and 1.3 after; PyTorch 2.13.0, revision abc." in page[0]
    assert "| cart-pole | 3 | step | 1 | 3.0 | 10.0 | – | – | – | – |" in page
    assert "| cart-pole | 1 | plan | 3 | joint | 12 | 24 |" in page
    assert "## Plans by PETS" in page and "## Training" not in page
