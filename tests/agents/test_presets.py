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
    assert (agent.planning.horizon, agent.planner.num_candidates) == (settings["horizon"], settings["num_candidates"])
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
