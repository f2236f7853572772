"""Settings for tasks: arguments of the agent, for tasks there are, found by the environment's id."""

import importlib
import inspect

import gymnasium
import pytest

from gym_dgpmpc import DGPMPCAgent, GPMPCAgent, MixtureMPCAgent, PETSAgent
from gym_dgpmpc.agents import presets
from gym_dgpmpc.planning import CEM, PLANNERS, GradientAscent
from gym_dgpmpc.settings import settings_of


@pytest.mark.parametrize("env_id", sorted(presets.STOCK))
def test_stock_settings_make_an_agent(env_id):
    settings = presets.STOCK[env_id]
    assert set(settings) <= set(inspect.signature(DGPMPCAgent).parameters)
    if env_id.startswith("Fetch"):
        pytest.importorskip("gymnasium_robotics")
        importlib.import_module("gym_dgpmpc.envs.robotics")
    env = gymnasium.make(env_id)
    agent = DGPMPCAgent(env, **settings, seed=0)
    assert agent.controller.horizon == settings["horizon"]
    assert {name: getattr(agent.planner, name) for name in settings_of(type(agent.planner)) if name in settings} == {
        name: value for name, value in settings.items() if name in settings_of(type(agent.planner))
    }
    # Plans do not look beyond an episode's end, and what an episode needs to end well is seen before the first one.
    assert settings["horizon"] < env.spec.max_episode_steps
    assert settings["horizon"] <= settings.get("learning_starts", env.spec.max_episode_steps)


def test_settings_are_found_by_id():
    for env_id in ("ModCartPole-v0", "SwingUpCartPole-v0"):
        assert presets.settings_for(env_id) == {**presets.PAPER[env_id], **presets.PLANNING[env_id]}
    assert presets.settings_for("Pendulum-v1") == {**presets.STOCK["Pendulum-v1"], "kernel": "rbf"}
    half_cheetah = presets.settings_for("VelocityHalfCheetah-v0")
    own = {"linear": True, "first_training_iterations": 300}
    assert half_cheetah == {**presets.PAPER["VelocityHalfCheetah-v0"], **own}
    with_module = "gym_dgpmpc.envs.robotics:FetchReachDense-v4"
    assert presets.settings_for(with_module) == presets.STOCK["FetchReachDense-v4"]
    assert presets.settings_for("ToyPush-v0") == presets.settings_for() == presets.OWN_TASK
    # What another planner has no use for is left out.
    reacher = presets.PAPER["BiasedReacher-v0"]
    of_sampling = {name: reacher[name] for name in ("num_candidates", "num_elites")}
    climbing = {name: value for name, value in reacher.items() if name not in of_sampling} | {"planner": "gradient"}
    assert presets.settings_for("BiasedReacher-v0") == climbing
    assert presets.settings_for("BiasedReacher-v0", "icem") == {**reacher, "planner": "icem"}
    assert presets.settings_for("ToyPush-v0", "mppi") == {**presets.OWN_TASK, "planner": "mppi"}
    without_colour = {name: value for name, value in presets.OWN_TASK.items() if name != "noise_beta"}
    assert presets.settings_for(planner="cem") == {**without_colour, "planner": "cem"}
    with pytest.raises(ValueError, match="unknown planner 'best'"):
        presets.settings_for("ToyPush-v0", "best")
    assert not set(presets.PAPER) & set(presets.STOCK)


@pytest.mark.parametrize("of", [presets.settings_for, presets.mixture_settings_for, presets.policy_search_settings_for])
def test_an_id_without_a_version_has_the_settings_of_the_newest(of):
    """As `gymnasium.make` has the environment, so that a run does not go without them unnoticed."""
    assert of("ModCartPole") == of("gym_dgpmpc:ModCartPole") == of("ModCartPole-v0") != {}
    assert of("ModCartPol") == of("ModCartPole-v9")


def test_a_mixture_has_the_presets_of_its_members():
    """Each under its member's name; what is the planner's is the planner's."""
    own = presets.NETWORKS["VelocityHalfCheetah-v0"]
    assert presets.mixture_settings_for("VelocityHalfCheetah-v0") == {
        **presets.PAPER["VelocityHalfCheetah-v0"], "deep_gp_linear": True, "deep_gp_first_training_iterations": 300,
        **{f"ensemble_{name}": value for name, value in own.items()},
    }  # fmt: skip
    stock = dict(presets.STOCK["FetchReachDense-v4"])
    members = {f"deep_gp_{name}": stock.pop(name) for name in ("num_layers", "num_inducing")}
    with_module = "gym_dgpmpc.envs.robotics:FetchReachDense-v4"
    assert presets.mixture_settings_for(with_module) == {**stock, **members}
    for env_id in ("ModCartPole-v0", "Pendulum-v1", "BiasedReacher-v0"):
        agent = MixtureMPCAgent(gymnasium.make(env_id), **presets.mixture_settings_for(env_id), seed=0)
        alone = DGPMPCAgent(gymnasium.make(env_id), **presets.settings_for(env_id), seed=0)
        # Networks have fresh noise at each call, with which one does not climb by L-BFGS.
        planner = CEM if isinstance(alone.planner, GradientAscent) else type(alone.planner)
        assert type(agent.planner) is planner and agent.horizon == alone.horizon
        assert agent.dynamics.models["deep-gp"].kernel is alone.dynamics.kernel


