"""The agents that the paper's is compared with, with their real parts at tiny sizes."""

import inspect

import numpy as np
import pytest
import torch

import gym_dgpmpc
from gym_dgpmpc import GPMPCAgent, MixtureMPCAgent, MPCAgent, PETSAgent
from gym_dgpmpc.agents import presets
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.types import ObservationSpec
from tests.agents.point_mass import LENGTH, KnownPointMass, actions_of

PLANNING = {"horizon": 4, "num_candidates": 30, "num_iterations": 2, "seed": 0}
SMALL_NETWORKS = {"num_hidden_layers": 1, "hidden_size": 8, "weight_decay": (1e-4, 1e-4), "num_epochs": 5}
SMALL_DEEP_GP = {
    "num_inducing": 8, "num_features": 32, "first_training_iterations": 30, "training_iterations": 10, "num_samples": 6,
    "sample_spacing": 2, "resample_samples": 1,
}  # fmt: skip
TINY = {
    PETSAgent: {**SMALL_NETWORKS, "num_particles": 5, **PLANNING},
    GPMPCAgent: {"num_inducing": 8, "max_training_iterations": 10, "num_particles": 4, **PLANNING},
}
TINY[MixtureMPCAgent] = {**presets.for_mixture(SMALL_DEEP_GP, SMALL_NETWORKS), "num_particles": 5, **PLANNING}
AGENTS = list(TINY)
SETTINGS = [
    *((PETSAgent, {"draw": draw}) for draw in ("TS1", "TSinf", "DS", "MM", "expectation")),
    (PETSAgent, {"num_members": 2, "num_particles": 4, "half_precision": True, "num_hidden_layers": 2,
                 "weight_decay": (1e-4, 1e-4, 1e-4), "learning_rate": 1e-2, "actions_per_plan": 2}),
    *((GPMPCAgent, {"draw": draw}) for draw in ("DS", "MM", "AMM")),
    (GPMPCAgent, {"kernel": "matern32", "exact": True, "add_noise": True, "update_within_episode": True}),
    (MixtureMPCAgent, {"members": ("deep-gp", "ensemble")}),
    (MixtureMPCAgent, {"members": ("sparse-gp", "ensemble", "deep-gp"), "sparse_gp_num_inducing": 8, "score_every": 2,
                       "sparse_gp_max_training_iterations": 10,
                       "ensemble_draw": "TS1", "num_particles": 3}),
]  # fmt: skip


def tiny(agent_class, **arguments):
    return agent_class(KnownPointMass(fixed_start=True), **{**TINY[agent_class], **arguments})


@pytest.mark.parametrize(("agent_class", "arguments"), SETTINGS)
def test_it_learns_saves_and_goes_on(agent_class, arguments, tmp_path):
    whole, part = tiny(agent_class, **arguments), tiny(agent_class, **arguments)
    whole.learn(3 * LENGTH)
    part.learn(2 * LENGTH)
    part.save(tmp_path / "part")
    loaded = MPCAgent.load(tmp_path / "part", env=KnownPointMass(fixed_start=True))
    assert type(loaded) is agent_class
    assert {name: getattr(loaded, name) for name in arguments} == arguments
    for observation in np.random.default_rng(0).normal(size=(2, 2)):
        actions = [one.predict(observation, deterministic=True)[0] for one in (part, loaded)]
        np.testing.assert_array_equal(*actions)
    loaded.learn(LENGTH, reset_num_timesteps=False)
    np.testing.assert_array_equal(actions_of(whole.env.envs[0])[2 * LENGTH :], actions_of(loaded.env.envs[0]))


@pytest.mark.parametrize(
    ("agent_class", "arguments"),
    [
        (PETSAgent, {"hidden_size": 32, "num_epochs": 100, "draw": "TS1"}),
        (GPMPCAgent, {"num_inducing": 20, "max_training_iterations": 50, "draw": "MM"}),
        (GPMPCAgent, {"exact": True, "max_training_iterations": 50, "draw": "DS"}),
    ],
)
def test_it_gets_better(agent_class, arguments):
    """Standing still costs 10, a perfect plan about 1.1; the first, random episode costs 5 with this seed."""
    learner = tiny(agent_class, num_candidates=60, num_iterations=3, **arguments)
    learner.learn(4 * LENGTH)
    returns = learner.store.rewards.reshape(4, LENGTH).sum(1)
    assert returns[2:].max() > -1.6


