"""What is said of an agent's file is what the agent has; and is said too of one that cannot be made here."""

import json

import gymnasium
import numpy as np
import pytest
import torch

from gym_dgpmpc import DGPMPCAgent, MixtureMPCAgent, MPCAgent, PETSAgent
from gym_dgpmpc.agents.composition import model_settings
from gym_dgpmpc.checkpoints.format import SCHEMA, read_checkpoint, write_checkpoint
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.runs.inspection import inspect_agent, inspect_run
from gym_dgpmpc.types import ReportsDiagnostics
from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT, ToyPush, ToyPushWithoutReward


@pytest.fixture(scope="module")
def agent():
    """With 30 transitions of three episodes, of which the last runs, after two trainings."""
    agent = DGPMPCAgent("ToyPush-v0", **{**SMALLEST_AGENT, "num_samples": 20, "num_chains": 2}, seed=0, verbose=0)
    return agent.learn(2 * EPISODE_STEPS + 6)


def inspected(agent, tmp_path):
    agent.save(tmp_path / "a.zip")
    content = inspect_agent(tmp_path / "a.zip")
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    return content


def test_what_is_said_is_what_the_agent_has(agent, tmp_path):
    content = inspected(agent, tmp_path)
    assert (content["class"], content["environment"], content["num_envs"]) == (
        "DGPMPCAgent", "tests.runs.toy:ToyPush-v0", 1,
    )  # fmt: skip
    assert content["schema"] == SCHEMA
    assert content["bytes"] == (tmp_path / "a.zip").stat().st_size
    observation, action = content["spaces"]["observation"], content["spaces"]["action"]
    for said, space in ((observation, agent.observation_space), (action, agent.action_space)):
        assert said["shape"] == list(space.shape)
        np.testing.assert_array_equal(np.array(said["low"], dtype=float), space.low)
        np.testing.assert_array_equal(np.array(said["high"], dtype=float), space.high)
    assert content["data"] == {
        "num_transitions": 30,
        "num_episodes": 3,
        "shortest_episode": 6,
        "longest_episode": 12,
        "num_terminated": 0,
        "mean_reward": pytest.approx(float(agent.store.rewards.double().mean()), rel=1e-12),
    }
    assert content["training"] == {
        "num_timesteps": 30, "num_learned": 24, "num_not_learned": 6, "steps_of_running_episode": 6,
    }  # fmt: skip
    assert content["diagnostics"] == dict(agent.dynamics.diagnostics())
    assert content["versions"]["torch"] == torch.__version__


def test_settings_that_differ_are_marked(agent, tmp_path):
    settings = inspected(agent, tmp_path)["settings"]
    own = {name: each.default for name, each in DGPMPCAgent.saved_settings("cem").items()}
    assert set(settings) == {"planner", *own} - {"observation_spec"}
    asked = {**SMALLEST_AGENT, "num_samples": 20, "num_chains": 2, "seed": 0}
    assert {name for name, each in settings.items() if each["differs"]} == set(asked)
    for name, each in settings.items():
        assert each["value"] == asked.get(name, "cem" if name == "planner" else own[name])
        assert each["default"] == ("cem" if name == "planner" else own[name])


def test_defaults_of_an_agent_are_its_own(tmp_path):
    """PETS plans with other numbers than CEM's own."""
    agent = PETSAgent("ToyPush-v0", seed=0)
    settings = inspected(agent, tmp_path)["settings"]
    assert PETSAgent.part_defaults
    for name, value in PETSAgent.part_defaults.items():
        assert settings[name] == {"value": value, "default": value, "differs": False}


