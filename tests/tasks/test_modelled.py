"""Rewards and terminations that nobody knows are predicted like any other number, and planned with."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from gym_dgpmpc import DGPMPCAgent, GPMPCAgent, MPCAgent, PETSAgent
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import CheckpointError, UnknownRewardError
from gym_dgpmpc.planning.rollout import particle_returns
from gym_dgpmpc.tasks.functions import TaskFunctions
from gym_dgpmpc.tasks.modelled import ModelledVector
from gym_dgpmpc.types import ObservationSpec
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, PointMass, actions_of, agent, planner
from tests.agents.test_dgp_mpc import TINY


def linear(observation_size, action_size, observation_spec):
    return LinearModel()


def far(next_observation):
    return next_observation[..., 0].abs() > 1.2


class Linear(PointMass):
    """Its reward is linear in the state, so that the linear model learns it exactly; where it ends, it may be paid."""

    def __init__(self, slope=-1.0, pay=0.0, **arguments):
        super().__init__(**arguments)
        self.slope, self.pay = slope, pay

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(self.slope * observation[0] + self.pay * rest[0]), *rest


class TestVector:
    spec = ObservationSpec(angles=(1,), absolute=(0,), not_inputs=(0,), constant=(2,))

    def store(self):
        store = TransitionStore(3, 1)
        for i in range(4):
            after = np.arange(3) + i + 1.0
            store.append(np.arange(3) + i, [0.1 * i], after, reward=10.0 * i, terminated=i == 3, episode=0)
        return store

    @pytest.mark.parametrize(
        ("reward", "terminated", "added"),
        [
            (False, False, []),
            (True, False, [[0.0], [10.0], [20.0], [30.0]]),
            (False, True, [[0.0], [0.0], [0.0], [1.0]]),
            (True, True, [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [30.0, 1.0]]),
        ],
    )
    def test_what_is_predicted_stands_behind_the_observation(self, reward, terminated, added):
        store, vector = self.store(), ModelledVector(3, self.spec, reward, terminated)
        plain, seen = store.transitions(), vector.transitions(store)
        assert vector.size == 3 + reward + terminated == seen.observation.shape[1]
        assert torch.equal(seen.observation[:, :3], plain.observation)
        assert torch.equal(seen.next_observation[:, :3], plain.next_observation)
        assert torch.equal(seen.action, plain.action)
        assert seen.next_observation[:, 3:].tolist() == (added or [[]] * 4)
        assert vector.start(np.array([1.0, 2.0, 3.0])).tolist() == [1.0, 2.0, 3.0] + [0.0] * (reward + terminated)

    def test_it_is_predicted_as_it_is_and_no_input(self):
        spec = ModelledVector(3, self.spec, reward=True, terminated=True).spec
        assert spec == ObservationSpec(angles=(1,), absolute=(0, 3, 4), not_inputs=(0, 3, 4), constant=(2,))
        assert ModelledVector(3, self.spec).spec == self.spec

    def test_what_is_learned_may_depend_on_a_goal_or_on_the_heading(self):
        own = ObservationSpec(not_inputs=(0, 3, 4), constant=(4,), body_frame=((0, 1, 2),))
        assert ModelledVector(5, own, reward=True).spec.not_inputs == (3, 5)
        assert ModelledVector(5, own, terminated=True).spec.not_inputs == (3, 5)
        assert ModelledVector(5, own).spec.not_inputs == (0, 3, 4)

    def test_what_is_known_goes_before_what_is_predicted(self):
        after = torch.tensor([[0.0, 0.0, 1.3, 7.0, 0.6], [2.0, 0.0, 0.0, 8.0, 0.4]])
        before, action = torch.zeros(2, 5), torch.ones(2, 1)
        vector = ModelledVector(3, self.spec, reward=True, terminated=True)
        learned = vector.functions(TaskFunctions(None, None, "learned", "learned"))
        assert learned.reward_fn(before, action, after).tolist() == [7.0, 8.0]
        assert learned.terminated_fn(after).tolist() == [True, False]
        known = vector.functions(TaskFunctions(lambda o, a, n: o.sum(-1) + a.sum(-1) + n.sum(-1), far))
        assert known.reward_fn(before, action, after).tolist() == pytest.approx([2.3, 3.0])
        assert known.terminated_fn(after).tolist() == [False, True]
        assert vector.functions(TaskFunctions(None, None, "learned", "never")).terminated_fn is None
        plain = TaskFunctions(far, far)
        assert ModelledVector(3, self.spec).functions(plain) == plain
        with pytest.raises(ValueError, match="got neither"):
            ModelledVector(3, self.spec).functions(TaskFunctions(None, None, "learned"))


def test_a_learned_reward_scores_as_the_known_one_does():
    """For plans from a state: the linear model knows either exactly, up to its particles' spread of 1e-3 per step."""
    env = Linear(fixed_start=True)
    learner = agent(env, dynamics=linear).learn(3 * LENGTH)
    assert learner.task.functions.reward_source == "learned" and learner.task.modelled.reward
    states, actions = [torch.zeros(5, 8, 3)], torch.linspace(-2, 2, 40).reshape(8, 5, 1)
    states[0][..., 0] = 0.7
    with torch.no_grad():
        sampler = learner.dynamics.draw(5, 5, torch.Generator().manual_seed(0))
        for step in range(5):
            states.append(sampler(states[-1], actions[:, step], step))
    states = torch.stack(states)
    predicted = particle_returns(states, actions, learner.task.modelled.functions(learner.task.functions).reward_fn)
    known = particle_returns(states, actions, lambda o, a, n: -n[..., 0])
    # Five steps, each off by the spread times the size of its inputs (1, velocity and force, below 4) at 4 sigma.
    torch.testing.assert_close(predicted, known, rtol=0, atol=5 * 4 * 4e-3)


