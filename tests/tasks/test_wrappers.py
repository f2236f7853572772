"""Wrappers between the agent and its environment, and attributes that other packages use for something else."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces, wrappers
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan, VecEnvWrapper, VecMonitor

from gym_dgpmpc import DGPMPCAgent, MPCAgent
from gym_dgpmpc.envs.performed_actions import RewardOfPerformed
from gym_dgpmpc.envs.registration import ENVIRONMENTS
from gym_dgpmpc.tasks.replay import EpisodeStart, can_replay
from gym_dgpmpc.tasks.reward_guard import disagreements
from gym_dgpmpc.types import ObservationSpec
from gym_dgpmpc.wrappers import RiskSensitiveReward
from tests.agents.point_mass import KnownPointMass, LinearModel, PointMass, agent
from tests.agents.test_dgp_mpc import TINY
from tests.tasks.test_goals import Goal
from tests.tasks.test_task import found, sources

WIDE_ONE = spaces.Box(-3.0, 3.0, (1,), np.float32)
WIDE = spaces.Box(-3.0, 3.0, (2,), np.float32)


class Halved(gym.ActionWrapper):
    """Written for one action: it looks at the length of the whole array."""

    def action(self, action):
        return action / 2 if len(action) == 1 else np.zeros(1, dtype=np.float32)


class Signed(gym.ActionWrapper):
    """Raises where it is given many actions."""

    def action(self, action):
        return action if action[0] > 0 else -action


class Filtered(gym.ActionWrapper):
    """Performs a mean of the actions so far."""

    last = 0.0

    def action(self, action):
        self.last = 0.9 * self.last + 0.1 * action
        return self.last


class Noisy(gym.ActionWrapper):
    generator = np.random.default_rng(0)

    def action(self, action):
        return action + self.generator.normal(size=action.shape)


class Doubling(gym.Wrapper):
    def step(self, action):
        return super().step(2 * action)


class Looking(gym.Wrapper):
    keeps_actions = True

    def step(self, action):
        return super().step(action)


class DoublingAll(VecEnvWrapper):
    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.venv.step_async(2 * actions)

    def step_wait(self):
        return self.venv.step_wait()


def summed(env):
    """Two numbers, of which the environment is given the sum."""
    return wrappers.TransformAction(env, lambda action: action.sum(-1, keepdims=True), WIDE)


STACKS = {
    "rescaled": lambda env: wrappers.RescaleAction(env, -0.5, 1.0),
    "clipped": lambda env: wrappers.TransformAction(wrappers.ClipAction(env), lambda action: 3 * action, WIDE_ONE),
    "summed": summed,
    "one by one": Halved,
    "one by one, or it raises": Signed,
    "three": lambda env: wrappers.RescaleAction(summed(Halved(env)), -1.0, 1.0),
    "with others between": lambda env: Looking(wrappers.RescaleAction(wrappers.TimeLimit(env, 5), -1.0, 1.0)),
    "float64": lambda env: wrappers.DtypeObservation(wrappers.RescaleAction(env, -1.0, 1.0), np.float32),
}


@pytest.mark.parametrize("stack", STACKS.values(), ids=STACKS)
@pytest.mark.parametrize("as_vec_env", [False, True])
def test_actions_reach_an_offered_reward_as_its_step_gets_them(stack, as_vec_env):
    env = stack(KnownPointMass())
    env = DummyVecEnv([lambda: env]) if as_vec_env else env
    learner = mpc(env, learning_starts=1000).learn(25)
    assert isinstance(learner.task.functions.reward_fn, RewardOfPerformed)
    assert disagreements(learner.task.functions, learner.store) == []


def mpc(env, **arguments):
    """An agent whose planner fits any action space."""
    small = {"horizon": 3, "num_candidates": 12, "num_iterations": 2, "seed": 0}
    return MPCAgent(env, LinearModel(), **{**small, **arguments})


def test_what_is_performed_in_a_plan_is_what_is_performed_one_by_one():
    env = STACKS["three"](KnownPointMass())
    performed = found(env).reward_fn.performed
    assert not performed.takes_batches
    assert found(STACKS["rescaled"](KnownPointMass())).reward_fn.performed.takes_batches
    chosen = 2 * torch.rand(4, 1, 6, 2, generator=torch.Generator().manual_seed(0)) - 1
    batch = performed(chosen.expand(4, 3, 6, 2))
    assert batch.shape == (4, 3, 6, 1)
    for place in np.ndindex(4, 3, 6):
        action = chosen[place[0], 0, place[2]].numpy()
        layer = env
        while layer is not env.unwrapped:
            action, layer = layer.action(action), layer.env
        assert batch[place].item() == action.item()


@pytest.mark.parametrize(
    ("wrap", "named"),
    [
        (lambda env: wrappers.StickyAction(env, 0.25), "StickyAction"),
        (Filtered, "Filtered"),
        (Noisy, "Noisy"),
        (Doubling, "Doubling"),
        (lambda env: wrappers.RescaleAction(Filtered(env), -1.0, 1.0), "Filtered"),
        (lambda env: DoublingAll(DummyVecEnv([lambda: env])), "DoublingAll"),
    ],
)
def test_actions_that_cannot_be_followed_are_refused(wrap, named):
    with pytest.raises(ValueError, match=rf"{named}.*around it may perform other actions.*learned.*keeps_actions"):
        found(wrap(KnownPointMass()))
    assert sources(wrap(KnownPointMass()), "learned") == ("learned", "learned")
    assert sources(wrap(KnownPointMass()), KnownPointMass.reward_fn) == ("given", "learned")


def test_trying_a_wrapper_does_not_move_it():
    env = Filtered(KnownPointMass())
    with pytest.raises(ValueError, match="Filtered"):
        found(env)
    assert env.last == 0.0


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "MountainCarContinuous-v0", "Reacher-v5", "InvertedPendulum-v5"])
def test_what_is_known_of_a_task_holds_through_action_wrappers(env_id):
    plain, rescaled = gym.make(env_id), wrappers.RescaleAction(gym.make(env_id), -0.25, 0.5)
    assert sources(rescaled) == sources(plain)
    learner = mpc(rescaled, learning_starts=1000).learn(30)
    assert disagreements(learner.task.functions, learner.store) == []


def test_a_known_reward_under_a_wrapper_that_cannot_be_followed_is_learned():
    assert sources(wrappers.StickyAction(gym.make("Pendulum-v1"), 0.25)) == ("learned", "never")
    assert sources(Doubling(gym.make("Pendulum-v1"))) == ("learned", "learned")


@pytest.mark.parametrize("env_id", ["ModCartPole-v0", "Pendulum-v1"])
def test_in_another_process_the_wrappers_are_those_of_the_spec(env_id):
    rescaled = {"wrapper_class": wrappers.RescaleAction, "wrapper_kwargs": {"min_action": -0.5, "max_action": 0.5}}
    env = make_vec_env(env_id, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"}, **rescaled)
    try:
        learner = mpc(env, learning_starts=1000).learn(10)
        assert disagreements(learner.task.functions, learner.store) == []
        assert isinstance(learner.task.functions.reward_fn, RewardOfPerformed)
    finally:
        env.close()


def test_in_another_process_a_wrapper_that_does_not_record_how_it_was_made_is_refused():
    env = make_vec_env(
        "ModCartPole-v0", vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"}, wrapper_class=Halved
    )
    try:
        with pytest.raises(ValueError, match="Halved around it may perform other actions"):
            found(env)
    finally:
        env.close()


def test_a_risk_sensitive_reward_follows_actions_too():
    env = wrappers.RescaleAction(gym.make("ModCartPole-v0"), -0.5, 0.5)
    learner = mpc(RiskSensitiveReward(env, angle_index=1, penalise_step=True), learning_starts=1000).learn(20)
    assert disagreements(learner.task.functions, learner.store) == []
    with pytest.raises(ValueError, match="Filtered"):
        RiskSensitiveReward(Filtered(gym.make("ModCartPole-v0")), angle_index=1)


@pytest.mark.parametrize("wrapper", [wrappers.NormalizeObservation, wrappers.NormalizeReward])
def test_moving_statistics_are_refused_unless_frozen(wrapper):
    def wrapped():
        return wrapper(KnownPointMass())

    for env in (wrapped(), wrappers.TimeLimit(wrapped(), 5), DummyVecEnv([KnownPointMass, wrapped])):
        with pytest.raises(ValueError, match=rf"{wrapper.__name__}: its moving statistics.*update_running_mean"):
            agent(env)
    env = SubprocVecEnv([wrapped], start_method="fork")
    try:
        with pytest.raises(ValueError, match=rf"{wrapper.__name__}: its moving statistics"):
            agent(env)
    finally:
        env.close()
    frozen = wrapped()
    frozen.update_running_mean = False
    agent(frozen, reward_fn=KnownPointMass.reward_fn)


class Offering(PointMass):
    """Has attributes that it is given, as other packages' environments have."""

    def __init__(self, **attributes):
        super().__init__()
        vars(self).update(attributes)


