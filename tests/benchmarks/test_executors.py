"""Jobs come back from processes, Ray and Dask; the death of a worker costs none of them."""

import sys
from dataclasses import replace

import pytest

from benchmarks import executors
from benchmarks.executors import ClusterError, executor
from benchmarks.jobs import Folders, execute, keep, log_of
from benchmarks.result_files import RunResult
from benchmarks.run import Run
from tests.benchmarks.toy import TINY, TOY, Errand, steps_in, toy
from tests.runs.toy import EPISODE_STEPS


@pytest.fixture
def folders(tmp_path):
    return Folders(tmp_path / "results", tmp_path / "work")


@pytest.fixture
def errand(tmp_path):
    return lambda name, **arguments: Errand(name, str(tmp_path / f"{name}.diary"), **arguments)


def outcomes(execute_all, jobs, folders):
    return {job.name: outcome for job, outcome in execute_all(jobs, folders)}


def test_one_after_the_other_in_this_process(errand, folders):
    found = list(executor(1)([errand("a"), errand("b", fails=True), errand("c")], folders))
    assert [job.name for job, _ in found] == ["a", "b", "c"]
    assert [outcome.content for _, outcome in found] == ["a", None, "c"]
    assert found[1][1].message == "ValueError: it was not to be"
    assert "perform" in found[1][1].failure


@pytest.mark.parametrize("content", [None, "half a file"])
def test_a_job_whose_file_is_something_elses_fails_here(folders, tmp_path, content):
    """Whatever the worker's folder has: the file is not replaced by what would come back."""
    run = Run("PPO", TOY, 0, 1, asked=TINY["PPO"])
    other = replace(run, asked=TINY["PPO"] | {"gamma": 0.5})
    run.perform(folders)
    path = folders.results / run.file_name
    if content is not None:
        path.write_text(content)
    elsewhere = Folders(tmp_path / "there", tmp_path / "there")
    before = path.read_text()

    def worker(jobs, _):
        return ((job, execute(job, elsewhere)) for job in jobs)

    done = list(executors.refuse_foreign_files(worker)([other, replace(run, seed=1)], folders))
    for job, outcome in done:
        keep(job, outcome, folders.results)
    assert [job.seed for job, _ in done] == [0, 1]
    assert path.read_text() == before
    refused, allowed = (outcome for _, outcome in done)
    assert refused.message.startswith("OtherRunError: " if content is None else "ResultError: ")
    assert refused.content is None and log_of(other, folders.results).exists()
    assert allowed.content is not None


def test_processes_that_die(errand, folders, tmp_path, monkeypatch):
    monkeypatch.setattr(executors, "RETRIES", 1)
    jobs = [errand("poison", dies=100), errand("unlucky", dies=1), *(errand(name) for name in "abc")]
    found = outcomes(executor(2), jobs, folders)
    assert {name: outcome.content for name, outcome in found.items()} == {
        "poison": None, "unlucky": "unlucky", "a": "a", "b": "b", "c": "c",
    }  # fmt: skip
    assert "TerminatedWorkerError" in found["poison"].message
    assert steps_in(tmp_path / "unlucky.diary") >= 2


@pytest.mark.slow
def test_a_run_on_ray_whose_worker_is_killed_goes_on(folders, tmp_path):
    """Two workers, one of them killed in the middle of a run's last episode: both results arrive, the killed one the
    same as without the kill, and none of its finished episodes was played again."""
    diary, method = tmp_path / "diary", "DGP-MPC L=1 matern32"
    killed = Run(method, toy(diary=str(diary), ends_at=2 * EPISODE_STEPS + 4), 0, 2, asked=TINY[method])
    other = Run(method, TOY, 1, 2, asked=TINY[method])
    undisturbed = Run(method, TOY, 0, 2, asked=TINY[method])
    for job, outcome in executor(2, "ray")([killed, other], folders):
        keep(job, outcome, folders.results)
        assert outcome.failure is None
    assert steps_in(diary) == 2 * EPISODE_STEPS + 4 + EPISODE_STEPS
    undisturbed.perform(Folders(tmp_path / "undisturbed", tmp_path / "undisturbed"))
    found, _ = (RunResult.read(folders.results / job.file_name) for job in (killed, other))
    expected = RunResult.read(tmp_path / "undisturbed" / killed.file_name)
    assert [episode.episode_return for episode in found.episodes] == [
        episode.episode_return for episode in expected.episodes
    ]


@pytest.mark.slow
def test_dask_workers_that_die(errand, folders, tmp_path):
    """More often than Dask itself begins a task again, which is 3 times."""
    jobs = [errand("unlucky", dies=5), errand("a"), errand("b", fails=True)]
    found = outcomes(executor(2, "dask"), jobs, folders)
    assert {name: outcome.content for name, outcome in found.items()} == {"unlucky": "unlucky", "a": "a", "b": None}
    assert steps_in(tmp_path / "unlucky.diary") == 6


@pytest.mark.parametrize("cluster", ["rays", "http://a:1", ""])
def test_addresses_of_no_cluster(cluster):
    with pytest.raises(ClusterError, match=repr(cluster)):
        executor(1, cluster)


@pytest.mark.parametrize(
    ("cluster", "module", "extra"), [(None, "joblib", "bench"), ("ray", "ray", "ray"), ("dask", "distributed", "dask")]
)
def test_what_is_not_installed_is_named(monkeypatch, cluster, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ClusterError, match=rf"{module}.*\[{extra}\]"):
        executor(1, cluster)
