"""A run of every method leaves its result, goes on where it was killed, and is not done twice."""

import json
import os
from dataclasses import replace

import pytest
import torch

from benchmarks import run as run_module
from benchmarks.jobs import Folders, execute, keep, log_of, unfinished
from benchmarks.methods import METHODS
from benchmarks.result_files import ResultError, RunResult
from benchmarks.run import OtherRunError, Run
from benchmarks.tasks import TASKS
from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.planning import CEM
from tests.benchmarks.toy import CART_POLE, TINY, TOY, steps_in, toy
from tests.runs.toy import EPISODE_STEPS

DGP = "DGP-MPC L=1 matern32"
KINDS = [DGP, "PETS TSinf", "GP-MM"]


@pytest.fixture
def folders(tmp_path):
    return Folders(tmp_path / "results", tmp_path / "work")


def tiny(method, task=TOY, episodes=2, **arguments):
    asked = TINY[method] | arguments.pop("asked", {})
    return Run(method, CART_POLE if method == "true dynamics" else task, 0, episodes, asked=asked, **arguments)


def returns(result):
    return [episode.episode_return for episode in result.episodes]


@pytest.mark.parametrize("method", sorted(TINY))
def test_every_method_leaves_its_result(method, folders):
    run = tiny(method, command="dgpmpc bench a")
    assert not run.is_finished(folders.results)
    message = run.perform(folders)
    assert run.is_finished(folders.results)
    result = RunResult.read(folders.results / run.file_name)
    is_random, count = 0 if method == "PPO" else 1, 3
    assert [episode.total_steps for episode in result.episodes] == [EPISODE_STEPS * (1 + i) for i in range(count)]
    assert {episode.steps for episode in result.episodes} == {EPISODE_STEPS}
    acting = "policy" if METHODS[method].is_model_free else "planned"
    assert [episode.actions for episode in result.episodes] == ["random"] * is_random + [acting] * (count - is_random)
    assert all(episode.seconds >= 0 and episode.cpu_seconds >= 0 for episode in result.episodes)
    # Whatever learns has been trained before its last episode, and before the first one nothing has.
    trained = [episode.training_iterations for episode in result.episodes]
    assert (trained[-1] > 0) == (method != "true dynamics") and (method == "PPO" or trained[0] == 0)
    assert result.milliseconds_per_action > 0
    assert result.num_steps == (EPISODE_STEPS * count if METHODS[method].is_model_free else None)
    assert result.settings == json.loads(json.dumps(run.settings))
    assert set(TINY[method]) <= set(result.settings)
    assert {"python", "torch", "stable-baselines3", "gym-dgpmpc"} <= set(result.versions)
    assert result.machine["threads"] == 1
    assert result.command == "dgpmpc bench a"
    assert f"{count - is_random} episodes" in message
    if method != "true dynamics":
        # The toy's own reward, whatever its step returned; a step of it costs at most some ten.
        assert min(returns(result)) > -100 * EPISODE_STEPS / 2
        assert [episode.success for episode in result.episodes] == [False] * count


def test_the_tiny_settings_are_of_every_method():
    assert {name for name in METHODS if not name.startswith("DGP-MPC")} | {DGP} == set(TINY)


@pytest.mark.parametrize("method", KINDS)
def test_a_run_goes_on_after_its_last_finished_episode(method, folders, tmp_path):
    """Interrupted in its third episode it ends as it would have ended, and plays no finished episode again."""
    diary = tmp_path / "diary"
    task = toy(diary=str(diary), ends_at=30, end="interrupt")
    run = tiny(method, task, episodes=3)
    with pytest.raises(KeyboardInterrupt):
        run.perform(folders)
    assert run.episodes_so_far(folders.work) == 1
    assert not run.is_finished(folders.results)
    run.perform(folders)
    assert steps_in(diary) == 30 + 2 * EPISODE_STEPS
    undisturbed = tiny(method, episodes=3)
    undisturbed.perform(folders._replace(results=tmp_path / "undisturbed", work=tmp_path / "elsewhere"))
    expected = RunResult.read(tmp_path / "undisturbed" / run.file_name)
    assert returns(RunResult.read(folders.results / run.file_name)) == returns(expected)