class DmEnv(PointMass):
    def observation_spec(self):
        return {"position": (1,)}


class Sinergym:
    """A reward as Sinergym has it."""

    def __call__(self, observation, info):
        return 0.0, {}


def test_another_packages_observation_spec_is_not_taken_for_ours(unchecked):
    assert agent(DmEnv(), reward_fn=KnownPointMass.reward_fn).observation_spec.angles == ()
    agent(Offering(observation_spec={"x": 1}), reward_fn=KnownPointMass.reward_fn)
    with pytest.raises(TypeError, match=r"ObservationSpec, got \{'angles': \(0,\)\}"):
        agent(observation_spec={"angles": (0,)})


@pytest.mark.parametrize("reward_fn", [Sinergym(), lambda observation, action: observation[..., 0], "dense", 3, True])
def test_another_packages_reward_fn_is_not_taken_for_ours(reward_fn):
    with pytest.warns(UserWarning, match=r"'reward_fn' of tests\.tasks\.test_wrappers\.Offering is not taken.*learned"):
        assert sources(gym.wrappers.TimeLimit(Offering(reward_fn=reward_fn), 5)) == ("learned", "learned")


@pytest.mark.parametrize("terminated_fn", [False, True, "never", lambda: False])
def test_another_packages_terminated_fn_is_not_taken_for_ours(terminated_fn):
    with pytest.warns(UserWarning, match=r"'terminated_fn' of .*Offering is not taken.*never"):
        assert sources(Offering(terminated_fn=terminated_fn)) == ("learned", "learned")


