"""Class and arguments in a file: replaced where that is asked for, checked by the limits of the part that has them."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.errors import CheckpointError, CheckpointWriteError
from gym_dgpmpc.planning import CEM, registry
from gym_dgpmpc.settings import settings_of
from gym_dgpmpc.types import PlanInfo
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, agent, planner
from tests.checkpoints.common import changed, load
from tests.planning.toy_planners import RandomShooting
from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT


def test_arguments_can_be_replaced(saved):
    other = load(saved, num_particles=9, verbose=0)
    assert other.num_particles == 9
    assert load(saved).num_particles == 5
    reseeded = load(saved, seed=77)
    assert reseeded.seed == 77
    assert not torch.equal(reseeded.generators.planning.get_state(), load(saved).generators.planning.get_state())
    with pytest.raises(CheckpointError, match="no_such_argument"):
        load(saved, no_such_argument=1)


@pytest.mark.parametrize("replaced", [{"planner": planner(horizon=7)}, {"actions_per_plan": 1}])
def test_a_plan_that_no_longer_fits_begins_anew(replaced, saved):
    assert load(saved).collector.running[0].carried.age == 1
    replaced = {"env": KnownPointMass(), "dynamics": LinearModel(), "planner": planner(), **replaced}
    loaded = MPCAgent.load(saved, **replaced)
    assert loaded.collector.running[0].carried is loaded.controller.cold
    assert loaded.learn(LENGTH, reset_num_timesteps=False).num_timesteps == 25 + LENGTH


def test_an_agent_that_could_not_be_loaded_again_is_not_saved(tmp_path):
    larger = agent(num_particles=20_000)
    with pytest.raises(CheckpointWriteError, match=r"could not be loaded again: .*num_particles = 20000 is larger"):
        larger.learn(LENGTH, run_folder=tmp_path)
    assert larger.num_timesteps == 0  # before anything can be lost


def test_numbers_of_numpy_and_paths_are_saved_as_pythons(tmp_path, unchecked):
    numbers = {"horizon": np.int64(4), "step_size": np.float32(0.5), "time_budget": np.float64(9)}
    DGPMPCAgent("ToyPush-v0", **{**SMALLEST_AGENT, **numbers}).save(tmp_path / "agent")
    loaded = DGPMPCAgent.load(tmp_path / "agent")
    for name, number in numbers.items():
        assert getattr(loaded, name) == number
        assert type(getattr(loaded, name)) is type(number.item())
    agent(tensorboard_log=tmp_path / "logs").learn(12).save(tmp_path / "agent")
    assert load(tmp_path / "agent").tensorboard_log == str(tmp_path / "logs")
    assert (tmp_path / "logs" / "MPC_1").is_dir()


def test_classes_are_checked(saved, tmp_path):
    with pytest.raises(CheckpointError, match=r"MPCAgent.load, not DGPMPCAgent.load"):
        DGPMPCAgent.load(saved)

    class Mine(MPCAgent):
        pass

    Mine(KnownPointMass(), LinearModel(), planner()).save(tmp_path / "mine")
    with pytest.raises(CheckpointError, match="class 'Mine'"):
        load(tmp_path / "mine")
    assert isinstance(Mine.load(tmp_path / "mine", KnownPointMass(), dynamics=LinearModel(), planner=planner()), Mine)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, t: c.update({"class": "os.system"}), "'os.system'"),
        (lambda c, t: c.update({"class": ["MPCAgent"]}), "'MPCAgent'"),
        (lambda c, t: c.pop("class"), "None"),
        (lambda c, t: c.pop("arguments"), "None"),
        (lambda c, t: c.update(arguments=[]), r"\[\]"),
        (lambda c, t: c["arguments"].pop("seed"), "seed = None"),
        (lambda c, t: c["arguments"].update(seed=-3), "seed = -3"),
        (lambda c, t: c["arguments"].update(seed=True), "seed = True"),
        (lambda c, t: c["arguments"].update(seed="0"), "seed = '0'"),
        (lambda c, t: c["arguments"].update(env="evil:Env-v0"), "'env'"),
        (lambda c, t: c["arguments"].update(reward_fn="os.system"), "'reward_fn'"),
        (lambda c, t: c["arguments"].update(device="cuda"), "'device'"),
        (lambda c, t: c["arguments"].update(num_particles="many"), "'many'"),
        (lambda c, t: c["arguments"].update(num_particles=10**12), "num_particles = 1000000000000"),
        (lambda c, t: c["arguments"].update(num_particles=10**5), "num_particles = 100000"),
        (lambda c, t: c["arguments"].update(time_budget=-1e300), "time_budget = -1e"),
        (lambda c, t: c["arguments"].update(verbose={"a": 1}), "{'a': 1}"),
        (lambda c, t: c["arguments"].update(observation_spec={"observation_spec": {"angles": 3}}), "3"),
        (lambda c, t: c["arguments"].update(tensorboard_log=3), "tensorboard_log = 3"),
        (lambda c, t: c["arguments"].update(planner=["cem"]), r"\['cem'\]"),
        (lambda c, t: c["arguments"].update(planner={}), "{}"),
        (lambda c, t: c["arguments"].update(planner=True), "True"),
    ],
)
def test_arguments_that_are_none_are_named(change, message, saved, tmp_path):
    with pytest.raises(CheckpointError, match=message):
        load(changed(saved, tmp_path / "changed.zip", change))


def toy_agent(**settings):
    return DGPMPCAgent("ToyPush-v0", **{**SMALLEST_AGENT, "seed": 0, "actions_per_plan": 2, **settings})


@pytest.fixture(scope="module")
def saved_toy(tmp_path_factory):
    """Of an agent whose planner has a name."""
    path = tmp_path_factory.mktemp("saved") / "toy.zip"
    toy_agent().learn(EPISODE_STEPS + 3).save(path)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, t: c["arguments"].update(no_such=1), "'no_such'"),
        (lambda c, t: c["arguments"].update(planner="no-such"), "'no-such'"),
        (lambda c, t: c["arguments"].update(planner=None), "planner="),
        (lambda c, t: c["arguments"].update(num_layers=10**3), "num_layers = 1000"),
        (lambda c, t: c["arguments"].update(horizon=10**5), "horizon = 100000"),
        (lambda c, t: c["arguments"].update(num_candidates=10**5, num_particles=10**3), "300000000"),
        (lambda c, t: c["arguments"].update(horizon=10**4, num_particles=10**4) or c["arguments"].pop("num_candidates"),
         "30000000000"),
        (lambda c, t: c["arguments"].update(num_elites=0), "num_elites"),
        (lambda c, t: c["arguments"].update(kernel="os.system"), "os.system"),
        (lambda c, t: t["episodes"].pop("plan.std"), "plan.std"),
    ],
)  # fmt: skip
def test_settings_of_parts_are_checked_by_their_own_limits(change, message, saved_toy, tmp_path):
    with pytest.raises(CheckpointError, match=message):
        DGPMPCAgent.load(changed(saved_toy, tmp_path / "changed.zip", change))


def test_a_setting_that_an_older_file_lacks_has_its_default(saved_toy, tmp_path):
    path = changed(saved_toy, tmp_path / "older.zip", lambda c, t: c["arguments"].pop("smoothing"))
    assert DGPMPCAgent.load(path).smoothing == settings_of(CEM)["smoothing"].default


class Weights(NamedTuple):
    """A plan that is no sequence of actions by its fields: a linear policy of time."""

    weight: torch.Tensor

    @property
    def actions(self):
        return torch.linspace(-1, 1, 3)[:, None] * self.weight.mean()


class PolicySearch:
    """Keeps its policy as it is."""

    def __init__(self, action_low, action_high, *, horizon=3, width=1):
        self.low, self.width = action_low, width

    def initial_plan(self):
        return Weights(torch.full((self.width,), 0.5))

    def plan(self, objective, plan, generator, deadline=None):
        return Weights(plan.weight * 0.9), PlanInfo(0.0)

    def shift(self, plan, num_actions):
        return plan


class Shooting(RandomShooting):
    """By another name."""


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setitem(registry.PLANNERS, "policy-search", PolicySearch)
    monkeypatch.setitem(registry.PLANNERS, "shooting", Shooting)


def is_cold(agent):
    (running,) = agent.collector.running
    return running.carried is agent.controller.cold


def test_a_planner_of_a_name_goes_on_with_its_plan(saved_toy):
    loaded = DGPMPCAgent.load(saved_toy)
    assert loaded.planner_given == "cem"
    assert not is_cold(loaded)


def test_a_plan_without_a_sequence_of_actions_is_kept_too(registered, tmp_path):
    settings = {name: SMALLEST_AGENT[name] for name in SMALLEST_AGENT if not name.startswith("num_cand")}
    settings.pop("num_iterations")
    learned = DGPMPCAgent("ToyPush-v0", planner="policy-search", seed=0, **settings).learn(EPISODE_STEPS + 3)
    learned.save(tmp_path / "agent")
    loaded = DGPMPCAgent.load(tmp_path / "agent")
    assert loaded.planner_given == "policy-search"
    (one,), (other,) = learned.collector.running, loaded.collector.running
    assert torch.equal(one.carried.plan.weight, other.carried.plan.weight)
    assert is_cold(DGPMPCAgent.load(tmp_path / "agent.zip", width=2))
    path = changed(tmp_path / "agent.zip", tmp_path / "less.zip", lambda c, t: t["episodes"].pop("plan.weight"))
    with pytest.raises(CheckpointError, match=r"plan\.weight"):
        DGPMPCAgent.load(path)


@pytest.mark.parametrize("replaced", [{"planner": "shooting"}, {"planner": Shooting}, {"horizon": 5}])
def test_another_planner_or_horizon_begins_with_a_cold_plan(replaced, registered, saved_toy):
    loaded = DGPMPCAgent.load(saved_toy, env="ToyPush-v0", **replaced)
    assert is_cold(loaded)
    assert loaded.settings["horizon"] == replaced.get("horizon", SMALLEST_AGENT["horizon"])
    assert loaded.learn(3, reset_num_timesteps=False).num_timesteps == EPISODE_STEPS + 6


def test_a_planner_that_was_given_as_a_class_is_given_again(tmp_path):
    settings = {name: each for name, each in SMALLEST_AGENT.items() if name != "num_iterations"}
    learned = DGPMPCAgent("ToyPush-v0", planner=Shooting, seed=0, actions_per_plan=2, **settings)
    learned.learn(EPISODE_STEPS + 3, run_folder=tmp_path)
    with pytest.raises(CheckpointError, match="planner="):
        DGPMPCAgent.load(tmp_path / "agent.zip")
    loaded = DGPMPCAgent.load(tmp_path / "agent.zip", planner=Shooting)
    assert (loaded.settings["horizon"], loaded.settings["num_candidates"]) == (3, 6)
    bound = torch.ones(1)
    assert is_cold(DGPMPCAgent.load(tmp_path / "agent.zip", planner=Shooting(-bound, bound, horizon=7)))
    again = DGPMPCAgent("ToyPush-v0", planner=Shooting, seed=0, actions_per_plan=2, **settings)
    assert again.learn(EPISODE_STEPS + 5, run_folder=tmp_path, resume=True).num_timesteps == EPISODE_STEPS + 5
    other = DGPMPCAgent("ToyPush-v0", planner=Shooting, seed=0, actions_per_plan=2, **{**settings, "horizon": 4})
    with pytest.raises(CheckpointError, match="horizon was 3, now 4"):
        other.learn(EPISODE_STEPS + 5, run_folder=tmp_path, resume=True)


def test_a_planner_that_is_no_longer_registered_can_be_given(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(registry.PLANNERS, "policy-search", PolicySearch)
        settings = {
            name: each for name, each in SMALLEST_AGENT.items() if name not in ("num_candidates", "num_iterations")
        }
        DGPMPCAgent("ToyPush-v0", planner="policy-search", width=2, seed=0, **settings).save(tmp_path / "agent")
    with pytest.raises(CheckpointError, match="'policy-search'"):
        DGPMPCAgent.load(tmp_path / "agent")
    assert DGPMPCAgent.load(tmp_path / "agent", planner=PolicySearch).settings["width"] == 2
    other = DGPMPCAgent.load(tmp_path / "agent", planner="cem", num_candidates=9)
    assert (other.settings["horizon"], other.settings["num_candidates"], "width" in other.settings) == (3, 9, False)


def test_the_run_of_another_planner_is_refused(registered, tmp_path):
    toy_agent().learn(5, run_folder=tmp_path)
    other = DGPMPCAgent("ToyPush-v0", planner="shooting", seed=0, num_layers=1)
    with pytest.raises(CheckpointError, match="planner was cem, now shooting"):
        other.learn(9, run_folder=tmp_path, resume=True)