def test_a_run_goes_on_within_a_long_episode(folders, tmp_path, monkeypatch):
    """From its 28th step, the fourth of its third episode: what was done before is repeated without plans."""
    monkeypatch.setattr(run_module, "CHECKPOINT_EVERY", 7)
    diary, pause = tmp_path / "diary", 1.0
    run = tiny(DGP, toy(diary=str(diary), pauses_at=26, pause=pause, ends_at=30, end="interrupt"), episodes=3)
    with pytest.raises(KeyboardInterrupt):
        run.perform(folders)
    plan, planned = CEM.plan, []
    monkeypatch.setattr(CEM, "plan", lambda *given, **named: planned.append(1) or plan(*given, **named))
    run.perform(folders)
    assert len(planned) == 4 * EPISODE_STEPS - 28
    result = RunResult.read(folders.results / run.file_name)
    run.perform(undisturbed := Folders(tmp_path / "undisturbed", tmp_path / "elsewhere"))
    assert returns(result) == returns(RunResult.read(undisturbed.results / run.file_name))
    assert result.episodes[2].seconds >= pause  # before the interruption


def test_planning_with_the_simulator_goes_on_too(folders):
    tiny("true dynamics", episodes=1).perform(folders)
    longer = tiny("true dynamics", episodes=3)
    longer.perform(folders)
    at_once = longer.perform(Folders(folders.results / "b", folders.work / "b"))
    assert "3 episodes" in at_once
    both = [RunResult.read(folder / longer.file_name) for folder in (folders.results, folders.results / "b")]
    assert returns(both[0]) == returns(both[1])


def test_a_run_of_more_episodes_goes_on_from_the_shorter_one(folders, tmp_path):
    diary = tmp_path / "diary"
    run = tiny(DGP, toy(diary=str(diary)), episodes=1)
    run.perform(folders)
    longer = replace(run, episodes=2)
    assert not longer.is_finished(folders.results)
    longer.perform(folders)
    assert steps_in(diary) == 3 * EPISODE_STEPS
    assert run.is_finished(folders.results)


def test_an_unfinished_run_that_is_older_than_a_setting_goes_on(folders):
    run = tiny(DGP, episodes=1)
    run.perform(folders)
    (file,) = folders.work.rglob("settings.json")
    content = json.loads(file.read_text())
    del content["settings"]["risk"]
    file.write_text(json.dumps(content))
    assert "2 episodes" in replace(run, episodes=2).perform(folders)
    with pytest.raises(DGPMPCError, match="risk was mean, now worst"):
        tiny(DGP, episodes=2, asked={"risk": "worst"}).perform(folders)


def test_a_finished_run_is_not_done_again(folders, tmp_path):
    diary = tmp_path / "diary"
    for method in (DGP, "PPO"):
        run = tiny(method, toy(diary=str(diary)), episodes=1)
        first = execute(run, folders)
        steps = steps_in(diary)
        again = execute(run, folders)
        assert (again.message, again.content) == ("finished already", first.content)
        assert steps_in(diary) == steps


def test_without_a_model_the_steps_count(folders):
    run = tiny("PPO", episodes=1)
    run.perform(folders)
    assert not replace(run, times=2).is_finished(folders.results)
    assert replace(run, times=2).max_steps == 2 * 2 * EPISODE_STEPS


def test_a_shorter_run_is_not_finished_however_many_steps_its_last_episode_lacks(folders):
    run = tiny("SAC", toy(terminate_at=7), episodes=1)
    run.perform(folders)
    result = RunResult.read(folders.results / run.file_name)
    assert (result.num_steps, result.episodes[-1].total_steps) == (2 * EPISODE_STEPS, 21)
    assert run.is_finished(folders.results)
    a_little_longer = replace(run, task=replace(run.task, episode_steps=EPISODE_STEPS + 1))
    assert not a_little_longer.is_finished(folders.results)
    replace(result, num_steps=None).write(folders.results)  # as in older files: up to an episode may be missing
    assert a_little_longer.is_finished(folders.results)


