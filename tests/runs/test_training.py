"""A training run keeps its results as they come, and goes on where its last finished episode ended."""

import json
from functools import partial

import gymnasium
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gym_dgpmpc.agents import DGPMPCAgent
from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.runs.folder import RunFolder
from gym_dgpmpc.runs.training import TrainingRun
from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT

HOLDERS = []
make_agent = partial(DGPMPCAgent, **SMALLEST_AGENT, seed=0)
SETTINGS = {"environment": "ToyPush-v0", "seed": 0}


def training_run(path, num_episodes=2, env_id="ToyPush-v0", look=False, **env_arguments):
    for holder in HOLDERS:  # what an earlier process would have let go of by its end
        holder.close()
    folder = RunFolder(path, SETTINGS)
    HOLDERS[:] = [folder]
    env = gymnasium.make(env_id, **env_arguments)
    steps = EPISODE_STEPS * (1 + num_episodes)
    run = TrainingRun(folder, env, make_agent, num_episodes=num_episodes, total_timesteps=steps, look=look)
    folder.write_settings(episodes=num_episodes)
    return run


def test_results(tmp_path, capsys):
    run = training_run(tmp_path, render_mode="rgb_array")
    assert not run.is_complete
    run.train(progress_bar=False)
    rows = run.folder.rows()
    assert [(row.episode, row.actions, row.steps, row.total_steps) for row in rows] == [
        (1, "random", 12, 12),
        (2, "planned", 12, 24),
        (3, "planned", 12, 36),
    ]
    assert rows[-1].episode_return == run.recorder.last.rewards.sum()
    assert all(row.seconds > 0 for row in rows)
    assert [row.planning_seconds > 0 for row in rows] == [False, True, True]
    assert all(row.planning_seconds < row.seconds for row in rows)
    assert all(row.cpu_seconds > 0 for row in rows)
    # Of the training that comes before the episode.
    assert [row.training_iterations for row in rows] == [
        0, SMALLEST_AGENT["first_training_iterations"], SMALLEST_AGENT["training_iterations"],
    ]  # fmt: skip
    assert {row.success for row in rows} == {None}
    assert capsys.readouterr().out.count("\nepisode ") == 3
    written = run.write_figures("a title")
    assert [path.name for path in written] == ["learning_curve.png", "prediction_fan.png", "last_episode.gif"]
    assert all(path.stat().st_size > 0 for path in written)
    assert list((tmp_path / "tensorboard").rglob("events*"))
    settings = json.loads((tmp_path / "settings.json").read_text())
    assert settings["settings"] == SETTINGS
    assert settings["episodes"] == 2
    assert "torch" in settings["versions"]
    assert settings["revision"]


def test_looks_inside_if_asked_to(tmp_path):
    for look in (False, True):
        folder = tmp_path / str(look)
        training_run(folder, num_episodes=1, look=look).train(progress_bar=False)
        (logs,) = (folder / "tensorboard").iterdir()
        assert ("look/coverage_90" in EventAccumulator(str(logs)).Reload().Tags()["scalars"]) == look


def test_the_saved_agent_has_learned_from_every_episode(tmp_path):
    run = training_run(tmp_path)
    run.train(progress_bar=False)
    saved = DGPMPCAgent.load(run.folder.agent_file)
    assert saved.num_fitted == len(saved.store) == 36


def test_episodes_are_counted_though_they_are_short(tmp_path):
    run = training_run(tmp_path, terminate_at=5)
    run.train(progress_bar=False)
    assert run.agent.task.modelled.terminated
    assert [row.steps for row in run.folder.rows()] == [5, 5, 5]
    assert run.is_complete
    assert DGPMPCAgent.load(run.folder.agent_file).num_fitted == 15


