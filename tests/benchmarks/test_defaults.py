"""`python -m benchmarks.defaults`: what a variant is measured in, once, and beside what."""

import argparse
import sys

import pytest

from benchmarks import defaults
from gym_dgpmpc.agents import presets
from tests.runs.toy import SMALLEST_AGENT

CART_POLE, CHEETAH = defaults.PROTOCOL[2:]


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Runs the protocol with measurements that take no time; gives what it measured."""
    measured = []

    def measure(wanted):
        measured.append(wanted)
        better = wanted["seed"] % 3 if wanted["settings"]["kernel"] == "rbf" else 0.0
        if wanted["stage"] in defaults.KNOWING:
            return {"nll": -better, "coverage_90": 0.9, "z2": 1.0, "rmse": 0.5, "cpu_minutes": 1.0}
        returns = [wanted["seed"] + better] * wanted["episodes"]
        return {"returns": returns, "return": returns[0], "cpu_minutes": 2.0}

    def run(*arguments):
        measured.clear()
        monkeypatch.setattr(sys, "argv", ["x", *arguments, "--jobs", "1", "--results", str(tmp_path)])
        defaults.main()
        return list(measured)

    monkeypatch.setattr(defaults, "measure", measure)
    monkeypatch.setattr(defaults.torch, "set_num_threads", lambda _: None)
    run.folder = tmp_path
    return run


def lines(run):
    return (run.folder / "defaults.md").read_text().splitlines()


def test_a_variant_is_measured_beside_the_defaults(run):
    rows = run("kernel=rbf")
    by_stage = {stage: sum(row["stage"] == stage for row in rows) for stage in (*defaults.KNOWING, CART_POLE, CHEETAH)}
    assert by_stage == {"cartpole": 10, "cheetah": 10, "pendulum": 0, "reacher": 0, CART_POLE: 10, CHEETAH: 6}
    assert {row["settings"]["kernel"] for row in rows} == {
        "rbf",
        presets.settings_for(CART_POLE).get("kernel", "matern32"),
    }
    assert run("kernel=rbf") == []
    # A planner has forecasts in common with the defaults.
    assert {row["stage"] for row in run("num_candidates=100")} == {CART_POLE, CHEETAH}


def test_differences_are_those_of_pairs_with_their_interval(run):
    run("kernel=rbf", "--stages", CART_POLE, "--seeds", "100", "101", "102")
    # Differences of 1, 2 and 0: their mean, and t(0.975, 2) = 4.303 standard errors of 1 / sqrt(3).
    assert (
        "| kernel=rbf | 100, 101, 102 | 102.00 | 1.00 [−1.48, 3.48] | 102, 102, 102, 102, 102 | 101 | 2.0 |"
        in lines(run)
    )
    assert "| default | 100, 101, 102 | 101.00 | – | 101, 101, 101, 101, 101 | 100 | 2.0 |" in lines(run)
    run("kernel=rbf", "--stages", "cartpole", "--seeds", "100", "101", "102")
    assert "| kernel=rbf | 100, 101, 102 | −1.00 | −1.00 [−3.48, 1.48] | 0.90 | 1.00 | 0.50 | 1.0 |" in lines(run)


def test_rows_of_former_defaults_stay_what_they_were(run, monkeypatch):
    run("--stages", CART_POLE, "--seeds", "100")
    was = presets.settings_for(CART_POLE)
    monkeypatch.setattr(presets, "settings_for", lambda env_id: {**was, "num_candidates": 200})
    assert len(run("--stages", CART_POLE, "--seeds", "100")) == 1
    named = [line.split(" |")[0] for line in lines(run) if line.startswith("| ")]
    assert named == ["| variant", f"| num_candidates={was['num_candidates']}", "| default"]


def test_of_a_planner_its_own_settings_are_named_only_where_they_differ(run):
    run("planner=mppi", "planner=mppi,temperature=0.3", "--stages", CART_POLE, "--seeds", "100")
    named = [line.split(" |")[0] for line in lines(run) if line.startswith("| ")]
    assert named[2:] == ["| planner=mppi", "| planner=mppi, temperature=0.3"]


@pytest.mark.parametrize("text", ["kernel", "=1", "a b=1", ""])
def test_a_variant_that_is_none_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="expected default, or settings"):
        defaults.variant(text)


def test_variants_are_read():
    assert defaults.variant("default") == {}
    read = defaults.variant("kernel=rbf,horizon=20,linear=True,patience=None,risk_aversion=0.5")
    assert read == {"kernel": "rbf", "horizon": 20, "linear": True, "patience": None, "risk_aversion": 0.5}


def test_an_unknown_setting_is_refused_before_anything_is_measured(run, capsys):
    with pytest.raises(SystemExit):
        run("kernell=rbf")
    assert "has no settings ['kernell']" in capsys.readouterr().err


def test_returns_are_those_of_the_planned_episodes(monkeypatch):
    monkeypatch.setattr(presets, "settings_for", lambda env_id=None: {**SMALLEST_AGENT, "learning_starts": 30})
    (wanted,) = defaults.wanted_rows({}, [100], ["OutsideCartPole-v0"], episodes=2)
    agents = []

    def keep(*arguments, make=defaults.METHOD.make):
        agents.append(make(*arguments))
        return agents[-1]

    monkeypatch.setattr(type(defaults.METHOD), "make", lambda self, *arguments: keep(*arguments))
    row = defaults.measure(wanted)
    rewards = agents[0].store.rewards
    assert len(rewards) == 180  # the first episode begins with random actions
    assert row["returns"] == pytest.approx([float(rewards[60:120].sum()), float(rewards[120:].sum())])
    assert row["return"] == pytest.approx(float(rewards[60:].sum()) / 2) and row["cpu_minutes"] > 0


def test_forecasts_are_summed_up(monkeypatch):
    scored = [
        {"nll": 1.0, "coverage_90": 0.8, "rmse": 0.1, "z2": 1.0},
        {"nll": 2.0, "coverage_90": 1.0, "rmse": 0.3, "z2": 9.0},
    ]
    given = []

    def forecast(make, task, seed, **settings):
        given.append((make.func.__name__, task, seed, settings["kernel"]))
        return [*scored, scored[0]]

    monkeypatch.setattr(defaults, "forecast_recorded", forecast)
    (wanted,) = defaults.wanted_rows({"kernel": "rbf"}, [101], ["cheetah"])
    row = defaults.measure(wanted)
    assert given == [("DeepGPDynamics", "cheetah", 101, "rbf")]
    assert (row["nll"], row["coverage_90"], row["z2"]) == (pytest.approx(4 / 3), pytest.approx(2.6 / 3), 1.0)
