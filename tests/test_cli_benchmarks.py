"""`dgpmpc bench` and `dgpmpc report` are those of a clone, and elsewhere say where the benchmarks are."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CLONE = Path(__file__).parents[1]


@pytest.fixture
def installed(tmp_path):
    """Calls `dgpmpc` as from an installed package: a folder of modules that is no clone, with a script in it."""
    site = tmp_path / "site"
    site.mkdir()
    (site / "gym_dgpmpc").symlink_to(CLONE / "gym_dgpmpc")
    (site / "dgpmpc.py").write_text("from gym_dgpmpc.cli import app\napp(prog_name='dgpmpc')\n")

    def run(*arguments, cwd=tmp_path):
        command = [sys.executable, str(site / "dgpmpc.py"), *map(str, arguments)]
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)

    run.site = site
    return run


def is_refused(result, name):
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert f"dgpmpc {name}" in result.stderr and "[bench]" in result.stderr
    return True


@pytest.mark.parametrize(
    "arguments", [["bench", "table"], ["bench"], ["report", "runs", "--out", "x", "--task", "a"], ["bench", "--list"]]
)
def test_without_a_clone_one_line_says_where_they_are(installed, arguments):
    assert is_refused(installed(*arguments), arguments[0])


def test_the_help_names_them_all_the_same(installed):
    result = installed("--help")
    assert result.returncode == 0
    assert {"train", "evaluate", "bench", "report"} <= set(result.stdout.split())


def test_another_package_of_that_name_is_not_taken_for_them(installed):
    foreign = installed.site / "benchmarks"
    foreign.mkdir()
    for name in ("__init__.py", "commands.py"):
        (foreign / name).write_text("raise SystemExit('this is not what was asked for')\n")
    assert is_refused(installed("bench", "table"), "bench")
    assert is_refused(installed("bench", "table", cwd=installed.site), "bench")
    assert is_refused(installed("bench", "table", cwd=CLONE), "bench")


def test_in_a_clone_its_benchmarks_are_found(installed):
    result = installed("bench", "contact", "--seeds", "0", "--list", cwd=CLONE)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1].startswith("36 jobs: ")


def test_a_package_in_a_clone_finds_its_benchmarks_from_any_folder(tmp_path):
    """Even if the first package of that name on Python's path is another one."""
    foreign = tmp_path / "benchmarks"
    foreign.mkdir()
    (foreign / "__init__.py").write_text("raise SystemExit('this is not what was asked for')\n")
    path = os.pathsep.join([str(tmp_path), str(CLONE)])
    command = [sys.executable, "-m", "gym_dgpmpc", "bench", "contact", "--seeds", "0", "--list"]
    environment = os.environ | {"PYTHONPATH": path}
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1].startswith("36 jobs: ")
