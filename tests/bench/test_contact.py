"""Runs of the contact study: what they roll out, what they write, and that a killed study goes on."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gym_dgpmpc.bench import contact
from gym_dgpmpc.bench.contact import (
    ContactRun,
    ContactStudyError,
    contact_runs,
    main,
    open_loop,
    quantities,
    run_contact_study,
)
from gym_dgpmpc.bench.contact_data import CASES, contact_test
from gym_dgpmpc.bench.contact_results import ContactKey, ContactResult, ResultError
from gym_dgpmpc.bench.contact_scores import crps
from gym_dgpmpc.bench.jobs import Job
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.envs.mod_cartpole import ModCartPoleEnv
from tests.bench.contact_runs import TINY, made_up


def test_the_true_dynamics_roll_out_the_truth():
    trial = contact_test("a", 100, 4)
    states = open_loop(TrueDynamics(ModCartPoleEnv(frame_skip=1)), trial, 3, torch.Generator())
    assert states.shape == (16, 3, 4, 4)
    np.testing.assert_allclose(states, np.repeat(trial.states[:, None], 3, axis=1), rtol=0, atol=1e-9)


def test_the_change_of_the_angular_velocity_is_scored_too():
    states = np.random.default_rng(0).normal(size=(6, 2, 4))
    found = quantities(states)
    np.testing.assert_array_equal(found[..., :4], states[1:])
    np.testing.assert_allclose(found[..., 4].cumsum(axis=0), states[1:, :, 3] - states[0, :, 3], rtol=0, atol=1e-12)


def test_a_run_scores_what_it_keeps():
    """The CRPS of the paths that are kept, which are all there are, is the one that is told."""
    settings = replace(TINY, num_paths=TINY.num_particles, num_starts=1)
    result = ContactRun(ContactKey("a", "matern32", 2, 100), settings).measure()
    trial = contact_test("a", 100, 1)
    np.testing.assert_array_equal(result.truth, np.diff(trial.states[:, 0, 3]))
    assert np.shape(result.paths) == (TINY.num_particles, CASES["a"].horizon)
    by_step = crps(np.array(result.paths), np.array(result.truth))
    np.testing.assert_allclose(result.by_step("change of angular velocity", "crps"), by_step, rtol=1e-9)
    assert result.counts["after"] == trial.in_contact[:, 0].astype(int).tolist()
    assert result.test_contact == 1.0 and result.training_contact > 0.7
    assert result.training["iterations"] == TINY.first_iterations and result.fit_seconds > 0


def test_seeds_come_outermost():
    keys = [run.key for run in contact_runs(["a", "b"], ["rbf"], [1, 2], [3, 4], TINY)]
    assert keys[0] == ContactKey("a", "rbf", 1, 3)
    assert [key.seed for key in keys] == [3] * 4 + [4] * 4
    assert len(set(keys)) == 8


def test_a_run_is_a_job():
    (run,) = contact_runs(["a"], ["rbf"], [1], [3], TINY)
    assert isinstance(run, Job)
    assert run.name == "contact study, case a | rbf, L=1 | seed 3"


STUDY = """
from pathlib import Path
from gym_dgpmpc.bench.contact import run_contact_study
from tests.bench.contact_runs import TINY
if __name__ == "__main__":
    run_contact_study(Path({folder!r}), ["a"], ["rbf", "matern12"], [1, 2], [100, 101], 1, TINY)
"""


def test_a_killed_study_goes_on(tmp_path):
    """Killed after its first result, and done in other processes by the same call: the rest, and no more."""
    folder, script = tmp_path / "study", tmp_path / "study.py"
    script.write_text(STUDY.format(folder=str(folder)))
    here = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": here, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, str(script)], env=environment, stderr=subprocess.PIPE)
    since = time.monotonic()
    while not (done := list(folder.glob("contact_*.json"))):
        assert process.poll() is None and time.monotonic() - since < 300, process.stderr.read()
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    done = list(folder.glob("contact_*.json"))
    assert len(done) < 8
    before = {path: path.stat().st_mtime_ns for path in done}

    paths = run_contact_study(folder, ["a"], ["rbf", "matern12"], [1, 2], [100, 101], 2, TINY)
    assert len(paths) == 8 and set(paths) == set(folder.glob("contact_*.json"))
    assert {path: path.stat().st_mtime_ns for path in done} == before
    # What other processes wrote is what this one measures.
    for path in (done[0], paths[-1]):
        written = ContactResult.read(path)
        measured = ContactResult.read(ContactRun(written.key, TINY).measure().write(tmp_path / "again"))
        for name in ("scores", "counts", "paths", "truth", "training_contact", "test_contact"):
            assert getattr(written, name) == getattr(measured, name)


def test_a_run_that_fails_does_not_cost_the_others(tmp_path, monkeypatch):
    def measure(run):
        if run.key.kernel == "rbf":
            raise ArithmeticError("no end")
        return made_up(run.key, 1.0)

    monkeypatch.setattr(contact.ContactRun, "measure", measure)
    with pytest.raises(ContactStudyError, match=r"1 of 2 runs failed: .*case a \| rbf, L=1.*ArithmeticError: no end"):
        run_contact_study(tmp_path, ["a"], ["rbf", "matern12"], [1], [0], 1, TINY)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"contact_a_matern12_L1_seed0.json", "contact_a_rbf_L1_seed0.log"}
    assert "ArithmeticError: no end" in (tmp_path / "contact_a_rbf_L1_seed0.log").read_text()


def test_results_of_other_settings_are_refused(tmp_path):
    made_up(ContactKey("a", "rbf", 1, 0), 1.0).write(tmp_path)
    with pytest.raises(ResultError, match=r"seed0.json is of a study with other settings: num_inducing 15 instead of"):
        run_contact_study(tmp_path, ["a"], ["rbf"], [1], [0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cases": ["d"]}, "unknown case 'd'"),
        ({"kernels": ["cubic"]}, "unknown kernel 'cubic'"),
        ({"layers": [0]}, r"layers must be at least 1 and seeds at least 0, received \[0\]"),
        ({"seeds": [-1]}, "seeds at least 0"),
        ({"jobs": 0}, "jobs must be at least 1, received 0"),
    ],
)
def test_what_is_no_study_is_refused(tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        run_contact_study(tmp_path, **arguments)


def test_the_command_line_runs_and_reports(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(contact.ContactRun, "measure", lambda run: made_up(run.key, 1.0))
    monkeypatch.setattr(contact, "ContactSettings", lambda: TINY)
    folder, out = str(tmp_path / "runs"), str(tmp_path / "report")
    main(["run", folder, "--cases", "b", "--kernels", "rbf", "--layers", "1", "2", "--seeds", "0"])
    assert len(list((tmp_path / "runs").iterdir())) == 2
    main(["report", folder, out])
    told = capsys.readouterr().out.splitlines()
    assert told[0].endswith("contact_b_rbf_L1_seed0.json and 1 other files")
    assert told[1] == f"{tmp_path / 'report' / 'contact_study.md'} and 2 other files"
    (tmp_path / "runs" / "contact_b_rbf_L1_seed0.json").write_text("{}")
    with pytest.raises(SystemExit, match="is not a result of the contact study"):
        main(["report", folder, out])
    with pytest.raises(SystemExit, match="layers must be at least 1"):
        main(["run", folder, "--layers", "0"])
