"""How agents are made: settings with one source, planners by name or object, Stable-Baselines3's order of arguments."""

import inspect
from typing import get_args

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import BasePolicy

from gym_dgpmpc import DGPMPCAgent, GPMPCAgent, MixtureMPCAgent, MPCAgent, PETSAgent
from gym_dgpmpc.agents.presets import for_mixture
from gym_dgpmpc.checkpoints.format import read_checkpoint
from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.planning import CEM, PLANNERS, register_planner
from gym_dgpmpc.planning.registry import PlannerName
from gym_dgpmpc.planning.risk import RiskMeasure
from gym_dgpmpc.settings import argument_texts, settings_of
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, PointMass, agent, planner
from tests.agents.test_dgp_mpc import TINY
from tests.checkpoints.common import changed, load
from tests.planning.toy_planners import RandomShooting

NAMED = (DGPMPCAgent, GPMPCAgent, MixtureMPCAgent, PETSAgent)
NOT_SAVED = {
    "policy",
    "env",
    "reward_fn",
    "terminated_fn",
    "first_controller",
    "device",
    "compile",
    "deep_gp_compile",
    "dynamics",
    "settings",
}


@pytest.fixture
def shooting(monkeypatch):
    """A planner that somebody registered."""
    monkeypatch.setattr("gym_dgpmpc.planning.registry.PLANNERS", PLANNERS)
    register_planner("shooting", RandomShooting)
    yield "shooting"
    del PLANNERS["shooting"]


@pytest.mark.parametrize("agent_class", [*NAMED, MPCAgent])
def test_every_argument_is_documented_and_every_plain_one_saved(agent_class):
    public = [name for name in inspect.signature(agent_class).parameters if not name.startswith("_")]
    texts = argument_texts(inspect.cleandoc(agent_class.__doc__))
    assert [name for name in public if not texts.get(name)] in ([], ["settings"])
    plain_agent = agent_class is MPCAgent
    assert set(public) - set(agent_class.saved_settings("cem")) - {"planner"} <= NOT_SAVED
    assert plain_agent or set(agent_class.saved_settings("cem")) <= set(public)


@pytest.mark.parametrize("agent_class", NAMED)
def test_signature_documentation_and_file_follow_the_parts(agent_class, tmp_path):
    """A setting of the model or of the planner is an argument, an attribute and in the file, named nowhere else."""
    parts = {**settings_of(agent_class.dynamics_class), **settings_of(CEM)}
    parameters = inspect.signature(agent_class).parameters
    made = agent_class(KnownPointMass(), seed=0)
    made.save(tmp_path / "agent")
    saved = read_checkpoint(tmp_path / "agent").config["arguments"]
    for name, setting in parts.items():
        default = agent_class.part_defaults.get(name, setting.default)
        assert parameters[name].default == default
        assert made.settings[name] == getattr(made, name) == default
        assert (name in saved) == setting.is_saved
        if name != "learning_rate":  # Stable-Baselines3's own attribute
            with pytest.raises(AttributeError):
                setattr(made, name, default)


def test_a_new_setting_is_one_edit_of_its_part(tmp_path):
    class WithNewSetting(LinearModel):
        """A model.

        Args:
            sharpness: how sharp.
        """

        def __init__(self, observation_size, action_size, observation_spec, *, sharpness: float = 0.5, device="cpu"):
            super().__init__()
            self.sharpness = sharpness

    class Agent(MPCAgent):
        """Made of it."""

        dynamics_class = WithNewSetting

    assert inspect.signature(Agent).parameters["sharpness"].default == 0.5
    assert "sharpness: how sharp." in Agent.__doc__
    made = Agent(KnownPointMass(), sharpness=0.25, horizon=4, seed=0).learn(LENGTH + 2)
    assert made.dynamics.sharpness == made.sharpness == 0.25
    made.save(tmp_path / "agent")
    loaded = Agent.load(tmp_path / "agent", env=KnownPointMass())
    assert loaded.dynamics.sharpness == 0.25
    # A file from before there was such a setting has its default.
    checkpoint = read_checkpoint(tmp_path / "agent")
    del checkpoint.config["arguments"]["sharpness"]
    from gym_dgpmpc.checkpoints.format import write_checkpoint

    write_checkpoint(checkpoint, tmp_path / "older")
    assert Agent.load(tmp_path / "older", env=KnownPointMass()).sharpness == 0.5


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        ({"num_candidate": 3}, "num_candidate'.*num_candidates"),
        ({"iterations": 3}, "iterations"),
        ({"dynamics": LinearModel()}, "LinearModel"),
    ],
)
def test_what_a_named_agent_does_not_take_is_named(arguments, value):
    with pytest.raises(TypeError, match=f"DGPMPCAgent.*{value}"):
        DGPMPCAgent(KnownPointMass(), **arguments)


