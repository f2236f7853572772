"""The paper's agent with its real parts, at a tiny size."""

import inspect

import numpy as np
import pytest
import torch

import gym_dgpmpc
from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.agents import presets
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.types import ObservationSpec
from tests.agents.point_mass import LENGTH, KnownPointMass, actions_of

TINY = {
    "num_inducing": 8,
    "num_features": 32,
    "first_training_iterations": 30,
    "training_iterations": 10,
    "num_samples": 6,
    "sample_spacing": 2,
    "resample_samples": 1,
    "num_particles": 3,
    "horizon": 4,
    "num_candidates": 30,
    "num_iterations": 2,
    "seed": 0,
}


def tiny(**arguments):
    return DGPMPCAgent(KnownPointMass(fixed_start=True), **{**TINY, **arguments})


@pytest.mark.parametrize(
    "arguments",
    [
        {"num_layers": 1},
        {"num_layers": 2, "refresh": "plan", "actions_per_plan": 2},
        {"num_layers": 2, "draw": "joint", "kernel": "rbf"},
        {"num_layers": 3, "draw": "marginal", "kernel": "matern12"},
    ],
)
def test_it_learns_saves_and_goes_on(arguments, tmp_path):
    whole, part = tiny(**arguments), tiny(**arguments)
    whole.learn(3 * LENGTH)
    part.learn(2 * LENGTH)
    part.save(tmp_path / "part")
    loaded = DGPMPCAgent.load(tmp_path / "part", env=KnownPointMass(fixed_start=True))
    assert {name: getattr(loaded, name) for name in arguments} == arguments
    for key, value in part.dynamics.state_dict().items():
        restored = loaded.dynamics.state_dict()[key]
        assert torch.equal(value, restored) if isinstance(value, torch.Tensor) else value == restored
    for observation in np.random.default_rng(0).normal(size=(3, 2)):
        actions = [one.predict(observation, deterministic=True)[0] for one in (part, loaded)]
        np.testing.assert_array_equal(*actions)
    loaded.learn(LENGTH, reset_num_timesteps=False)
    np.testing.assert_array_equal(actions_of(whole.env.envs[0])[2 * LENGTH :], actions_of(loaded.env.envs[0]))


def test_it_gets_better():
    """Standing still costs 10, a perfect plan about 1.1; the first, random episode costs 5 with this seed."""
    sizes = {"num_inducing": 20, "num_features": 128, "num_candidates": 60, "num_iterations": 3}
    learner = tiny(**sizes, first_training_iterations=1000, training_iterations=300)
    learner.learn(4 * LENGTH)
    returns = learner.store.rewards.reshape(4, LENGTH).sum(1)
    assert returns[2:].max() > -1.6


def test_an_evaluated_run_is_the_run_itself():
    alone, watched = tiny(), tiny()
    alone.learn(2 * LENGTH + 5)
    learned = []

    def watch(locals_, globals_):
        if watched.is_fitted:
            learned.append(watched.predict(np.zeros(2), deterministic=len(learned) % 2 == 0))
        return True

    watched.learn(2 * LENGTH + 5, callback=watch)
    assert learned
    np.testing.assert_array_equal(actions_of(alone.env.envs[0]), actions_of(watched.env.envs[0]))


@pytest.mark.parametrize("name", ["ModCartPole-v0", "gym_dgpmpc:SwingUpCartPole-v0"])
def test_the_cart_pole_by_its_id(name, tmp_path):
    learner = DGPMPCAgent(name, **{**TINY, "learning_starts": 12})
    learner.learn(15)
    assert learner.observation_spec.angles == (1,)
    learner.save(tmp_path / "agent")
    alone = MPCAgent.load(tmp_path / "agent", reward_fn=learner.task.functions.reward_fn)
    assert type(alone) is DGPMPCAgent
    assert alone.observation_spec == learner.observation_spec
    observation = np.array([0.1, 0.2, 0.3, 0.4])
    expected = learner.predict(observation, deterministic=True)[0]
    np.testing.assert_array_equal(alone.predict(observation, deterministic=True)[0], expected)


def test_a_given_observation_spec_is_kept(tmp_path):
    spec = ObservationSpec(angles=(0,), absolute=(1,))
    learner = tiny(observation_spec=spec)
    learner.save(tmp_path / "agent")
    assert learner.dynamics.encoder.spec == spec
    assert DGPMPCAgent.load(tmp_path / "agent", KnownPointMass()).dynamics.encoder.spec == spec


def test_an_observation_spec_with_vectors_survives_a_file(tmp_path):
    settings = {**TINY, "learning_starts": 20}
    learner = DGPMPCAgent("Swimmer-v5", **settings)
    assert learner.observation_spec.body_frame == ((0, 3, 4),)
    learner.save(tmp_path / "agent")
    assert DGPMPCAgent.load(tmp_path / "agent").observation_spec == learner.observation_spec


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kernel": "cubic"}, "cubic"),
        ({"num_layers": 0}, "num_layers.* 0"),
        ({"horizon": 0}, "horizon.* 0"),
        ({"num_elites": 31}, "num_elites .*31 of 30"),
        ({"num_inducing": 0}, "num_inducing.* 0"),
        ({"actions_per_plan": 5}, "actions_per_plan .*horizon 4, got 5"),
        ({"observation_spec": ObservationSpec(angles=(7,))}, r"angles.*\(7,\)"),
    ],
)
def test_settings_out_of_range_are_named(arguments, message, unchecked):
    with pytest.raises(ValueError, match=message):
        tiny(**arguments)


@pytest.mark.parametrize("arguments", [{"draw": "sideways"}, {"refresh": "never"}])
def test_unknown_draws_are_named(arguments, unchecked):
    with pytest.raises(ValueError, match=next(iter(arguments.values()))):
        tiny(**arguments)


def test_a_file_of_other_settings_does_not_load_silently(tmp_path):
    tiny().learn(LENGTH + 2).save(tmp_path / "agent")
    with pytest.raises(CheckpointError, match="does not fit"):
        DGPMPCAgent.load(tmp_path / "agent", KnownPointMass(), num_inducing=9)


@pytest.mark.parametrize("name", sorted(presets.PAPER))
def test_presets_are_arguments_and_the_papers(name):
    settings = presets.PAPER[name]
    assert set(settings) <= set(inspect.signature(DGPMPCAgent).parameters)
    assert (settings["num_candidates"], settings["num_particles"]) == (300, 5)
    assert settings["num_elites"] == 30
    assert DGPMPCAgent(KnownPointMass(), **settings).planner.num_elites == 30


def test_the_defaults_are_the_papers_on_the_cart_pole():
    parameters = inspect.signature(DGPMPCAgent).parameters
    preset = {**presets.PAPER["ModCartPole-v0"], "num_elites": None}  # a tenth, which is 30 of 300
    assert {name: parameters[name].default for name in preset} == preset


def test_the_package_exports_the_agents():
    assert {"DGPMPCAgent", "MPCAgent"} <= set(dir(gym_dgpmpc))
