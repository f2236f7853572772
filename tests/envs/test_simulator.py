"""A simulator's trajectories against stepping the environment itself."""

import re
from types import SimpleNamespace

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium import spaces

import gym_dgpmpc  # noqa: F401  registers the environments
from gym_dgpmpc.envs.simulator import Simulator, SimulatorLayout


@pytest.mark.parametrize("name", ["ModCartPole-v0", "SwingUpCartPole-v0"])
def test_trajectories_are_those_of_the_environment(name):
    """Full force first, so that the cart passes the end of its rail."""
    env = gymnasium.make(name)
    observation, _ = env.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-3, 3, (60, 1))
    actions[:10] = 3.0
    found = Simulator(env).trajectories(observation[None], actions[None])[0]
    stepped = np.stack([env.step(action)[0] for action in actions])
    assert stepped[:, 0].max() > 2.5 or name != "ModCartPole-v0"
    np.testing.assert_allclose(found, stepped, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "tolerance"), [("Reacher7DoF-v0", 1e-9), ("BiasedReacher-v0", 1e-9), ("RiskSensitiveHalfCheetah-v0", 1e-4)]
)
def test_the_other_tasks_of_the_paper_say_where_their_state_is(name, tolerance):
    """The cheetah's contacts are solved to a tolerance, from a start that a trajectory does not share with it."""
    env = gymnasium.make(name)
    observation, _ = env.reset(seed=3)
    bound = env.action_space.high
    actions = np.random.default_rng(0).uniform(-bound, bound, (20, len(bound))).astype(np.float32)
    found = Simulator(env).trajectories(observation[None], actions[None].astype(float))[0]
    stepped = np.stack([env.step(action)[0] for action in actions])
    np.testing.assert_allclose(found, stepped, rtol=0, atol=tolerance)


def test_many_trajectories_are_each_its_own_and_leave_the_environment_alone():
    env = gymnasium.make("ModCartPole-v0")
    env.reset(seed=0)
    before = env.unwrapped.data.qpos.copy()
    simulator, rng = Simulator(env), np.random.default_rng(1)
    observations, actions = rng.normal(size=(4, 4)), rng.uniform(-3, 3, (4, 5, 1))
    together = simulator.trajectories(observations, actions)
    assert together.shape == (4, 5, 4)
    for k in range(4):
        alone = simulator.trajectories(observations[k : k + 1], actions[k : k + 1])[0]
        np.testing.assert_array_equal(together[k], alone)
    np.testing.assert_array_equal(env.unwrapped.data.qpos, before)


@pytest.mark.filterwarnings("ignore:.*settotalmass.*")
def test_a_layout_says_where_the_state_is():
    """Gymnasium's half-cheetah, with the mean velocity of a step first and its place along the track left out."""
    env = gymnasium.make("HalfCheetah-v5")
    observation, _ = env.reset(seed=0)
    inner = env.unwrapped
    told = SimpleNamespace(
        model=inner.model,
        frame_skip=inner.frame_skip,
        observation_space=spaces.Box(-np.inf, np.inf, (19,)),
        simulator_layout=SimulatorLayout((None, *range(1, 9)), tuple(range(9, 18)), rates=((0, 0),)),
    )
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 6))
    start = np.concatenate([[0.0], observation, [0.25]])  # the last number is nothing of the simulator's
    found = Simulator(told).trajectories(start[None], actions[None])[0]
    for after, action in zip(found, actions, strict=True):
        observation, _, _, _, info = env.step(action)
        # Contacts are solved to a tolerance, from a start that a trajectory does not share with the environment.
        np.testing.assert_allclose(after[1:18], observation, rtol=0, atol=1e-4)
        assert after[0] == pytest.approx(info["x_velocity"], abs=1e-4)
        assert after[18] == 0.25


def offered(**changes):
    env = gymnasium.make("SwingUpCartPole-v0").unwrapped
    parts = {"model": env.model, "frame_skip": 2, "observation_space": env.observation_space}
    return SimpleNamespace(**(parts | changes))


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        (SimulatorLayout((0,), (1, 2)), r"\b2 positions.*\b1 and 2$"),
        (SimulatorLayout((0, 1), (1, 2)), r"\b4 numbers.*velocities=\(1, 2\)"),
        (SimulatorLayout((0, 1), (2, 4)), r"\b4 numbers.*velocities=\(2, 4\)"),
        (SimulatorLayout((0, None), (2, 3), rates=((1, 2),)), r"\b2 positions.*rates=\(\(1, 2\),\)"),
    ],
)
def test_a_layout_that_does_not_fit_is_named(layout, message):
    with pytest.raises(ValueError, match=rf"simulator_layout .*{message}"):
        Simulator(offered(simulator_layout=layout))


def test_what_is_no_simulator_is_refused():
    with pytest.raises(ValueError, match=r"MuJoCo.*PendulumEnv"):
        Simulator(gymnasium.make("Pendulum-v1"))
    with pytest.raises(ValueError, match=r"\b5 numbers.*\b2 positions and 2 velocities.*simulator_layout"):
        Simulator(offered(observation_space=spaces.Box(-1, 1, (5,))))
    muscle = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j'/><geom size='1'/></body></worldbody>"
        "<actuator><general joint='j' dyntype='integrator'/></actuator></mujoco>"
    )
    with pytest.raises(ValueError, match=r"actuators .*\b1 states"):
        Simulator(offered(model=muscle, observation_space=spaces.Box(-1, 1, (2,))))


@pytest.mark.parametrize(
    ("observations", "actions"), [((3, 5), (3, 2, 1)), ((3, 4), (2, 2, 1)), ((3, 4), (3, 2, 2)), ((3, 4), (3, 2))]
)
def test_shapes_that_do_not_fit_are_named(observations, actions):
    with pytest.raises(ValueError, match=re.escape(f"{observations} and {actions}")):
        Simulator(offered()).trajectories(np.zeros(observations), np.zeros(actions))
