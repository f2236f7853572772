"""The examples run, at a tiny size."""

import math
import re
from pathlib import Path

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from examples import own_task, quickstart
from gym_dgpmpc import settings_for

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


def test_own_task():
    agent = own_task.main(episodes=2, **TINY)
    assert agent.is_fitted and agent.num_timesteps == 120
    low, high = agent.store.transitions().next_observation.aminmax(dim=0)
    assert (low >= 0).all() and (high <= 1).all() and (high > low).all()


def python_of(page):
    """The Python of a page, block by block."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


def test_the_readmes_lines_run(tmp_path, monkeypatch):
    """With settings that take no time: what the lines name is there, and is called as they call it."""
    (code,) = python_of("README.md")
    assert len([line for line in code.splitlines() if line]) <= 6
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gym_dgpmpc.settings_for", lambda env_id: {**settings_for(env_id), **TINY}, raising=False)
    namespace = {}
    exec(code.replace("total_timesteps=1_400", "total_timesteps=30"), namespace)
    assert namespace["agent"].num_timesteps == 30
    assert namespace["env"].action_space.contains(namespace["action"])


def test_the_other_agents_can_be_made_as_the_pages_say():
    namespace = {"env": gymnasium.make("gym_dgpmpc:ModCartPole-v0")}
    learning, *others = python_of("docs/using.md")
    assert "agent.learn(" in learning  # for minutes; `test_quickstart` does the same in less
    for code in others:
        exec(code, namespace)
    assert {namespace[name].num_timesteps for name in ("pets", "gp", "ceiling")} == {0}


def test_the_tutorial_shows_the_example():
    code = Path(own_task.__file__).read_text(encoding="utf-8")
    assert f"```python\n{code}```\n" in (ROOT / "docs" / "own_task.md").read_text(encoding="utf-8")
    assert len(code.splitlines()) < 40


@pytest.mark.filterwarnings("ignore:.*normalized:UserWarning", "ignore:.*infinity:UserWarning")
def test_own_task_is_an_environment():
    env = own_task.TwoTanks()
    check_env(env, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)