def test_where_reward_and_termination_come_from(tmp_path):
    def said(env, **arguments):
        content = inspected(DGPMPCAgent(env, **SMALLEST_AGENT, seed=0, **arguments), tmp_path)
        return content["reward"], content["termination"]

    at_once = "learned, once an episode has terminated"
    assert said(ToyPush()) == ("the environment's", at_once)
    assert said(ToyPushWithoutReward(), terminated_fn="never") == ("learned", "never")
    given = {"reward_fn": ToyPush.reward_fn, "terminated_fn": lambda state: state[..., 0] > 5}
    assert said(ToyPush(), **given) == ("given", "given")
    assert said("ModCartPole-v0") == ("the environment's", "never")
    assert said("Pendulum-v1")[0] == "known"
    ended = DGPMPCAgent(ToyPush(terminate_at=5), **SMALLEST_AGENT, seed=0).learn(8)
    assert inspected(ended, tmp_path)["termination"] == "learned"


def test_a_file_that_was_loaded_without_its_environment_says_the_same(agent, tmp_path):
    before = inspected(agent, tmp_path)
    again = inspected(MPCAgent.load(tmp_path / "a.zip"), tmp_path)
    for name in ("reward", "termination", "environment", "spaces", "settings", "data", "diagnostics"):
        assert again[name] == before[name]


def test_older_files_do_not_say_whose_a_function_is(agent, tmp_path):
    agent.save(tmp_path / "a.zip")
    checkpoint = read_checkpoint(tmp_path / "a.zip")
    task = checkpoint.config["values"]["task"]
    del task["sources"]
    write_checkpoint(checkpoint, tmp_path / "a.zip")
    content = inspect_agent(tmp_path / "a.zip")
    assert content["reward"].startswith("a function")
    assert content["termination"].startswith("never, or learned")
    task["has_terminated_fn"], task["reward"] = True, True
    write_checkpoint(checkpoint, tmp_path / "a.zip")
    content = inspect_agent(tmp_path / "a.zip")
    assert content["reward"] == "learned"
    assert content["termination"].startswith("a function")


def test_an_agent_that_cannot_be_made_here_is_looked_into(agent, tmp_path):
    agent.save(tmp_path / "a.zip")
    checkpoint = read_checkpoint(tmp_path / "a.zip")
    checkpoint.config["class"] = "MineAlone"
    write_checkpoint(checkpoint, tmp_path / "a.zip")
    content = inspect_agent(tmp_path / "a.zip")
    assert content["class"] == "MineAlone"
    assert content["data"]["num_transitions"] == 30
    assert content["settings"]["num_layers"] == {"value": 1, "default": None, "differs": None}
    assert content["diagnostics"] == {}
    assert "MineAlone" in content["diagnostics_missing"]


def test_a_model_of_the_users_is_not_asked(tmp_path):
    env = gymnasium.make("ModCartPole-v0")
    agent = MPCAgent(env, dynamics=TrueDynamics(env), planner="cem", horizon=3, seed=0)
    content = inspected(agent, tmp_path)
    assert content["settings"]["horizon"] == {"value": 3, "default": 30, "differs": True}
    assert content["diagnostics_missing"]


def test_every_member_of_a_mixture_says_how_it_is_fitted(tmp_path):
    sizes = {name: value for name, value in SMALLEST_AGENT.items() if name not in model_settings(DGPMPCAgent.made_of())}
    deep = {f"deep_gp_{name}": value for name, value in SMALLEST_AGENT.items() if name not in sizes}
    agent = MixtureMPCAgent("ToyPush-v0", **sizes, **deep, ensemble_num_epochs=1, seed=0)
    assert isinstance(agent.dynamics, ReportsDiagnostics)
    assert inspected(agent, tmp_path)["diagnostics"] == {}
    said = inspected(agent.learn(EPISODE_STEPS + 1), tmp_path)["diagnostics"]
    assert said["deep_gp_weight"] + said["ensemble_weight"] == pytest.approx(1.0)
    assert said["deep_gp_noise_std"] == agent.dynamics.models["deep-gp"].diagnostics()["noise_std"]


def test_what_is_no_agents_file_is_refused(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"text")
    with pytest.raises(CheckpointError, match=r"a\.zip"):
        inspect_agent(tmp_path / "a.zip")
    assert inspect_run(tmp_path) == {}
