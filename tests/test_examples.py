"""The examples run, at a tiny size."""

import math
from pathlib import Path

import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from examples import concepts, own_task, quickstart

ROOT = Path(own_task.__file__).parents[1]
TINY = {
    "num_inducing": 10,
    "num_features": 8,
    "first_training_iterations": 5,
    "training_iterations": 2,
    "num_samples": 4,
    "sample_spacing": 1,
    "resample_samples": 1,
    "num_candidates": 10,
    "num_elites": 2,
    "num_iterations": 1,
    "horizon": 2,
    "num_particles": 2,
    "learning_starts": 20,
}


def test_quickstart(tmp_path, capsys):
    mean = quickstart.main(220, tmp_path, **TINY)
    assert math.isfinite(mean)
    assert (tmp_path / "agent.zip").exists()
    printed = capsys.readouterr().out
    assert "return over two episodes" in printed
    assert "first action at" in printed


def test_concepts(tmp_path, monkeypatch):
    monkeypatch.setattr(concepts, "HORIZON", 2)
    concepts.main(20, tmp_path, **TINY)
    assert sorted(picture.name for picture in tmp_path.iterdir()) == ["plan.png", "worlds.png"]


def test_own_task():
    agent = own_task.main(episodes=2, **TINY)
    assert agent.is_fitted and agent.num_timesteps == 120
    low, high = agent.store.transitions().next_observation.aminmax(dim=0)
    assert (low >= 0).all() and (high <= 1).all() and (high > low).all()


def test_the_tutorial_shows_the_example():
    code = Path(own_task.__file__).read_text(encoding="utf-8")
    assert f"```python\n{code}```\n" in (ROOT / "docs" / "own_task.md").read_text(encoding="utf-8")
    assert len(code.splitlines()) < 40


@pytest.mark.filterwarnings("ignore:.*normalized:UserWarning", "ignore:.*infinity:UserWarning")
def test_own_task_is_an_environment():
    env = own_task.TwoTanks()
    check_env(env, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)
