"""What is known of Gymnasium's own tasks, against what their `step` returns over random rollouts."""

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.mujoco_env import expand_model_path
from stable_baselines3.common.monitor import Monitor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.envs import known
from gym_dgpmpc.envs.known_rewards import double_pendulum_tip
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn

POSITIONS = {"exclude_current_positions_from_observation": False}
WEIGHTS = {"ctrl_cost_weight": 0.3, "forward_reward_weight": 2.0}

# Environment, its arguments, and how far a reward may be off, by its size and absolutely. Where observations are
# float32, or where actions are squared in float32, rounding is 2^-24 of each term.
SINGLE = (1e-6, 1e-6)
KNOWN_REWARD = [
    ("Pendulum-v1", {}, (1e-6, 1e-5)),  # near theta = pi sine and cosine tell the angle to some 2^-24 only
    ("Pendulum-v1", {"g": 5.0}, (1e-6, 1e-5)),
    ("MountainCarContinuous-v0", {}, SINGLE),
    ("MountainCarContinuous-v0", {"goal_velocity": 0.02}, SINGLE),
    ("InvertedPendulum-v5", {}, (0.0, 0.0)),
    ("InvertedDoublePendulum-v5", {}, (0.0, 3e-4)),  # the simulator's tip is that of the integrator's last stage
    ("InvertedDoublePendulum-v5", {"healthy_reward": 3.0}, (0.0, 3e-4)),
    ("Reacher-v5", {}, SINGLE),
    ("Reacher-v5", {"reward_dist_weight": 3.0, "reward_control_weight": 0.5}, SINGLE),
    ("Pusher-v5", {}, SINGLE),
    ("Pusher-v5", {"reward_near_weight": 2.0, "reward_dist_weight": 0.3, "reward_control_weight": 0.7}, SINGLE),
    ("HalfCheetah-v5", POSITIONS, SINGLE),
    ("HalfCheetah-v5", POSITIONS | WEIGHTS | {"frame_skip": 3}, SINGLE),
    ("Swimmer-v5", POSITIONS, SINGLE),
    ("Swimmer-v5", POSITIONS | WEIGHTS, SINGLE),
    ("Hopper-v5", POSITIONS, SINGLE),
    ("Hopper-v5", POSITIONS | WEIGHTS | {"healthy_reward": 5.0, "terminate_when_unhealthy": False}, SINGLE),
    ("Hopper-v5", POSITIONS | {"healthy_state_range": (-3.0, 3.0), "healthy_z_range": (1.2, 1.3)}, SINGLE),
    ("Walker2d-v5", POSITIONS, SINGLE),
    ("Walker2d-v5", POSITIONS | WEIGHTS | {"healthy_angle_range": (-0.1, 0.1), "healthy_reward": 5.0}, SINGLE),
]
UNKNOWN_REWARD = [
    ("HalfCheetah-v5", {}),
    ("Swimmer-v5", {}),
    ("Hopper-v5", {}),
    ("Hopper-v5", {"terminate_when_unhealthy": False}),
    ("Walker2d-v5", {"healthy_z_range": (1.0, 1.5)}),
]
TERMINATING = {
    "MountainCarContinuous-v0",
    "InvertedPendulum-v5",
    "InvertedDoublePendulum-v5",
    "Hopper-v5",
    "Walker2d-v5",
}
EVERYTHING = [case[:2] for case in KNOWN_REWARD] + UNKNOWN_REWARD


def rollouts(env, num_steps=400, seed=0):
    """Random steps: observations, actions, next observations, rewards, terminations, and whether an episode began.

    Actions are held for some steps, so that states far away are met.
    """
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    rows, starts, ended = [], [], True
    for step in range(num_steps):
        if ended:
            observation = np.array(env.reset(seed=int(rng.integers(2**31)))[0])
        if ended or step % 7 == 0:
            action = rng.uniform(low, high).astype(np.float32)
        starts.append(ended)
        after, reward, terminated, truncated, _ = env.step(action)
        after = np.array(after)
        rows.append((observation, action, after, float(reward), bool(terminated)))
        observation, ended = after, terminated or truncated or step % 100 == 99
    before, action, after, reward, terminated = (np.array(column) for column in zip(*rows, strict=True))
    return torch.as_tensor(before), torch.as_tensor(action), torch.as_tensor(after), reward, terminated, starts


