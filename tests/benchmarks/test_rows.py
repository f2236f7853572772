"""Benchmarks that may be interrupted: nothing is measured twice, and no settings are taken for others."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from benchmarks import noise
from benchmarks.rows import find, measure_missing, read_rows

COMMITTED = Path(__file__).parents[2] / "benchmarks" / "results"
RESULTS = {"return": 1.5, "coverage": float("nan"), "iterations": 4000.0}


@pytest.fixture
def benchmark(monkeypatch, tmp_path):
    """Runs a benchmark whose measurements take no time; gives what it measured."""
    measured = []

    def measure(wanted):
        measured.append(wanted)
        return dict(RESULTS)

    def run(*arguments):
        measured.clear()
        monkeypatch.setattr(sys, "argv", ["x", *arguments, "--results", str(tmp_path)])
        noise.main()
        return list(measured)

    monkeypatch.setattr(noise, "measure", measure)
    monkeypatch.setattr(noise.torch, "set_num_threads", lambda _: None)
    run.file = tmp_path / "noise.json"
    return run


def saved(benchmark):
    return json.loads(benchmark.file.read_text())["rows"]


OTHERS = [("--steps", "steps", 50), ("--gain", "gain", 0.5)]

EVERY = [{"model": model, "noise": kind} for model in noise.MODELS for kind in noise.NOISES]
"""What is measured with each seed, in this order."""


def kinds(rows):
    """The rows' entries of `EVERY`."""
    return [{key: row[key] for key in EVERY[0]} for row in rows]


def test_what_is_there_is_not_measured_again(benchmark):
    first = benchmark("--seeds", "100")
    assert kinds(first) == EVERY
    assert benchmark("--seeds", "100") == []
    assert {row["seed"] for row in benchmark("--seeds", "100", "101")} == {101}


def test_an_interrupted_benchmark_goes_on(benchmark, monkeypatch):
    whole, every = noise.measure, EVERY

    def interrupted(wanted):
        if kinds([wanted]) == every[2:3]:
            raise KeyboardInterrupt
        return whole(wanted)

    monkeypatch.setattr(noise, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        benchmark("--seeds", "100")
    monkeypatch.setattr(noise, "measure", whole)
    assert kinds(benchmark("--seeds", "100")) == every[2:]


def test_other_settings_are_kept_apart(benchmark):
    num_rows = len(benchmark("--seeds", "100"))
    before = saved(benchmark)
    for option, column, value in OTHERS:
        rows = benchmark("--seeds", "100", option, str(value))
        assert len(rows) == num_rows
        assert {row[column] for row in rows} == {value}
        command = find(saved(benchmark), **{column: value})["command"]
        assert command.endswith(f"{option} {value} --results {benchmark.file.parent}")
        assert benchmark("--seeds", "100", option, str(value)) == []
    assert str(saved(benchmark)[:num_rows]) == str(before)  # in which NaN equals NaN


def test_the_table_has_all_rows_and_commands(benchmark, capsys):
    option, column, value = OTHERS[0]
    benchmark("--seeds", "100"), benchmark("--seeds", "100", option, str(value))
    page = benchmark.file.with_suffix(".md").read_text()
    about, _, header, _, *rows = page.splitlines()
    assert about.count("benchmarks.noise --seeds 100") == 2
    assert len(rows) == 2 * len(EVERY)
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
    shutil.copy(COMMITTED / "noise" / benchmark.file.name, benchmark.file)
    committed = saved(benchmark)
    assert benchmark("--seeds", "100") == []
    option, column, value = OTHERS[0]
    assert len(benchmark("--seeds", "100", option, str(value))) == len(EVERY)
    rows = saved(benchmark)
    for old, row in zip(committed, rows, strict=False):
        assert row == row | old
    assert rows[0][column] == noise.SETTINGS.get_default(column)
    assert {row[column] for row in rows[len(committed) :]} == {value}


def test_old_rows_have_the_settings_of_their_files_command(tmp_path):
    file = tmp_path / "noise.json"
    command = "python -m benchmarks.noise --models GP --gain 0.5"
    old = {"command": command, "gain": 0.5, "torch": "2.3", "rows": [{"model": "GP", "seed": 1}]}
    file.write_text(json.dumps(old))
    made_with = {"steps": 220, "gain": 0.5, "command": command, "torch": "2.3"}
    assert read_rows(file, noise.SETTINGS) == [made_with | {"model": "GP", "seed": 1}]


def add_one(row):
    return {"found": row["seed"] + 1, "process": os.getpid()}


@pytest.mark.parametrize("jobs", [1, 2])
def test_several_are_measured_at_a_time(tmp_path, jobs):
    wanted = [{"seed": seed} for seed in range(3)]
    measure_missing("sums", tmp_path, wanted, add_one, jobs=jobs)
    rows = json.loads((tmp_path / "sums.json").read_text())["rows"]
    assert sorted((row["seed"], row["found"]) for row in rows) == [(0, 1), (1, 2), (2, 3)]
    assert (os.getpid() in {row["process"] for row in rows}) == (jobs == 1)