def test_the_steps_of_another_run_count_once_it_is_there(folders):
    """Ten times the steps of a run whose episodes ended early are ten times fewer."""
    planned = tiny(DGP, toy(terminate_at=4), episodes=1)
    run = tiny("PPO", episodes=1, times=3, steps_of=DGP)
    assert run.steps_wanted(folders.results) == run.max_steps == 3 * 2 * EPISODE_STEPS
    planned.perform(folders)
    assert run.steps_wanted(folders.results) == 3 * 2 * 4
    assert not run.is_finished(folders.results)
    run.perform(folders)
    assert RunResult.read(folders.results / run.file_name).episodes[-1].total_steps == 3 * 2 * 4
    assert run.is_finished(folders.results)


def test_short_episodes_are_counted(folders):
    run = tiny("TD3", toy(terminate_at=5), episodes=1, asked={"learning_starts": 7})
    run.perform(folders)
    result = RunResult.read(folders.results / run.file_name)
    assert [(episode.actions, episode.total_steps) for episode in result.episodes] == [
        ("random", 5), ("random", 10), ("policy", 15), ("policy", 20),
    ]  # fmt: skip
    assert run.is_finished(folders.results)


def test_an_episode_that_begins_at_random_is_not_one_of_those_that_are_asked_for(folders):
    run = tiny(DGP, toy(terminate_at=5), episodes=2, asked={"learning_starts": 7})
    run.perform(folders)
    episodes = RunResult.read(folders.results / run.file_name).episodes
    assert [episode.actions for episode in episodes] == ["random", "random", "planned", "planned"]
    assert run.is_finished(folders.results)
    longest = tiny(DGP, episodes=2, asked={"learning_starts": EPISODE_STEPS + 1}, task=toy())
    longest.perform(folders._replace(results=folders.results / "b", work=folders.work / "b"))
    assert longest.is_finished(folders.results / "b")


def test_other_settings_are_no_finished_run(folders):
    run = tiny(DGP, episodes=1)
    run.perform(folders)
    other = tiny(DGP, episodes=1, asked={"horizon": 2})
    with pytest.raises(OtherRunError, match="horizon was 3, now 2"):
        other.is_finished(folders.results)
    outcome = execute(other, folders)
    assert outcome.message.startswith("OtherRunError: ")
    assert unfinished([run, other], folders.results) == [other]
    (folders.results / run.file_name).unlink()
    assert "RunFolderError: " in (message := execute(other, folders).message)
    assert "horizon was 3, now 2" in message
    assert "choose another folder for unfinished runs" in message


def test_settings_that_a_file_does_not_name_are_the_methods_own(folders):
    """Files of runs that were made by hand name fewer."""
    run = Run(DGP, TOY, 0, 1)
    tiny(DGP, episodes=1).perform(folders)
    one = RunResult.read(folders.results / run.file_name)
    replace(one, settings={"num_inducing": run.settings["num_inducing"]}).write(folders.results)
    assert run.is_finished(folders.results)
    with pytest.raises(OtherRunError, match=r"gibbs_every was \d+, now 0"):
        replace(run, asked={"gibbs_every": 0}).is_finished(folders.results)
    assert replace(run, asked={"gibbs_every": run.settings["gibbs_every"]}).is_finished(folders.results)
    replace(one, settings={"temperature": 2}).write(folders.results)
    with pytest.raises(OtherRunError, match="temperature was 2"):
        run.is_finished(folders.results)


def test_a_damaged_result_is_told_of(folders):
    run = tiny("PPO", episodes=1)
    folders.results.mkdir()
    (folders.results / run.file_name).write_text("{")
    with pytest.raises(ResultError, match=run.file_name):
        run.is_finished(folders.results)
    assert execute(run, folders).content is None