def test_with_a_learned_reward_it_acts_as_with_the_known_one():
    learner = agent(Linear(slope=1.0), dynamics=linear).learn(4 * LENGTH)
    np.testing.assert_allclose(actions_of(learner.env.envs[0])[LENGTH + 2 : 2 * LENGTH - 5], 2.0, atol=0.3)


@pytest.mark.parametrize(
    ("slope", "pay", "shuns_the_end"),
    [
        (+1.0, 0.0, True),  # each step beyond the origin pays, and none comes after the end
        (+1.0, 0.2, True),
        (-1.0, 0.0, False),  # each step costs: by the task's own rules the end is the best there is
    ],
)
def test_the_end_is_worth_what_the_rest_of_the_episode_is_not(slope, pay, shuns_the_end):
    """A plan's return over the horizon, by the predicted numbers alone, against the plan that ends it at once."""
    vector = ModelledVector(1, ObservationSpec(), reward=True, terminated=True)
    functions = vector.functions(TaskFunctions(None, None, "learned", "learned"))
    horizon = 6
    stays = torch.full((horizon + 1, 1, 1, 3), 1.0)
    stays[..., 1], stays[..., 2] = slope, 0.02
    ends = stays.clone()
    ends[1:, ..., 2] = 0.97
    ends[1, ..., 1] += pay
    ends[3:, ..., 2] = 0.0  # a particle does not come back
    ends[3:, ..., 1] = 100.0
    actions = torch.zeros(1, horizon, 1)
    stay, end = (particle_returns(states, actions, *functions[:2]).item() for states in (stays, ends))
    assert (stay, end) == pytest.approx((horizon * slope, slope + pay))
    assert (stay > end) == shuns_the_end


class Balance(gym.Env):
    """A point that flees the origin by itself; 1 for each step within [-1, 1], where it ends. Neither is offered."""

    def __init__(self, reward=1.0):
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.reward = reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.time = self.np_random.uniform(-0.3, 0.3), 0
        return np.array([self.place]), {}

    def step(self, action):
        self.place = 1.3 * self.place + 0.5 * float(action[0])
        self.time += 1
        gone = bool(abs(self.place) > 1.0)
        return np.array([self.place]), 0.0 if gone else self.reward, gone, not gone and self.time >= 20, {}