def test_goes_on(tmp_path):
    run = training_run(tmp_path, num_episodes=1)
    run.train(progress_bar=False)
    before = run.folder.rows()
    assert training_run(tmp_path, num_episodes=1).is_complete
    run = training_run(tmp_path, num_episodes=3)
    assert not run.is_complete
    run.train(progress_bar=False)
    rows = run.folder.rows()
    assert rows[:2] == before
    assert [row.episode for row in rows] == [1, 2, 3, 4]
    assert [row.total_steps for row in rows] == [12, 24, 36, 48]
    assert len(DGPMPCAgent.load(run.folder.agent_file).store) == 48


@pytest.mark.parametrize("total", [24, 30])
def test_a_run_that_was_killed_before_its_last_training_is_not_complete(tmp_path, monkeypatch, total):
    def run_of(total_timesteps):
        HOLDERS[:] = [holder.close() for holder in HOLDERS][:0]
        folder = RunFolder(tmp_path, SETTINGS)
        HOLDERS.append(folder)
        env = gymnasium.make("ToyPush-v0")
        run = TrainingRun(folder, env, make_agent, num_episodes=None, total_timesteps=total_timesteps)
        folder.write_settings()
        return run

    run = run_of(total)
    fit = run.agent.dynamics.fit

    def killed_in_the_second(data, generator):
        if len(data.action) == 24:
            raise KeyboardInterrupt
        return fit(data, generator)

    monkeypatch.setattr(run.agent.dynamics, "fit", killed_in_the_second)
    with pytest.raises(KeyboardInterrupt):
        run.train(progress_bar=False)
    assert (tmp_path / "prediction_fan.png").exists() == (
        total == 24
    )  # drawn before the checkpoint of the last episode
    run = run_of(total)
    assert not run.is_complete
    run.train(progress_bar=False)
    assert run.agent.num_timesteps == total
    assert run.agent.num_fitted == 24
    assert run_of(total).is_complete


class InterruptAt(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        if self.num_timesteps == self.step:
            raise KeyboardInterrupt
        return True


def test_goes_on_after_an_interruption_within_an_episode(tmp_path):
    run = training_run(tmp_path)
    run.forecasts = InterruptAt(30)
    with pytest.raises(KeyboardInterrupt):
        run.train(progress_bar=False)
    # As if the interruption had come between the row of an episode and the saving of its agent.
    run.folder.write_rows([*run.folder.rows(), run.folder.rows()[-1]._replace(episode=3, total_steps=36)])

    run = training_run(tmp_path)
    assert run.agent.num_timesteps == 24
    run.train(progress_bar=False)
    assert [(row.episode, row.total_steps) for row in run.folder.rows()] == [(1, 12), (2, 24), (3, 36)]
    assert run.agent.num_timesteps == 36


def test_what_was_finished_survives_a_failure(tmp_path, monkeypatch):
    run = training_run(tmp_path)

    def fail_from_the_third_episode_on(*args, **kwargs):
        if run.agent.num_timesteps >= 24:
            raise PlanningError("nothing is finite")
        return act(*args, **kwargs)

    act = run.agent.controller.act
    monkeypatch.setattr(run.agent.controller, "act", fail_from_the_third_episode_on)
    with pytest.raises(PlanningError):
        run.train(progress_bar=False)
    assert len(run.folder.rows()) == 2
    assert len(DGPMPCAgent.load(run.folder.agent_file).store) == 24


def test_for_results_only_nothing_is_drawn_or_said(tmp_path, capsys):
    folder = RunFolder(tmp_path, SETTINGS)
    env = gymnasium.make("ToyPush-v0", render_mode="rgb_array")
    run = TrainingRun(folder, env, make_agent, num_episodes=1, total_timesteps=24, results_only=True)
    run.train(progress_bar=False)
    assert run.is_complete
    assert capsys.readouterr().out == ""
    assert not list(tmp_path.glob("*.png"))
    assert not list(tmp_path.glob("*.gif"))
    assert run.agent.num_fitted == 12  # of the last episode it learns when there is another one
    folder.close()