@pytest.mark.parametrize("agent_class", AGENTS)
def test_the_cart_pole_by_its_id(agent_class, tmp_path):
    learner = agent_class("gym_dgpmpc:SwingUpCartPole-v0", **{**TINY[agent_class], "learning_starts": 12})
    learner.learn(15)
    assert learner.observation_spec == ObservationSpec(angles=(1,)) == learner.dynamics.encoder.spec
    learner.save(tmp_path / "agent")
    alone = agent_class.load(tmp_path / "agent", reward_fn=learner.task.functions.reward_fn)
    observation = np.array([0.1, 0.2, 0.3, 0.4])
    expected = learner.predict(observation, deterministic=True)[0]
    np.testing.assert_array_equal(alone.predict(observation, deterministic=True)[0], expected)


@pytest.mark.parametrize(
    ("agent_class", "arguments", "message"),
    [
        (PETSAgent, {"weight_decay": (1e-4,)}, "weight_decay must hold one number"),
        (PETSAgent, {"learning_rate": -1.0}, "learning_rate must be positive, received -1.0"),
        (PETSAgent, {"num_elites": 31}, "num_elites .*31 of 30"),
        (GPMPCAgent, {"draw": "AMM", "num_particles": 3}, "more particles than the 3 numbers .* num_particles = 3"),
        (GPMPCAgent, {"draw": "AMM", "kernel": "matern12"}, "kernel 'rbf' only, received 'matern12'"),
        (GPMPCAgent, {"num_inducing": 0}, "num_inducing must be at least 1, got 0"),
        (GPMPCAgent, {"max_training_iterations": 0}, "max_training_iterations must be at least 1, got 0"),
        (GPMPCAgent, {"horizon": 0}, "horizon.* 0"),
    ],
)
def test_settings_out_of_range_are_named(agent_class, arguments, message):
    with pytest.raises(ValueError, match=message):
        tiny(agent_class, **arguments)


@pytest.mark.parametrize(
    ("agent_class", "other"),
    [
        (PETSAgent, {"hidden_size": 9}),
        (GPMPCAgent, {"num_inducing": 5}),
        (MixtureMPCAgent, {"ensemble_hidden_size": 9}),
    ],
)
def test_a_file_of_other_settings_does_not_load_silently(agent_class, other, tmp_path):
    tiny(agent_class).learn(LENGTH + 2).save(tmp_path / "agent")
    with pytest.raises(CheckpointError, match="does not fit"):
        agent_class.load(tmp_path / "agent", KnownPointMass(), **other)


@pytest.mark.parametrize("name", sorted(presets.PAPER))
def test_presets_are_arguments_and_the_published_ones(name):
    paper = presets.PAPER[name]
    for settings, agent_class in (
        (presets.PETS[name], PETSAgent), (presets.COMPARISON_PETS[name], PETSAgent),
        (presets.COMPARISON_GP[name], GPMPCAgent),
    ):  # fmt: skip
        assert set(settings) <= set(inspect.signature(agent_class).parameters)
        assert agent_class(KnownPointMass(), **settings).planner.num_elites == settings["num_candidates"] // 10
    comparison = presets.COMPARISON_PETS[name]
    for key in ("num_candidates", "num_particles", "horizon", "num_iterations", "num_elites", "actions_per_plan"):
        assert comparison[key] == paper[key]
    published = presets.PETS[name]
    assert (published["num_particles"], published["num_iterations"]) == (20, 5)
    networks = {"CartPole": (3, 500), "Reacher": (4, 200), "HalfCheetah": (4, 200)}
    (expected,) = (value for key, value in networks.items() if key in name)
    assert (published["num_hidden_layers"], published["hidden_size"]) == expected
    assert published["horizon"] == (30 if "HalfCheetah" in name else 25)


def test_the_defaults_of_pets_are_the_published_ones_on_the_cart_pole():
    parameters = inspect.signature(PETSAgent).parameters
    preset = {**presets.PETS["SwingUpCartPole-v0"], "num_elites": None}  # a tenth, which is 40 of 400
    assert {name: parameters[name].default for name in preset} == preset


def test_an_evaluated_run_is_the_run_itself():
    for agent_class in AGENTS:
        alone, watched = tiny(agent_class), tiny(agent_class)
        alone.learn(2 * LENGTH)
        watched.learn(LENGTH + 3)
        before = watched.dynamics.state_dict()
        watched.predict(np.zeros(2))
        for name, value in watched.dynamics.state_dict().items():
            assert torch.equal(value, before[name]) if isinstance(value, torch.Tensor) else value == before[name]
        watched.learn(LENGTH - 3, reset_num_timesteps=False)
        np.testing.assert_array_equal(actions_of(alone.env.envs[0]), actions_of(watched.env.envs[0]))


def test_the_package_exports_them():
    assert {"PETSAgent", "GPMPCAgent", "MixtureMPCAgent"} <= set(dir(gym_dgpmpc))