@pytest.mark.parametrize("policy", ["MPCPolicy", "MlpPolicy"])
def test_the_order_of_stable_baselines3(policy):
    env = KnownPointMass()
    plain = agent(KnownPointMass())
    for made in (
        MPCAgent(policy, env, LinearModel(), planner(), seed=0),
        MPCAgent(policy=policy, env=env, dynamics=LinearModel(), planner=planner(), seed=0),
        MPCAgent(env=env, dynamics=LinearModel(), planner=planner(), seed=0),
        MPCAgent(type(plain.policy), env, dynamics=LinearModel(), planner=planner(), seed=0),
    ):
        assert made.get_env().envs[0].unwrapped is env
        assert isinstance(made.policy, BasePolicy)
    gym.register("PointMassOfTheTests-v0", KnownPointMass, max_episode_steps=LENGTH)
    assert DGPMPCAgent(policy, "PointMassOfTheTests-v0", **TINY).observation_space.shape == (2,)
    assert DGPMPCAgent("PointMassOfTheTests-v0", **TINY).observation_space.shape == (2,)


@pytest.mark.parametrize(
    ("args", "arguments", "error", "value"),
    [
        ((), {}, TypeError, "env"),
        ((1, 2, 3, 4, 5), {}, TypeError, "5"),
        (("FooPolicy", "Pendulum-v1"), {}, ValueError, "FooPolicy"),
        (("MPCPolicy", "Pendulum-v1"), {"env": "Pendulum-v1"}, TypeError, "Pendulum-v1"),
    ],
)
def test_calls_that_do_not_say_what_is_meant(args, arguments, error, value):
    with pytest.raises(error, match=value):
        MPCAgent(*args, **arguments)


def test_the_policy_is_one_of_stable_baselines3s(unchecked):
    learner = agent().learn(2 * LENGTH)
    observation = np.array([0.5, 0.1])
    action, _ = learner.predict(observation, deterministic=True)
    again, _ = learner.policy.predict(observation, deterministic=True)
    np.testing.assert_array_equal(action, again)
    np.testing.assert_array_equal(
        learner.policy._predict(torch.as_tensor(observation[None]), deterministic=True).numpy(), action[None]
    )
    mean, _ = evaluate_policy(learner.policy, learner.get_env(), n_eval_episodes=1)
    assert np.isfinite(mean)
    with pytest.raises(ValueError, match="tuple of 2"):
        learner.predict(KnownPointMass().reset())


def test_callbacks_see_what_stable_baselines3s_algorithms_show():
    seen = []

    class Look(BaseCallback):
        def _on_step(self):
            seen.append({name: self.locals[name] for name in ("new_obs", "rewards", "dones", "infos", "actions")})
            return True

    learner = agent()
    learner.learn(LENGTH - 1, Look())
    np.testing.assert_array_equal(
        seen[0]["new_obs"][0].astype(np.float32), learner.store.transitions().next_observation[0]
    )
    assert all(len(each["infos"]) == len(each["dones"]) == 1 for each in seen)


@pytest.mark.parametrize("agent_class", NAMED)
def test_any_planner_by_name(agent_class, shooting, tmp_path):
    """Its settings are arguments and are saved; those of CEM are unknown then."""
    sizes = {
        DGPMPCAgent: TINY, MixtureMPCAgent: for_mixture(TINY, {"hidden_size": 8, "num_epochs": 5}),
    }.get(agent_class, {"learning_starts": LENGTH, "num_particles": 5, "seed": 0})  # fmt: skip
    sizes = {name: value for name, value in sizes.items() if name not in settings_of(CEM)}
    made = agent_class(KnownPointMass(), planner=shooting, horizon=3, num_candidates=7, **sizes).learn(LENGTH + 2)
    assert isinstance(made.planner, RandomShooting) and made.controller.horizon == 3
    _, state = made.predict(np.zeros(2))
    assert [array.shape for array in state] == [(1, 3, 1), (1,)]
    made.save(tmp_path / "agent")
    loaded = agent_class.load(tmp_path / "agent", env=KnownPointMass())
    np.testing.assert_array_equal(*(each.predict(np.ones(2), deterministic=True)[0] for each in (made, loaded)))
    with pytest.raises(TypeError, match="smoothing"):
        agent_class(KnownPointMass(), planner=shooting, smoothing=0.5)
    with pytest.raises(ValueError, match="simplex"):
        agent_class(KnownPointMass(), planner="simplex")