@pytest.mark.filterwarnings("error")
def test_a_user_who_says_what_to_do_is_not_warned():
    env = Offering(reward_fn=Sinergym(), terminated_fn=False)
    assert sources(env, "learned", "never") == ("learned", "never")


def test_an_error_says_where_a_function_was_found_and_how_to_do_without(unchecked):
    env = Offering(reward_fn=lambda observation, action, info: info.cost)
    expected = (
        r"reward_fn must map.*found as 'reward_fn' of tests\.tasks\.test_wrappers\.Offering.*reward_fn=\"learned\""
    )
    with pytest.raises(ValueError, match=expected):
        found(env)
    assert sources(env, "learned") == ("learned", "learned")
    with pytest.raises(TypeError, match=r"terminated_fn must map.*found as 'terminated_fn' of .*Offering.*never"):
        found(Offering(terminated_fn=lambda state: 0))


def test_can_replay_of_another_package_says_nothing():
    assert not can_replay(EpisodeStart(Offering(can_replay=lambda: False)))
    assert can_replay(EpisodeStart(Offering(can_replay=True)))


class ForHindsight(Goal):
    """Its rewards are computed as Stable-Baselines3's HER wants it."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        if not isinstance(info, list):  # `step` has one of each
            return super().compute_reward(achieved_goal, desired_goal, info)[()]
        assert achieved_goal.shape == desired_goal.shape == (len(info), 1)
        return np.array([-abs(a[0] - d[0]) for a, d in zip(achieved_goal, desired_goal, strict=True)])


class Strict(ForHindsight):
    def compute_reward(self, achieved_goal, desired_goal, info):
        assert achieved_goal.ndim < 3
        return super().compute_reward(achieved_goal, desired_goal, info)


class Reusing(Goal):
    """Writes into the goals, and returns one array again and again."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        reward = np.asarray(super().compute_reward(achieved_goal, desired_goal, info), dtype=np.float32)
        if np.ndim(reward):
            achieved_goal.fill(np.nan)
        return reward


@pytest.mark.parametrize("env", [Strict, Reusing])
def test_compute_reward_as_hindsight_calls_it(env):
    learner = agent(env()).learn(15)
    assert learner.task.functions.reward_source == "compute_reward"
    assert disagreements(learner.task.functions, learner.store) == []


class Informed(Goal):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return -info["distance"] if isinstance(info, dict) else -np.array([each["distance"] for each in info])

    def step(self, action):
        self.reward_type = "dense"
        return super().step(action)


def test_a_compute_reward_that_cannot_be_called_is_named():
    with pytest.raises(ValueError, match=r"'compute_reward' of .*Informed must map goals.*KeyError.*learned"):
        found(Informed())
    assert sources(Informed(), "learned") == ("learned", "learned")


