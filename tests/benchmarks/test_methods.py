"""Baselines are set as the work that they stand for has them, and as the comparison of the paper plans."""

import inspect
from dataclasses import replace

import numpy as np
import pytest
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise

from benchmarks.methods import METHODS
from benchmarks.tasks import TASKS
from gym_dgpmpc.agents import presets
from gym_dgpmpc.planning import PLANNERS
from tests.planning.toy_planners import RandomShooting

PAPER = {"ModCartPole-v0": 200, "BiasedReacher-v0": 150, "RiskSensitiveHalfCheetah-v0": 1000}
"""Steps of an episode."""


def unlike_the_library(name, algorithm, task):
    """The settings that are not the defaults of Stable-Baselines3."""
    defaults = {p.name: p.default for p in inspect.signature(algorithm).parameters.values()}
    settings = METHODS[name].settings(TASKS[task])
    return {key: value for key, value in settings.items() if key not in defaults or value != defaults[key]}


@pytest.mark.parametrize(("task", "steps"), PAPER.items())
def test_methods_without_a_model_have_the_librarys_settings_but_for_these(task, steps):
    env_arguments = {"penalise_step": True} if "HalfCheetah" in task else {}
    assert unlike_the_library("SAC", SAC, task) == {"learning_starts": steps, **env_arguments}
    assert unlike_the_library("TD3", TD3, task) == {"learning_starts": steps, "exploration_noise": 0.1, **env_arguments}
    assert unlike_the_library("PPO", PPO, task) == {"n_steps": steps, "batch_size": 50, **env_arguments}


def test_on_other_tasks_they_begin_as_the_library_does():
    assert unlike_the_library("SAC", SAC, "Pendulum-v1") == {}
    assert unlike_the_library("TD3", TD3, "Pendulum-v1") == {"exploration_noise": 0.1}


def test_td3_explores_with_the_noise_of_its_authors():
    """Fujimoto et al. (2018): N(0, 0.1), in half the width of the action range."""
    task = TASKS["BiasedReacher-v0"]
    env = task.make(model_free=True)
    model = METHODS["TD3"].make(env, METHODS["TD3"].settings(task), seed=0)
    assert isinstance(model.action_noise, NormalActionNoise)
    np.random.seed(0)  # noqa: NPY002  # the library's noise draws from there
    draws = np.array([model.action_noise() for _ in range(2000)])
    env.close()
    assert draws.shape == (2000, 7)
    # Five standard errors of a mean and of a deviation.
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=5 * 0.1 / np.sqrt(len(draws)))
    np.testing.assert_allclose(draws.std(axis=0), 0.1, rtol=5 / np.sqrt(2 * len(draws)))


@pytest.mark.parametrize("task", PAPER)
@pytest.mark.parametrize(
    ("name", "draw"), [("PETS TS1", "TS1"), ("PETS TSinf", "TSinf"), ("PETS as published", "TSinf")]
)
def test_pets_trains_as_published(name, draw, task):
    found = METHODS[name].settings(TASKS[task])
    wanted = {"draw": draw, "num_members": 5, "batch_size": 32, "num_epochs": 5, "half_precision": True}
    assert {key: found[key] for key in wanted} == wanted


@pytest.mark.parametrize("task", PAPER)
def test_rivals_are_there_as_published_and_at_their_best(task):
    """What they differ in is what their names say."""

    def differences(one, other):
        one, other = (METHODS[name].settings(TASKS[task]) for name in (one, other))
        assert set(one) == set(other)
        return {name: (one[name], other[name]) for name in one if one[name] != other[name]}

    longer = differences("PETS TSinf", "PETS TSinf to its optimum")
    assert longer == {"num_epochs": (5, 300), "patience": (None, 15)}
    for draw in ("MM", "DS"):
        assert differences(f"GP-{draw}", f"GP-{draw} with noise") == {"add_noise": (False, True)}


@pytest.mark.parametrize("task", PAPER)
@pytest.mark.parametrize("draw", ["MM", "DS"])
def test_gps_have_the_papers_inducing_points(draw, task):
    found = METHODS[f"GP-{draw}"].settings(TASKS[task])
    assert (found["draw"], found["num_inducing"]) == (draw, 200)


def test_a_planner_brings_its_own_settings(monkeypatch):
    monkeypatch.setitem(PLANNERS, "random-shooting", RandomShooting)
    method, task = METHODS["DGP-MPC L=2 matern32"], TASKS["ModCartPole-v0"]
    found = method.settings(task, planner="random-shooting", num_candidates=20)
    assert {name: found[name] for name in ("planner", "horizon", "num_candidates")} == {
        "planner": "random-shooting", "horizon": 30, "num_candidates": 20,
    }  # fmt: skip
    assert set(method.settings(task)) - set(found) == {"num_elites", "num_iterations", "smoothing", "min_std"}
    # Where a preset names a planner, its settings do not come along to another one.
    by_icem = replace(method, presets=lambda task: presets.PLANNING[task.preset])
    assert by_icem.settings(task)["noise_beta"] == 1.0 and "noise_beta" not in by_icem.settings(task, planner="cem")
    env = task.make()
    agent = method.make(env, found, seed=0)
    env.close()
    assert isinstance(agent.planner, RandomShooting) and agent.planner.num_candidates == 20
    of_its_own = replace(method, fixed={**method.fixed, "planner": "random-shooting"})
    assert of_its_own.settings(task, num_candidates=20) == found