def test_a_file_whose_planner_is_not_registered_says_so(shooting, tmp_path):
    DGPMPCAgent(KnownPointMass(), planner=shooting, horizon=3).save(tmp_path / "agent")
    register_planner("other", RandomShooting)
    factory = PLANNERS.pop("shooting")
    try:
        with pytest.raises(CheckpointError, match=r"shooting.*register_planner"):
            DGPMPCAgent.load(tmp_path / "agent", env=KnownPointMass())
        loaded = DGPMPCAgent.load(tmp_path / "agent", env=KnownPointMass(), planner="other")
        assert loaded.composition.planner_name == "other" and loaded.horizon == 3
    finally:
        PLANNERS["shooting"] = factory
        del PLANNERS["other"]


def test_a_ready_made_planner_has_its_settings():
    made = DGPMPCAgent(
        KnownPointMass(), planner=planner(horizon=4), **{k: v for k, v in TINY.items() if k not in settings_of(CEM)}
    )
    assert made.controller.horizon == 4
    with pytest.raises(TypeError, match="num_candidates"):
        DGPMPCAgent(KnownPointMass(), planner=planner(), num_candidates=5)


def test_planning_has_one_owner(tmp_path):
    """What is set on the agent is what is planned with, and what is saved."""
    learner = agent().learn(LENGTH + 2)
    learner.time_budget, learner.num_particles, learner.actions_per_plan = 1e-9, 7, 2
    assert learner.controller.time_budget == 1e-9
    drawn = []
    draw = learner.dynamics.draw
    learner.dynamics.draw = lambda num_particles, *rest: drawn.append(num_particles) or draw(num_particles, *rest)
    with pytest.warns(UserWarning, match="1e-09"):
        learner.predict(np.zeros(2))
    assert drawn == [7] and learner.num_late_plans == 1
    learner.save(tmp_path / "agent")
    arguments = read_checkpoint(tmp_path / "agent").config["arguments"]
    assert {name: arguments[name] for name in ("time_budget", "num_particles", "actions_per_plan")} == {
        "time_budget": 1e-9, "num_particles": 7, "actions_per_plan": 2,
    }  # fmt: skip
    for name, value in (("time_budget", -1.0), ("num_particles", 0), ("actions_per_plan", 6)):
        with pytest.raises(ValueError, match=f"{name}.*{value}"):
            setattr(learner, name, value)


def test_risk_is_a_setting_of_every_agent(tmp_path, unchecked):
    learner = agent(risk="cvar", cvar_share=0.4).learn(LENGTH + 2)
    assert learner.controller.measure == RiskMeasure("cvar", 1.0, 0.4)
    learner.risk, learner.risk_aversion = "mean-std", 2.0
    learner.save(tmp_path / "agent")
    loaded = load(tmp_path / "agent")
    assert (loaded.risk, loaded.risk_aversion, loaded.cvar_share) == ("mean-std", 2.0, 0.4)
    np.testing.assert_array_equal(*(each.predict(np.ones(2), deterministic=True)[0] for each in (learner, loaded)))
    with pytest.raises(ValueError, match="median"):
        learner.risk = "median"
    with pytest.raises(ValueError, match=r"cvar_share .*2"):
        agent(cvar_share=2.0)
    changed(tmp_path / "agent.zip", tmp_path / "bad.zip", lambda c, t: c["arguments"].update(risk="os.system"))
    with pytest.raises(CheckpointError, match=r"os\.system"):
        load(tmp_path / "bad.zip")


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("agent_class", [*NAMED, MPCAgent])
def test_every_planner_fits_every_agent(agent_class, name):
    """None of its settings has the name of one of the agent or of its model."""
    assert {"horizon", "num_iterations"} <= set(agent_class.saved_settings(name))
    assert set(get_args(PlannerName)) == set(PLANNERS)


def test_a_learning_rate_may_be_a_constant_schedule():
    """As Stable-Baselines3's algorithms take them; another one would be ignored, and is refused."""
    assert PETSAgent(PointMass(), learning_rate=lambda remaining: 0.02).settings["learning_rate"] == 0.02
    with pytest.raises(ValueError, match=r"learning_rate must be .* got one from 0\.02 over 0\.01 to 0\.0"):
        PETSAgent(PointMass(), learning_rate=lambda remaining: 0.02 * remaining)
