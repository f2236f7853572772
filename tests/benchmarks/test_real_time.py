"""`python -m benchmarks.real_time`: both settings of each agent, and times that are those of `predict`."""

import json
import sys
import time

import numpy as np
import pytest

from benchmarks import real_time
from gym_dgpmpc.agents.presets import REAL_TIME


class Clockwork:
    """An agent that takes 2 ms to push once to the right."""

    def __init__(self, **settings):
        self.num_layers, self.horizon, self.num_particles = 2, 30, 5
        self.num_candidates = settings.get("num_candidates", 300)
        self.num_iterations = settings.get("num_iterations", 5)

    def predict(self, observation, state=None):
        time.sleep(0.002)
        return np.ones(1, np.float32), state


@pytest.fixture
def run(monkeypatch, tmp_path):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["x", *arguments, "--results", str(tmp_path / "results")])
        real_time.main()
        facts = json.loads((tmp_path / "results" / "real_time.json").read_text())
        return facts, (tmp_path / "results" / "real_time.md").read_text()

    monkeypatch.setattr(real_time.DGPMPCAgent, "load", lambda path, env, **settings: Clockwork(**settings))
    monkeypatch.setattr(real_time.torch, "set_num_threads", lambda _: None)
    return run


def test_each_agent_has_a_row_with_either_settings(run):
    facts, page = run("a/agent.zip", "b/agent.zip", "--episodes", "1")
    assert [(row["agent"], row["settings"]) for row in facts["rows"]] == [
        ("a", "as trained"), ("a", "REAL_TIME"), ("b", "as trained"), ("b", "REAL_TIME"),
    ]  # fmt: skip
    quick = REAL_TIME["ModCartPole-v0"]
    assert [row["num_candidates"] for row in facts["rows"]] == [300, quick["num_candidates"]] * 2
    assert all(2 <= row["p50_ms"] <= row["p95_ms"] <= row["p99_ms"] <= row["max_ms"] for row in facts["rows"])
    assert len({row["returns"][0] for row in facts["rows"]}) == 1  # the same starting states
    assert {"python", "torch"} <= facts["versions"].keys() and facts["machine"]["processor"]
    assert "One step of the environment is 40 ms." in page
    assert page.splitlines()[-1].startswith("| b | 2 | REAL_TIME | ")
    assert page.splitlines()[-1].endswith("| – |")  # one episode has no spread


def test_returns_are_averaged_over_the_episodes(run):
    facts, page = run("a/agent.zip", "--episodes", "2")
    returns = facts["rows"][0]["returns"]
    assert len(set(returns)) == 2
    assert page.splitlines()[-1].endswith(f"| {np.mean(returns):.1f} | {np.std(returns, ddof=1):.1f} |")