def test_settings_that_do_not_exist_are_named():
    with pytest.raises(ValueError, match=r"SAC.*\['horizon'\]"):
        METHODS["SAC"].settings(TOY, horizon=3)


def test_what_the_task_tells_the_environment_is_no_setting_to_ask_for():
    with pytest.raises(ValueError, match=r"SAC.*\['penalise_step'\]"):
        METHODS["SAC"].settings(TASKS["RiskSensitiveHalfCheetah-v0"], penalise_step=False)


@pytest.mark.parametrize("names", [("PETS", None), ("SAC", "PETS")])
def test_methods_that_do_not_exist_are_named(names):
    with pytest.raises(ValueError, match=r"'PETS'.*PETS TS1"):
        Run(names[0], TOY, 0, 1, steps_of=names[1])


def test_every_job_is_done_on_one_thread(folders, monkeypatch):
    job, seen = tiny("PPO"), []
    monkeypatch.setattr(Run, "perform", lambda *_: seen.append(torch.get_num_threads()))
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        execute(job, folders)
    finally:
        torch.set_num_threads(threads)
    assert seen == [1]


def test_a_failure_leaves_no_result_but_a_log(folders, tmp_path):
    run = tiny(DGP, toy(diary=str(tmp_path / "diary"), ends_at=30, end="failure"))
    outcome = execute(run, folders)
    assert outcome.content is None
    assert "step 29" in outcome.message
    keep(run, outcome, folders.results)
    assert [path.name for path in folders.results.iterdir()] == [log_of(run, folders.results).name]
    assert "ConnectionError: the plant is gone" in log_of(run, folders.results).read_text()
    keep(run, execute(run, folders), folders.results)
    assert [path.name for path in folders.results.iterdir()] == [run.file_name]


def test_a_result_that_cannot_be_written_is_written_the_next_time(folders, tmp_path, monkeypatch):
    diary, real = tmp_path / "diary", os.replace
    run = tiny(DGP, toy(diary=str(diary)), episodes=1)

    def full_disk(source, target):
        if folders.results in target.parents:
            raise OSError(28, "no space left on device")
        real(source, target)

    monkeypatch.setattr(os, "replace", full_disk)
    assert "no space left" in execute(run, folders).message
    assert list(folders.results.iterdir()) == []
    monkeypatch.undo()
    run.perform(folders)
    assert steps_in(diary) == 2 * EPISODE_STEPS
    assert len(RunResult.read(folders.results / run.file_name).counted) == 1


def test_a_result_of_another_machine_is_kept(folders, tmp_path):
    """The worker's folders need not be the ones of who gave it the job."""
    run = tiny("PPO", episodes=1)
    outcome = execute(run, Folders(tmp_path / "there", tmp_path / "there"))
    keep(run, outcome, folders.results)
    assert run.is_finished(folders.results)


@pytest.mark.parametrize("name", [name for name in TASKS if name.startswith("RiskSensitiveHalfCheetah")])
def test_model_free_methods_learn_of_the_risk_that_planners_plan_with(name):
    task = TASKS[name]
    for is_model_free in (True, False):
        env = task.make(model_free=is_model_free)
        assert env.get_wrapper_attr("plans_with_another_reward") != is_model_free
        env.close()
    assert METHODS["SAC"].settings(task)["penalise_step"]


def test_a_run_by_another_planner_goes_on_and_is_not_done_twice(folders, tmp_path):
    """Settings of the method's own planner, which it lacks, are none that it could differ in."""
    run = tiny(
        DGP, toy(diary=str(tmp_path / "diary"), ends_at=30, end="interrupt"), episodes=3, asked={"planner": "icem"}
    )
    with pytest.raises(KeyboardInterrupt):
        run.perform(folders)
    run.perform(folders)
    assert run.is_finished(folders.results)
    with pytest.raises(OtherRunError, match="planner was icem, now cem"):
        tiny(DGP, episodes=3).is_finished(folders.results)