def test_deep_gp_learns_when_an_episode_ends_and_keeps_it_from_ending():
    sizes = {"num_inducing": 15, "first_training_iterations": 200, "training_iterations": 25, "num_layers": 1}
    learner = DGPMPCAgent(Balance(), **{**TINY, **sizes, "learning_starts": 60, "horizon": 6, "resample_samples": 0})
    learner.learn(145)
    assert learner.task.modelled.reward and learner.task.modelled.terminated
    assert learner.dynamics.encoder.target_size == 3 and learner.dynamics.encoder.input_size == 2
    lengths = torch.bincount(learner.store.episodes)
    explored = len(torch.unique(learner.store.episodes[:60]))
    # Random actions keep it up for some five steps, the best for twenty.
    assert lengths[:explored].float().mean() < 10
    assert lengths[explored:-1].float().mean() > 15


BASELINE = {
    "num_particles": 5,
    "horizon": 4,
    "num_candidates": 20,
    "num_iterations": 2,
    "learning_starts": 40,
    "seed": 0,
}
NETWORKS = {"hidden_size": 16, "num_hidden_layers": 1, "weight_decay": (1e-4, 1e-4), "num_epochs": 10}


@pytest.mark.parametrize(
    ("agent_class", "arguments"),
    [
        (GPMPCAgent, {"num_inducing": 15, "draw": "DS"}),
        (GPMPCAgent, {"num_inducing": 15, "draw": "AMM"}),
        (PETSAgent, {**NETWORKS, "draw": "TS1"}),
    ],
)
def test_every_model_learns_them(agent_class, arguments, tmp_path):
    learner = agent_class(Balance(), **BASELINE, **arguments).learn(58)
    assert learner.task.modelled.reward and learner.task.modelled.terminated
    assert (learner.dynamics.encoder.input_size, learner.dynamics.encoder.target_size) == (2, 3)
    if agent_class is GPMPCAgent:  # which is good at it
        assert torch.bincount(learner.store.episodes)[-1] > 12
    learner.save(tmp_path / "agent")
    loaded = agent_class.load(tmp_path / "agent")
    expected = learner.predict(np.array([0.1]), deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(np.array([0.1]), deterministic=True)[0], expected)


@pytest.mark.parametrize("draw", ["pathwise", "joint"])
def test_an_agent_that_learned_its_reward_is_saved_and_goes_on(draw, tmp_path):
    def made(**arguments):
        return DGPMPCAgent(Balance(), **{**TINY, "draw": draw, "num_layers": 2, "learning_starts": 25, **arguments})

    whole, part = made(), made()
    whole.learn(40)
    part.learn(31)
    assert part.task.modelled.terminated
    part.save(tmp_path / "part")
    loaded = DGPMPCAgent.load(tmp_path / "part", env=part.env, force_reset=False)
    assert loaded.task.modelled == part.task.modelled
    alone = DGPMPCAgent.load(tmp_path / "part")
    for one in (loaded, alone):
        expected = part.predict(np.array([0.1]), deterministic=True)[0]
        np.testing.assert_array_equal(one.predict(np.array([0.1]), deterministic=True)[0], expected)
    loaded.learn(9, reset_num_timesteps=False)
    for one, other in zip(whole.store.transitions(), loaded.store.transitions(), strict=True):
        assert torch.equal(one, other)


def test_a_run_that_learns_its_reward_resumes_exactly(tmp_path):
    def made():
        return agent(Linear(terminate_beyond=1.2), dynamics=linear)

    whole = made().learn(47)
    made().learn(28, run_folder=tmp_path)
    resumed = made().learn(47, run_folder=tmp_path, resume=True)
    assert resumed.task.modelled.terminated and resumed.task.modelled.reward
    # The environment is no simulator that may be driven by a recording: it goes on from the last episode's end.
    assert torch.equal(whole.store.rewards[:20], resumed.store.rewards[:20])
    assert len(resumed.store) == 47


