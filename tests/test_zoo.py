"""What `python -m gym_dgpmpc.zoo` hands to the RL Zoo, whose commands run in `python -m tests.faults.packages`."""

import argparse
import sys

import pytest
from stable_baselines3.common.utils import ConstantSchedule

from gym_dgpmpc import zoo
from gym_dgpmpc.agents import presets
from gym_dgpmpc.envs.registration import ENVIRONMENTS
from tests.agents.point_mass import PointMass


class FirstOrLast:
    """Stands for an Optuna trial: every number is its least or its greatest, every word the first or the last."""

    def __init__(self, takes_last):
        self.takes_last, self.asked = takes_last, []

    def suggest_int(self, name, low, high, *, log=False):
        self.asked.append(name)
        return high if self.takes_last else low

    def suggest_categorical(self, name, choices):
        self.asked.append(name)
        return choices[-1 if self.takes_last else 0]


@pytest.mark.parametrize("algorithm", zoo.ALGORITHMS)
def test_every_registered_task_has_the_presets_of_each_agent(algorithm):
    found = zoo.hyperparameters(algorithm)
    assert {*ENVIRONMENTS, *presets.STOCK, "default"} == set(found)
    for env_id, settings in found.items():
        steps = settings.pop("n_timesteps")
        assert settings.pop("policy") == "MPCPolicy"
        assert settings == zoo.ALGORITHMS[algorithm].settings_for(env_id)
        if env_id in ENVIRONMENTS:  # a random episode and as many as `dgpmpc train` plays
            assert steps == 16 * ENVIRONMENTS[env_id][1]


def test_what_one_command_changes_is_not_kept():
    """The zoo overwrites what it read by `-params`."""
    zoo.hyperparameters("dgp-mpc")["ModCartPole-v0"]["horizon"] = 1
    assert zoo.hyperparameters("dgp-mpc")["ModCartPole-v0"]["horizon"] == presets.PAPER["ModCartPole-v0"]["horizon"]


@pytest.mark.parametrize("takes_last", [False, True])
@pytest.mark.parametrize("algorithm", zoo.ALGORITHMS)
def test_an_agent_takes_what_a_trial_samples(algorithm, takes_last):
    trial = FirstOrLast(takes_last)
    sampled = zoo.sample(algorithm, trial, 1, 1, {})
    assert list(sampled) == trial.asked and set(sampled) <= set(zoo.SEARCHED) and sampled
    agent = zoo.ALGORITHMS[algorithm].agent_class(PointMass(), **sampled, seed=0)
    assert sampled.items() <= agent.arguments().items()


def test_the_agents_of_the_deep_gaussian_process_search_its_depth_and_the_horizon():
    assert {"num_layers", "kernel", "horizon"} <= set(zoo.sample("dgp-mpc", FirstOrLast(False)))
    assert "horizon" not in zoo.sample("mc-pilco", FirstOrLast(False))


@pytest.mark.parametrize(
    ("command", "arguments", "read"),
    [
        ("train", ["--algo", "dgp-mpc", "--env", "ModCartPole-v0"], "gym_dgpmpc.zoo_dgp-mpc"),
        ("train", ["--env", "ModCartPole-v0", "--algo=pets"], "gym_dgpmpc.zoo_pets"),
        ("train", ["--algo", "sac"], None),
        ("train", [], None),
        ("train", ["--algo", "dgp-mpc", "-conf", "own.yml"], "own.yml"),
        ("train", ["--algo", "dgp-mpc", "--conf=own.yml"], "own.yml"),
        ("enjoy", ["--algo", "dgp-mpc"], None),
    ],
)
def test_presets_are_read_where_no_file_is_given(command, arguments, read):
    parser = argparse.ArgumentParser()  # with the names that the zoo's has
    for names in (("-conf", "--conf-file"), ("--algo",), ("--env",)):
        parser.add_argument(*names)
    assert parser.parse_args(zoo.with_presets(command, arguments)).conf_file == read


@pytest.mark.parametrize("algorithm", zoo.ALGORITHMS)
def test_an_agent_takes_its_presets_as_the_zoo_hands_them_on(algorithm):
    """Which makes a schedule of a learning rate."""
    settings = zoo.hyperparameters(algorithm)["ModCartPole-v0"]
    del settings["n_timesteps"]
    given = {name: ConstantSchedule(value) if name == "learning_rate" else value for name, value in settings.items()}
    agent = zoo.ALGORITHMS[algorithm].agent_class(env=PointMass(), **given)
    del settings["policy"]
    assert settings.items() <= agent.arguments().items()


@pytest.mark.parametrize(
    ("arguments", "status", "told"),
    [
        (["--help"], 0, "usage: python -m gym_dgpmpc.zoo {train,enjoy,"),
        ([], 0, "dgp-mpc, dyna"),
        (["trian"], 2, "There is no command 'trian'. usage:"),
    ],
)
def test_the_commands_are_named(arguments, status, told, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["zoo.py", *arguments])
    with pytest.raises(SystemExit) as stopped:
        zoo.main()
    assert stopped.value.code == status and told in capsys.readouterr().err


def test_a_missing_zoo_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    monkeypatch.setattr(sys, "argv", ["zoo.py", "train"])
    with pytest.raises(SystemExit, match=r'error: rl_zoo3 is not installed.*pip install "gym-dgpmpc\[zoo\]"'):
        zoo.main()