TABLES = {
    "paper": (DGPMPCAgent, presets.PAPER),
    "published PETS": (PETSAgent, presets.PETS),
    "PETS in the comparison": (PETSAgent, presets.COMPARISON_PETS),
    "GP in the comparison": (GPMPCAgent, presets.COMPARISON_GP),
}
PLANNING = ("horizon", "num_candidates", "num_elites", "num_iterations", "actions_per_plan", "num_particles")


@pytest.mark.parametrize(("table", "env_id"), [(table, env_id) for table in TABLES for env_id in presets.PAPER])
def test_settings_make_an_agent_that_plans_with_them(table, env_id):
    agent_class, settings = TABLES[table][0], TABLES[table][1][env_id]
    agent = agent_class(gymnasium.make(env_id), **settings, seed=0)
    planner, controller = agent.planner, agent.controller
    found = {name: getattr(planner if hasattr(planner, name) else controller, name) for name in PLANNING}
    assert found == {name: settings[name] for name in PLANNING}
    # Both papers fit the Gaussian to a tenth of the sequences, and look ahead for a part of an episode.
    assert 10 * planner.num_elites == planner.num_candidates
    assert planner.horizon < gymnasium.spec(env_id).max_episode_steps


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("ModCartPole-v0", "SwingUpCartPole-v0"),
        ("BiasedReacher-v0", "Reacher7DoF-v0"),
        ("RiskSensitiveHalfCheetah-v0", "VelocityHalfCheetah-v0"),
    ],
)
def test_variants_of_a_task_share_their_settings(one, other):
    for _, table in TABLES.values():
        assert table[one] == table[other]


@pytest.mark.parametrize("env_id", presets.PAPER)
def test_the_comparison_gives_all_methods_the_same_plans(env_id):
    """The models are compared, so only they differ; of PETS's, each network moves one particle."""
    paper, pets = presets.PAPER[env_id], presets.COMPARISON_PETS[env_id]
    assert {name: pets[name] for name in PLANNING} == {name: paper[name] for name in PLANNING}
    assert pets["num_particles"] == PETSAgent(gymnasium.make(env_id), **pets, seed=0).dynamics.num_members
    assert presets.COMPARISON_GP[env_id] == {**paper, "num_inducing": 200}
    networks = pets.keys() - set(PLANNING)
    assert networks and all(pets[name] == presets.PETS[env_id][name] for name in networks)


@pytest.mark.parametrize(
    ("task", "planned"),
    [("ModCartPole-v0", (30, 5, 1)), ("BiasedReacher-v0", (20, 5, 1)), ("RiskSensitiveHalfCheetah-v0", (40, 10, 2))],
)
def test_the_papers_plans_are_those_of_its_table(task, planned):
    """Gadd et al. (2020), supplement: horizon, iterations and actions per plan; 300 sequences, 5 particles.

    Its 200 inducing points are kept for the Gaussian process alone.
    """
    settings = presets.PAPER[task]
    assert (settings["horizon"], settings["num_iterations"], settings["actions_per_plan"]) == planned
    assert (settings["num_candidates"], settings["num_particles"]) == (300, 5)
    assert "num_inducing" not in settings and presets.COMPARISON_GP[task]["num_inducing"] == 200


@pytest.mark.parametrize("env_id", ["ModCartPole-v0", "SwingUpCartPole-v0"])
@pytest.mark.parametrize(
    ("agent_class", "table"),
    [(DGPMPCAgent, presets.PAPER), (PETSAgent, presets.COMPARISON_PETS), (GPMPCAgent, presets.COMPARISON_GP)],
)
def test_better_planning_is_for_every_model(env_id, agent_class, table):
    better = presets.PLANNING[env_id]
    agent = agent_class(gymnasium.make(env_id), **{**table[env_id], **better}, seed=0)
    assert isinstance(agent.planner, PLANNERS[better["planner"]])
    assert (agent.planner.noise_beta, agent.exploration) == (better["noise_beta"], better["exploration"])
