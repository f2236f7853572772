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
from typer.testing import CliRunner

from benchmarks import suites
from benchmarks.contact.data import CASES, contact_test
from benchmarks.contact.result_files import ContactKey, ContactResult, ResultError
from benchmarks.contact.scores import crps
from benchmarks.contact.study import ContactRun, open_loop, quantities
from benchmarks.jobs import Folders, Job, execute
from benchmarks.suites import ContactSuite, Selection, SuiteError
from gym_dgpmpc.cli import app
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.envs.mod_cartpole import ModCartPoleEnv
from tests.benchmarks.contact.made_up import TINY, made_up

TINY_SUITE = ContactSuite(settings=TINY)


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
    """The CRPS of the paths that are kept, which are all there are, is the one that is reported."""
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


@pytest.mark.parametrize("key", [ContactKey("a", "matern12", 3, 0), ContactKey("b", "rbf", 2, 1)])
@pytest.mark.parametrize("patience", [None, 7])
def test_a_run_trains_the_model_of_its_key_and_settings(monkeypatch, key, patience):
    class Trained(Exception):
        """Enough seen."""

    def fit(model, *_):
        raise Trained(model)

    monkeypatch.setattr(DeepGPDynamics, "fit", fit)
    settings = replace(TINY, patience=patience)
    with pytest.raises(Trained) as seen:
        ContactRun(key, settings).measure()
    (model,) = seen.value.args
    assert (model.kernel.name, model.num_layers) == (key.kernel, key.num_layers)
    assert model.draw_kind == "marginal"  # the paper's law
    assert (model.inference.patience, model.dtype) == (patience, torch.float64)
    assert model.first_training_iterations == settings.first_iterations
    for name in ("num_inducing", "num_samples", "sample_spacing"):
        assert getattr(model, name) == getattr(settings, name)


def test_a_study_is_narrowed_as_every_suite_and_its_seeds_come_outermost():
    jobs = TINY_SUITE.jobs(Selection(seeds=[3, 4], tasks=["case [ab]"], methods=["DGP L=[12] rbf"]))
    assert jobs[0].key == ContactKey("a", "rbf", 1, 3) and isinstance(jobs[0], Job)
    assert jobs[0].name == "case a | DGP L=1 rbf | seed 3"
    task, method, _ = jobs[0].name.split(" | ")
    assert TINY_SUITE.jobs(Selection(seeds=[3], tasks=[task], methods=[method])) == jobs[:1]
    assert [job.key.seed for job in jobs] == [3] * 4 + [4] * 4
    assert len({job.key for job in jobs}) == 8
    assert len({job.key for job in ContactSuite().jobs(Selection())}) == 3 * 4 * 3 * 10


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        (Selection(tasks=["case d"]), "'case d'.*case a, case b, case c"),
        (Selection(methods=["*cubic"]), r"\'\*cubic\'.*DGP L=1 matern12"),
        (Selection(episodes=3), "=3"),
    ],
)
def test_what_is_not_in_the_study_is_refused(selection, message):
    with pytest.raises(SuiteError, match=message):
        TINY_SUITE.jobs(selection)


PART = Selection(seeds=[100, 101], tasks=["case a"], methods=["DGP L=[12] rbf", "DGP L=[12] matern12"])
STUDY = """
from pathlib import Path
from benchmarks.jobs import Folders, execute
from tests.benchmarks.contact.test_study import PART, TINY_SUITE
if __name__ == "__main__":
    for job in TINY_SUITE.jobs(PART):
        execute(job, Folders(Path({folder!r}), Path({folder!r})))
"""


def test_a_killed_study_goes_on(tmp_path):
    """Killed after its first result, and done in another process: the rest, and no more."""
    folder, script = tmp_path / "study", tmp_path / "study.py"
    script.write_text(STUDY.format(folder=str(folder)))
    here = str(Path(__file__).parents[3])
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

    outcomes = [execute(job, Folders(folder, folder)) for job in TINY_SUITE.jobs(PART)]
    assert [outcome.message == "finished already" for outcome in outcomes].count(True) == len(done)
    assert not any(outcome.failure for outcome in outcomes)
    paths = sorted(folder.glob("contact_*.json"))
    assert len(paths) == 8
    assert {path: path.stat().st_mtime_ns for path in done} == before
    # What other processes wrote is what this one measures.
    for path in (done[0], paths[-1]):
        written = ContactResult.read(path)
        measured = ContactResult.read(ContactRun(written.key, TINY).measure().write(tmp_path / "again"))
        for name in ("scores", "counts", "paths", "truth", "training_contact", "test_contact"):
            assert getattr(written, name) == getattr(measured, name)


def test_results_of_other_settings_are_refused(tmp_path):
    made_up(ContactKey("a", "rbf", 1, 0), 1.0).write(tmp_path)
    job = ContactSuite().jobs(Selection(seeds=[0]))[0]
    with pytest.raises(ResultError, match=r"seed0\.json.*num_inducing 15"):
        job.is_finished(tmp_path)


@pytest.fixture
def made_up_suite(monkeypatch, tmp_path):
    """The command's suite measures nothing, fails with the RBF kernel, and stands in a folder of its own."""

    def measure(run):
        if run.key.kernel == "rbf":
            raise ArithmeticError("no end")
        return made_up(run.key, 1.0)

    monkeypatch.setattr(ContactRun, "measure", measure)
    monkeypatch.setitem(suites.SUITES, "contact", replace(TINY_SUITE, results=tmp_path / "contact"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "contact"


def test_the_command_line_runs_and_reports(made_up_suite):
    options = ["--tasks", "case b", "--methods", "*matern12", "--seeds", "0"]
    result = CliRunner().invoke(app, ["bench", "contact", *options], catch_exceptions=False)
    assert result.exit_code == 0 and "3 jobs: 0 finished, 3 left" in result.output
    assert {path.name for path in made_up_suite.iterdir()} == {
        f"contact_b_matern12_L{depth}_seed0.json" for depth in (1, 2, 3)
    }
    result = CliRunner().invoke(app, ["report", str(made_up_suite), "--out", "page"], catch_exceptions=False)
    assert result.exit_code == 0 and result.output == "page.md and 2 figures in page\n"
    assert "](page/fans_b.png)" in Path("page.md").read_text() and Path("page/fans_b.png").exists()
    result = CliRunner().invoke(app, ["report", str(made_up_suite), "--task", "a"])
    assert result.exit_code == 2 and "--task a" in result.output
    (made_up_suite / "contact_b_matern12_L1_seed0.json").write_text("{}")
    result = CliRunner().invoke(app, ["report", str(made_up_suite)])
    assert result.exit_code == 2 and "contact_b_matern12_L1_seed0.json" in result.output


def test_a_run_that_fails_does_not_cost_the_others(made_up_suite):
    options = ["--tasks", "case a", "--methods", "DGP L=1 rbf,DGP L=1 matern12", "--seeds", "0"]
    result = CliRunner().invoke(app, ["bench", "contact", *options])
    assert result.exit_code == 1 and "case a | DGP L=1 rbf | seed 0: ArithmeticError: no end" in result.output
    left = {path.name for path in made_up_suite.iterdir()}
    assert left == {"contact_a_matern12_L1_seed0.json", "contact_a_rbf_L1_seed0.log"}
    assert "ArithmeticError: no end" in (made_up_suite / "contact_a_rbf_L1_seed0.log").read_text()