def test_the_first_termination_makes_the_model_begin_anew():
    made = []

    def factory(observation_size, action_size, observation_spec):
        made.append((observation_size, observation_spec))
        return LinearModel()

    env = KnownPointMass(fixed_start=True)
    learner = agent(env, dynamics=factory).learn(2 * LENGTH)
    assert made == [(2, ObservationSpec())] and not learner.task.modelled.terminated
    before = learner.dynamics
    env.terminate_beyond = 1.05
    env.state = np.array([1.0, 0.0])
    learner.learn(LENGTH, callback=lambda locals_, _: env.state.__setitem__(1, 2.0) is None)
    assert learner.store.terminated.any()
    assert made == [(2, ObservationSpec()), (3, ObservationSpec(absolute=(2,), not_inputs=(2,)))]
    assert learner.dynamics is not before and learner.controller.dynamics is learner.dynamics
    assert learner.dynamics.fits[0] == int(learner.store.terminated.nonzero()[0]) + 1


def test_a_model_that_was_ready_made_cannot_be_given_more_to_predict():
    with pytest.raises(UnknownRewardError, match=r"a ready-made one cannot be: pass dynamics=\.\.\. as a"):
        agent(PointMass())
    with pytest.raises(UnknownRewardError, match=r"a ready-made one cannot be: pass dynamics=\.\.\. as a"):
        agent(KnownPointMass(), reward_fn="learned")


def test_a_class_makes_models():
    class Sized(LinearModel):
        def __init__(self, observation_size, action_size, observation_spec):
            super().__init__()
            self.sizes = observation_size, action_size

    assert agent(PointMass(), dynamics=Sized).dynamics.sizes == (3, 1)


def test_what_was_asked_to_be_learned_stays_so(tmp_path):
    learner = agent(KnownPointMass(), dynamics=linear, reward_fn="learned").learn(2 * LENGTH)
    learner.save(tmp_path / "agent")
    parts = {"dynamics": linear, "planner": planner()}
    loaded = MPCAgent.load(tmp_path / "agent", env=KnownPointMass(), **parts)
    assert loaded.task.functions.reward_source == "learned" and loaded.task.modelled.reward
    known = MPCAgent.load(tmp_path / "agent", env=KnownPointMass(), reward_fn=None, **parts)
    assert known.task.functions.reward_source == "the environment's" and known.task.modelled.reward
    known.predict(np.zeros(2))
    learner.learn(LENGTH, run_folder=tmp_path / "run")
    with pytest.raises(CheckpointError, match="what was to be learned was"):
        agent(KnownPointMass(), dynamics=linear).learn(5, run_folder=tmp_path / "run", resume=True)


def test_set_env_learns_a_reward_only_before_the_model_is_trained():
    learner = agent(KnownPointMass(), dynamics=linear)
    learner.set_env(Linear())
    assert learner.task.modelled.reward and learner.learn(12).is_fitted
    trained = agent(KnownPointMass(), dynamics=linear).learn(12)
    with pytest.raises(UnknownRewardError, match="Linear"):
        trained.set_env(Linear())


@pytest.mark.parametrize(
    ("env_id", "reward_fn", "sizes"),
    [("Pendulum-v1", None, (4, 3)), ("Pendulum-v1", "learned", (4, 4)), ("InvertedPendulum-v5", None, (5, 4))],
)
def test_gymnasiums_own_tasks_work_at_once(env_id, reward_fn, sizes):
    learner = DGPMPCAgent(env_id, reward_fn=reward_fn, **{**TINY, "num_layers": 1, "learning_starts": 25}).learn(28)
    assert (learner.dynamics.encoder.input_size, learner.dynamics.encoder.target_size) == sizes
    assert learner.task.modelled.reward == (reward_fn == "learned") and not learner.task.modelled.terminated