def test_whole_numbers_are_refused_with_what_makes_floats_of_them():
    env = KnownPointMass()
    env.observation_space = spaces.Box(-9, 9, (2,), np.int64)
    with pytest.raises(ValueError, match=r"int64.*DtypeObservation\(env, numpy\.float32\)"):
        agent(env)
    agent(wrappers.DtypeObservation(env, np.float32))


UNSUPPORTED = {
    "Text": (spaces.Text(5), r"got Text\("),
    "Tuple": (spaces.Tuple([WIDE]), r"got Tuple\(Box"),
    "no number": (spaces.Box(-1, 1, (0,)), r"one or more real numbers.*got Box\(\[\]"),
    "no part": (spaces.Dict(), r"at least one part, got Dict\(\)"),
    "nested": (spaces.Dict(a=WIDE, b=spaces.Dict(c=WIDE)), r"got Dict\('c': .* for 'b'.*FlattenObservation"),
}


@pytest.mark.parametrize(("space", "named"), UNSUPPORTED.values(), ids=UNSUPPORTED)
def test_observations_that_are_no_vectors_are_refused_before_anything_fails_at_them(space, named):
    env = KnownPointMass()
    env.observation_space = space
    with pytest.raises(ValueError, match=named):
        agent(env)


@pytest.mark.parametrize(("bound", "dtype"), [(1e300, np.float64), (3e38, np.float32)])
def test_bounds_that_float32_cannot_hold_are_refused(bound, dtype):
    env = KnownPointMass()
    env.action_space = spaces.Box(-bound, bound, (1,), dtype)
    with pytest.raises(ValueError, match=r"float32 can hold, got low = \[-[13]\.?e\+.*RescaleAction"):
        agent(env)


@pytest.mark.parametrize("wrap", [lambda env: VecCheckNan(env, raise_exception=True), VecMonitor])
def test_vec_wrappers_that_only_look_let_an_offered_reward_through(wrap):
    assert sources(wrap(DummyVecEnv([KnownPointMass]))) == ("the environment's", "learned")


def test_a_spec_that_does_not_fit_is_refused_whatever_the_model_does_with_it():
    with pytest.raises(ValueError, match=r"angles must hold distinct indices from 0 to 1 .*received \(2,\)"):
        agent(observation_spec=ObservationSpec(angles=(2,)))


def test_never_as_an_argument_is_kept_in_a_file(tmp_path):
    given = {"reward_fn": "learned", "terminated_fn": "never"}
    DGPMPCAgent(Offering(terminated_fn=None), **TINY, **given).save(tmp_path / "agent.zip")
    env = Offering(terminated_fn=lambda state: state[..., 0] > 0)
    assert DGPMPCAgent.load(tmp_path / "agent.zip", env).task.functions.terminated_source == "never"
    loaded = DGPMPCAgent.load(tmp_path / "agent.zip", env, terminated_fn=None)
    assert loaded.task.functions.terminated_source == "the environment's"


def test_never_as_an_argument(unchecked):
    assert sources(PointMass(), "learned", "never") == ("learned", "never")
    learner = agent(PointMass(terminate_beyond=5.0), reward_fn=KnownPointMass.reward_fn, terminated_fn="never").learn(
        15
    )
    assert learner.task.functions.terminated_fn is None and not learner.task.learns_termination
    with pytest.raises(ValueError, match="reward_fn must be a function, \"learned\" or None, got 'never'"):
        found(PointMass(), "never")


MORE_OF_GYMNASIUM = ["Swimmer-v5", "Hopper-v5", "InvertedDoublePendulum-v5", "Walker2d-v5", "Pusher-v5"]
OF_GYMNASIUM = ["Pendulum-v1", "MountainCarContinuous-v0", "Reacher-v5", "InvertedPendulum-v5", "HalfCheetah-v5"]


@pytest.mark.parametrize("env_id", [*ENVIRONMENTS, *OF_GYMNASIUM, *MORE_OF_GYMNASIUM])
def test_a_rescaled_task_is_learned_for_an_episode(env_id):
    env = wrappers.TimeLimit(wrappers.RescaleAction(gym.make(env_id), -1.0, 1.0), 8)
    learner = DGPMPCAgent(env, **{**TINY, "num_layers": 1, "terminated_fn": "never"}).learn(10)
    assert learner.is_fitted and len(learner.store) == 10
    functions = learner.task.functions
    if functions.reward_fn is not None:
        assert disagreements(functions._replace(terminated_fn=None), learner.store) == []
    assert sources(env, None, "never") == sources(gym.make(env_id), None, "never")
