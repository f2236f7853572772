"""Benchmarks that may be interrupted: nothing is measured twice, and no settings are taken for others."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from benchmarks import ablation, noise
from benchmarks.rows import find, read_rows

COMMITTED = Path(__file__).parents[2] / "benchmarks" / "results"
RESULTS = {"return": 1.5, "coverage": float("nan"), "iterations": 4000.0}


@pytest.fixture(params=[ablation, noise], ids=["ablation", "noise"])
def benchmark(request, monkeypatch, tmp_path):
    """Runs a benchmark whose measurements take no time; gives what it measured."""
    name = request.param.__name__.rsplit(".", 1)[1]
    measured = []

    def measure(wanted):
        measured.append(wanted)
        return dict(RESULTS)

    def run(*arguments):
        measured.clear()
        monkeypatch.setattr(sys, "argv", ["x", *arguments, "--results", str(tmp_path)])
        request.param.main()
        return list(measured)

    monkeypatch.setattr(request.param, "measure", measure)
    monkeypatch.setattr(request.param.torch, "set_num_threads", lambda _: None)
    run.name, run.module, run.file = name, request.param, tmp_path / f"{name}.json"
    return run


def saved(benchmark):
    return json.loads(benchmark.file.read_text())["rows"]


OTHERS = {
    "ablation": [("--env", "environment", "ModCartPole-v0"), ("--steps", "steps", 50)],
    "noise": [("--steps", "steps", 50), ("--gain", "gain", 0.5)],
}

EVERY = {
    "ablation": [{"variant": variant} for variant in ablation.VARIANTS],
    "noise": [{"model": model, "noise": kind} for model in noise.MODELS for kind in noise.NOISES],
}
"""What is measured with each seed, in this order."""


def kinds(benchmark, rows):
    """The rows' entries of `EVERY`."""
    return [{key: row[key] for key in EVERY[benchmark.name][0]} for row in rows]


def test_what_is_there_is_not_measured_again(benchmark):
    first = benchmark("--seeds", "100")
    assert kinds(benchmark, first) == EVERY[benchmark.name]
    assert benchmark("--seeds", "100") == []
    assert {row["seed"] for row in benchmark("--seeds", "100", "101")} == {101}


def test_an_interrupted_benchmark_goes_on(benchmark, monkeypatch):
    whole, every = benchmark.module.measure, EVERY[benchmark.name]

    def interrupted(wanted):
        if kinds(benchmark, [wanted]) == every[2:3]:
            raise KeyboardInterrupt
        return whole(wanted)

    monkeypatch.setattr(benchmark.module, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        benchmark("--seeds", "100")
    monkeypatch.setattr(benchmark.module, "measure", whole)
    assert kinds(benchmark, benchmark("--seeds", "100")) == every[2:]


def test_other_settings_are_kept_apart(benchmark):
    num_rows = len(benchmark("--seeds", "100"))
    before = saved(benchmark)
    for option, column, value in OTHERS[benchmark.name]:
        rows = benchmark("--seeds", "100", option, str(value))
        assert len(rows) == num_rows
        assert {row[column] for row in rows} == {value}
        command = find(saved(benchmark), **{column: value})["command"]
        assert command.endswith(f"{option} {value} --results {benchmark.file.parent}")
        assert benchmark("--seeds", "100", option, str(value)) == []
    assert str(saved(benchmark)[:num_rows]) == str(before)  # in which NaN equals NaN


def test_the_table_has_all_rows_and_commands(benchmark, capsys):
    option, column, value = OTHERS[benchmark.name][0]
    benchmark("--seeds", "100"), benchmark("--seeds", "100", option, str(value))
    page = benchmark.file.with_suffix(".md").read_text()
    about, _, header, _, *rows = page.splitlines()
    assert about.count(f"benchmarks.{benchmark.name} --seeds 100") == 2
    assert len(rows) == 2 * len(EVERY[benchmark.name])
    names, cells = ([cell.strip() for cell in line.strip("|").split("|")] for line in (header, rows[-1]))
    last = dict(zip(names, cells, strict=True))
    assert (last[column], last["seed"]) == (str(value), "100")
    assert str({name: float(last[name]) for name in RESULTS}) == str(RESULTS)  # in which NaN equals NaN
    assert page in capsys.readouterr().out


def test_a_failing_disk_leaves_the_old_rows(benchmark, monkeypatch):
    benchmark("--seeds", "100")
    before = benchmark.file.read_bytes()

    def full(descriptor):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="disk full"):
        benchmark("--seeds", "101")
    assert benchmark.file.read_bytes() == before


def test_committed_rows_count_for_the_settings_that_they_were_made_with(benchmark):
    shutil.copy(COMMITTED / benchmark.name / benchmark.file.name, benchmark.file)
    committed = saved(benchmark)
    assert benchmark("--seeds", "100") == []
    option, column, value = OTHERS[benchmark.name][0]
    assert len(benchmark("--seeds", "100", option, str(value))) == len(EVERY[benchmark.name])
    rows = saved(benchmark)
    for old, row in zip(committed, rows, strict=False):
        assert row == row | old
    assert rows[0][column] == benchmark.module.SETTINGS.get_default(column)
    assert {row[column] for row in rows[len(committed) :]} == {value}


def test_old_rows_have_the_settings_of_their_files_command(tmp_path):
    file = tmp_path / "ablation.json"
    command = "python -m benchmarks.ablation --variants L = 1 --env ModCartPole-v0 --steps 50"
    old = {
        "command": command,
        "environment": "ModCartPole-v0",
        "torch": "2.3",
        "rows": [{"variant": "L = 1", "seed": 1}],
    }
    file.write_text(json.dumps(old))
    made_with = {"environment": "ModCartPole-v0", "steps": 50, "command": command, "torch": "2.3"}
    assert read_rows(file, ablation.SETTINGS) == [made_with | {"variant": "L = 1", "seed": 1}]
