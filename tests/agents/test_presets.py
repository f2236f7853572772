"""Settings for tasks: arguments of the agent, for tasks there are, found by the environment's id."""

import importlib
import inspect

import gymnasium
import pytest

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.agents import presets


@pytest.mark.parametrize("env_id", sorted(presets.STOCK))
def test_stock_settings_make_an_agent(env_id):
    settings = presets.STOCK[env_id]
    assert set(settings) <= set(inspect.signature(DGPMPCAgent).parameters)
    if env_id.startswith("Fetch"):
        pytest.importorskip("gymnasium_robotics")
        importlib.import_module("gym_dgpmpc.envs.robotics")
    env = gymnasium.make(env_id)
    agent = DGPMPCAgent(env, **settings, seed=0)
    assert (agent.controller.horizon, agent.planner.num_candidates) == (settings["horizon"], settings["num_candidates"])
    # Plans do not look beyond an episode's end, and what an episode needs to end well is seen before the first one.
    assert settings["horizon"] < env.spec.max_episode_steps
    assert settings["horizon"] <= settings.get("learning_starts", env.spec.max_episode_steps)


def test_settings_are_found_by_id():
    assert presets.settings_for("ModCartPole-v0") is presets.PAPER["ModCartPole-v0"]
    assert presets.settings_for("Pendulum-v1") is presets.STOCK["Pendulum-v1"]
    with_module = "gym_dgpmpc.envs.robotics:FetchReachDense-v4"
    assert presets.settings_for(with_module) is presets.STOCK["FetchReachDense-v4"]
    assert presets.settings_for("ToyPush-v0") == {}
    assert not set(presets.PAPER) & set(presets.STOCK)


@pytest.mark.parametrize(
    ("env_ids", "planning"),
    [
        (["ModCartPole-v0", "SwingUpCartPole-v0"], (30, 5, 1)),
        (["BiasedReacher-v0", "Reacher7DoF-v0"], (20, 5, 1)),
        (["RiskSensitiveHalfCheetah-v0", "VelocityHalfCheetah-v0"], (40, 10, 2)),
    ],
)
def test_planning_is_as_in_the_papers_table(env_ids, planning):
    names = ("horizon", "num_iterations", "actions_per_plan")
    for env_id in env_ids:
        shared = {"num_candidates": 300, "num_elites": 30, "num_particles": 5}
        wanted = dict(zip(names, planning, strict=True)) | shared
        assert presets.PAPER[env_id] == wanted | {"num_inducing": 200}
        assert presets.COMPARISON_GP[env_id] == presets.PAPER[env_id]
        assert {name: presets.COMPARISON_PETS[env_id][name] for name in wanted} == wanted


@pytest.mark.parametrize(
    ("env_ids", "networks", "planning"),
    [
        (["ModCartPole-v0", "SwingUpCartPole-v0"], (3, 500, (1e-4, 2.5e-4, 2.5e-4, 5e-4), 1e-3), (400, 40, 25)),
        (
            ["BiasedReacher-v0", "Reacher7DoF-v0"],
            (4, 200, (2.5e-4, 5e-4, 5e-4, 5e-4, 7.5e-4), 7.5e-4),
            (400, 40, 25),
        ),
        (
            ["RiskSensitiveHalfCheetah-v0", "VelocityHalfCheetah-v0"],
            (4, 200, (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4), 1e-3),
            (500, 50, 30),
        ),
    ],
)
def test_pets_is_as_published(env_ids, networks, planning):
    """Chua et al. (2018), from their configuration files."""
    of_networks = ("num_hidden_layers", "hidden_size", "weight_decay", "learning_rate")
    of_planning = ("num_candidates", "num_elites", "horizon")
    for env_id in env_ids:
        wanted = dict(zip(of_networks, networks, strict=True))
        assert {name: presets.COMPARISON_PETS[env_id][name] for name in of_networks} == wanted
        wanted |= dict(zip(of_planning, planning, strict=True))
        assert presets.PETS[env_id] == wanted | {"num_iterations": 5, "actions_per_plan": 1, "num_particles": 20}