def drive_up_the_hill(num_steps=400):
    """Steps of the mountain car pushed along with its velocity, as in `rollouts`; random ones never get there."""
    env = gymnasium.make("MountainCarContinuous-v0", goal_velocity=0.01)
    rows, terminated = [], True
    for _ in range(num_steps):
        if terminated:
            observation = env.reset(seed=len(rows))[0]
        action = np.array([0.8 if observation[1] >= 0 else -1.0], np.float32)
        after, reward, terminated, _, _ = env.step(action)
        rows.append((observation, action, after, reward, terminated))
        observation = after
    return env, [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize(("env_id", "arguments", "tolerance"), KNOWN_REWARD)
def test_known_rewards_are_those_of_step(env_id, arguments, tolerance):
    env = gymnasium.make(env_id, **arguments)
    task = known.find(env)
    assert isinstance(task.reward_fn, RewardFn)
    before, action, after, reward, *_ = rollouts(env)
    if env_id == "InvertedDoublePendulum-v5":  # the observation clips the rates
        seen = (after[:, 6:8].abs() < 10).all(dim=-1).numpy()
        assert seen.mean() > 0.9
        before, action, after, reward = before[seen], action[seen], after[seen], reward[seen]
    values = task.reward_fn(before, action, after)
    assert values.shape == (len(reward),) and values.dtype == after.dtype
    np.testing.assert_allclose(values.numpy(), reward, rtol=tolerance[0], atol=tolerance[1])
    assert np.ptp(reward) > 0  # there is something to know
    # In single precision, batched over more dimensions, as a planner calls it.
    folded = [tensor.float().reshape(2, -1, tensor.shape[-1]) for tensor in (before, action, after)]
    single = task.reward_fn(*folded)
    assert single.shape == folded[0].shape[:2] and single.dtype == torch.float32
    # Places of up to 10 m, rounded, are subtracted and divided by a step of at least 0.008 s.
    np.testing.assert_allclose(single.flatten().numpy(), values.numpy(), rtol=1e-5, atol=2e-3)


@pytest.mark.parametrize(("env_id", "arguments"), EVERYTHING)
def test_known_terminations_are_those_of_step(env_id, arguments):
    env = gymnasium.make(env_id, **arguments)
    task = known.find(env)
    _, _, after, _, terminated, _ = rollouts(env)
    ends = env_id in TERMINATING and arguments.get("terminate_when_unhealthy", True)
    assert (task.terminated_fn is not None) == ends
    if not ends:
        assert not terminated.any()
        return
    assert isinstance(task.terminated_fn, TerminatedFn)
    values = task.terminated_fn(after)
    assert values.dtype == torch.bool
    np.testing.assert_array_equal(values.numpy(), terminated)
    assert env_id == "MountainCarContinuous-v0" or 3 < terminated.sum() < len(terminated)
    np.testing.assert_array_equal(
        task.terminated_fn(after.float().reshape(4, -1, after.shape[-1])).flatten(), terminated
    )


def test_the_mountain_cars_goal():
    env, (before, action, after, reward, terminated) = drive_up_the_hill()
    task = known.find(env)
    before, action, after = (torch.as_tensor(array) for array in (before, action, after))
    assert terminated.sum() >= 2
    np.testing.assert_array_equal(task.terminated_fn(after).numpy(), terminated)
    np.testing.assert_allclose(task.reward_fn(before, action, after).numpy(), reward, rtol=1e-6)
    assert reward.max() > 99 and reward[~terminated].max() <= 0


@pytest.mark.parametrize(("env_id", "arguments"), UNKNOWN_REWARD)
def test_rewards_that_are_no_function_of_the_observation_are_left_open(env_id, arguments):
    assert known.find(gymnasium.make(env_id, **arguments)).reward_fn is None


@pytest.mark.parametrize("arguments", [{}, WEIGHTS])
def test_the_swimmers_mean_velocity_is_nearly_that_of_the_observations(arguments):
    env = gymnasium.make("Swimmer-v5", **arguments)
    before, action, after, reward, *_ = rollouts(env)
    error = known.find(env).planning_reward_fn(before, action, after).numpy() - reward
    assert abs(error.mean()) < 0.005 * reward.std() and error.std() < 0.1 * reward.std()


@pytest.mark.parametrize("arguments", [{}, POSITIONS])
def test_a_swimmer_feels_neither_place_nor_heading(arguments):
    """The simulator, started elsewhere under another heading, changes what the model predicts by rounding only."""
    env = gymnasium.make("Swimmer-v5", **arguments)
    encoder = Encoder(env.observation_space.shape[0], 2, known.find(env).observation_spec)
    rng = np.random.default_rng(0)

    def encoded(turn, place):
        positions, velocities = np.array(start[:5]), np.array(start[5:])
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        positions[:2] = rotation @ positions[:2] + place
        positions[2] += turn
        velocities[:2] = rotation @ velocities[:2]
        env.unwrapped.set_state(positions, velocities)
        before = torch.as_tensor(env.unwrapped._get_obs())
        after = torch.as_tensor(env.step(action)[0])
        return encoder.inputs(before, torch.as_tensor(action).double()), encoder.targets(before, after)

    env.reset(seed=0)
    for _ in range(10):
        start, action = rng.uniform(-1, 1, 10), rng.uniform(-1, 1, 2).astype(np.float32)
        here, there = encoded(0.0, 0.0), encoded(rng.uniform(-3, 3), rng.uniform(-5, 5, 2))
        for one, other in zip(here, there, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Swimmer-v5", "Hopper-v5", "Walker2d-v5"])
def test_why_they_are_left_open(env_id):
    """The velocity at a step's end, which is observed, is not the mean velocity in it, which is rewarded."""
    env = gymnasium.make(env_id)
    first = {"Swimmer-v5": 3}.get(env_id, env.unwrapped.model.nq - 1)
    env.reset(seed=0)
    differences = []
    for action in np.random.default_rng(0).uniform(-1, 1, (20, *env.action_space.shape)).astype(np.float32):
        observation, *_, info = env.step(action)
        differences.append(abs(observation[first] - info["x_velocity"]))
    assert np.mean(differences) > 0.003


@pytest.mark.parametrize(("env_id", "arguments"), EVERYTHING)
def test_observation_specs(env_id, arguments):
    env = gymnasium.make(env_id, **arguments)
    spec = known.find(env).observation_spec
    Encoder(env.observation_space.shape[0], env.action_space.shape[0], spec)  # indices are there, and some are left
    before, _, after, _, _, _ = rollouts(env)
    constant = list(spec.constant)
    np.testing.assert_array_equal(before[:, constant], after[:, constant])
    moving = (before != after).any(dim=0).numpy()
    # What is not declared constant moves; but random actions seldom touch the double pendulum's rail end or the object
    # to be pushed.
    seldom = {"InvertedDoublePendulum-v5": {8}, "Pusher-v5": {17, 18}}.get(env_id, set())
    assert set(np.flatnonzero(~moving).tolist()) - seldom == set(constant) - seldom
    if not hasattr(env.unwrapped, "model"):
        assert spec == ObservationSpec()
        return
    # Angles are the hinges that turn freely and are observed as they are.
    model, task = env.unwrapped.model, env.unwrapped
    hinges = [j for j in range(model.njnt) if int(model.jnt_type[j]) == mujoco.mjtJoint.mjJNT_HINGE.value]
    marks = 0.01 * np.arange(1, 1 + model.nq)
    task.set_state(marks, np.zeros(model.nv))
    observed = {int(j): np.flatnonzero(np.isclose(task._get_obs(), marks[j], atol=1e-12)) for j in hinges}
    assert set(spec.angles) == {int(i[0]) for j, i in observed.items() if len(i) and not model.jnt_limited[j]}


def test_nothing_depends_on_the_force_that_the_double_pendulums_model_leaves_out():
    env = gymnasium.make("InvertedDoublePendulum-v5")
    task, (before, action, after, *_) = known.find(env), rollouts(env)
    assert task.observation_spec.constant == task.observation_spec.not_inputs == (8,)
    forced = after.clone()
    forced[:, 8] = 10.0
    assert torch.equal(task.reward_fn(before, action, after), task.reward_fn(before, action, forced))
    assert torch.equal(task.terminated_fn(after), task.terminated_fn(forced))
    # Nor does the simulator's state: the other numbers determine it.
    simulator = env.unwrapped
    cart, sines, cosines, rates = after[7, 0], after[7, 1:3], after[7, 3:5], after[7, 5:8]
    simulator.set_state(np.append(cart, torch.atan2(sines, cosines)), rates.numpy())
    np.testing.assert_allclose(simulator._get_obs()[:8], after[7, :8], atol=1e-12)


def test_the_double_pendulums_tip():
    env = gymnasium.make("InvertedDoublePendulum-v5").unwrapped
    rng = np.random.default_rng(0)
    for _ in range(50):
        env.set_state(rng.uniform(-3, 3, 3), np.zeros(3))
        x, height = double_pendulum_tip(torch.as_tensor(env._get_obs()))
        place = env.data.site("tip").xpos
        assert (x, height) == (pytest.approx(place[0], abs=1e-14), pytest.approx(place[2], abs=1e-14))
    # A predicted pair off the unit circle stands for the same angles.
    off = torch.as_tensor(env._get_obs()) * torch.tensor([1, 3, 0.5, 3, 0.5, 1, 1, 1, 1])
    assert double_pendulum_tip(off)[1].item() == pytest.approx(height.item())


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v5", "Hopper-v5", "Walker2d-v5"])
def test_a_state_that_is_not_a_number_terminates(env_id):
    env = gymnasium.make(env_id)
    assert known.find(env).terminated_fn(torch.full(env.observation_space.shape, torch.nan))


# --- looking up ------------------------------------------------------------------------------------------------------


class Bystander(gymnasium.Wrapper):
    """Without a `step` of its own."""


class Logger(gymnasium.Wrapper):
    keeps_task = True

    def step(self, action):
        return self.env.step(action)


class Shaped(gymnasium.Wrapper):
    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        return observation, 2 * reward, *rest


def test_wrappers_that_leave_the_task_alone():
    env = gymnasium.make("Hopper-v5", **POSITIONS, healthy_reward=7.0)
    expected = known.find(env)
    assert expected.reward_fn.healthy_reward == 7.0
    assert known.find(Monitor(Logger(Bystander(wrappers.RecordEpisodeStatistics(env))))) == expected


@pytest.mark.parametrize(
    "wrap",
    [
        Shaped,
        wrappers.NormalizeObservation,
        wrappers.NormalizeReward,
        lambda env: wrappers.TransformReward(env, lambda reward: -reward),
        lambda env: wrappers.FrameStackObservation(env, 2),
        lambda env: Monitor(wrappers.ClipReward(env, -1, 1)),
    ],
)
def test_wrappers_that_may_change_the_task(wrap):
    assert known.find(gymnasium.make("Pusher-v5")) is not None
    assert known.find(wrap(gymnasium.make("Pusher-v5"))) is None


def test_a_spec_will_do():
    spec = gymnasium.make("Walker2d-v5", **POSITIONS, healthy_reward=7.0, render_mode="rgb_array").spec
    assert known.find(spec) == known.find(gymnasium.make("Walker2d-v5", **POSITIONS, healthy_reward=7.0))
    assert spec.kwargs["render_mode"] == "rgb_array"
    assert known.find(gymnasium.spec("CartPole-v1")) is None
    assert known.find(wrappers.TransformReward(gymnasium.make("Pendulum-v1"), abs).spec) is None


def test_nothing_is_known_of_other_classes_and_other_models(tmp_path):
    class Derived(HopperEnv):
        pass

    assert known.find(HopperEnv()) is not None and known.find(Derived()) is None
    path = tmp_path / "hopper.xml"
    with open(expand_model_path("hopper.xml")) as file:
        path.write_text(file.read())
    assert known.find(HopperEnv(xml_file=str(path))) is None
    assert known.find(gymnasium.make("Ant-v5")) is None
    assert known.find(gymnasium.make("CartPole-v1")) is None


def test_the_shaped_reward_of_the_pole_is_best_in_the_middle_and_nothing_once_it_fell():
    task = known.find(gymnasium.make("InvertedPendulum-v5"))
    states = 0.15 * torch.randn(500, 4, generator=torch.Generator().manual_seed(0)).double()
    states = torch.cat([states, torch.eye(4).double() * 1e6, torch.full((1, 4), torch.nan).double()])
    fallen = task.terminated_fn(states)
    assert 50 < int(fallen.sum()) < 450
    shaped = task.planning_reward_fn(states, torch.zeros(len(states), 1), states)[~fallen]
    assert bool((task.planning_reward_fn(states, torch.zeros(len(states), 1), states)[fallen][:-1] == 0.0).all())
    assert bool(((shaped > 0.0) & (shaped < 1.0)).all()), "falling never pays, nor does any state as much as the middle"
    upright = torch.zeros(1, 4).double()
    assert task.planning_reward_fn(upright, torch.zeros(1, 1), upright).item() == 1.0
    away = torch.linspace(0.0, 1.0, 20).double().unsqueeze(1) * torch.tensor([[1.0, 0.19, 2.0, 3.0]]).double()
    assert bool((task.planning_reward_fn(away, torch.zeros(20, 1), away).diff() < 0.0).all())


def test_the_shaped_reward_of_the_double_pendulum_has_the_tips_speed():
    """Against the tip's way in a short time, as the simulator has it."""
    env = gymnasium.make("InvertedDoublePendulum-v5")
    task, data = known.find(env), env.unwrapped.data
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(50):
        env.unwrapped.set_state(rng.uniform(-0.4, 0.4, 3), rng.uniform(-1.0, 1.0, 3))
        state, before = torch.from_numpy(env.unwrapped._get_obs()).unsqueeze(0), data.site_xpos[0].copy()
        tip = double_pendulum_tip(state)[0].item()
        assert tip == pytest.approx(before[0], abs=1e-12)
        time = 1e-6
        data.qpos[:] += time * data.qvel
        mujoco.mj_kinematics(env.unwrapped.model, data)
        speed = (data.site_xpos[0][0] - before[0]) / time
        own = task.reward_fn(state, torch.zeros(1, 1), state).item()
        shaped = task.planning_reward_fn(state, torch.zeros(1, 1), state).item()
        assert shaped == pytest.approx(max(0.0, own - 3 * tip**2 - 2 * speed**2), abs=1e-4)
