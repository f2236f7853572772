"""The reacher: its arm against hand calculation, its reward, and who sees which targets when."""

import re

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from stable_baselines3.common.env_util import make_vec_env

from gym_dgpmpc.envs import BiasedReacherEnv, Reacher7DoFEnv, ReacherReward
from gym_dgpmpc.envs.reacher7dof import fingertip
from tests.envs.common import play, uniform_actions

TIP_AT_START = np.array([0.98928, -0.188, 0.0])
STILL = np.zeros(7, np.float32)


def ball(radius):
    return 1000 * 4 / 3 * np.pi * radius**3


def capsule(radius, length):
    return ball(radius) + 1000 * np.pi * radius**2 * length


def inertia_about_the_middle(radius, start, end):
    """Of a capsule: a cylinder from start to end and half a ball at either end."""
    way = np.subtract(end, start)
    length = np.linalg.norm(way)
    balls, cylinder = ball(radius), capsule(radius, length) - ball(radius)
    along = cylinder * radius**2 / 2 + balls * 2 / 5 * radius**2
    across = cylinder * (radius**2 / 4 + length**2 / 12)
    across += balls * (2 / 5 * radius**2 + length**2 / 4 + 3 / 8 * length * radius)
    direction = way / (length or 1.0)
    return across * np.eye(3) + (along - across) * np.outer(direction, direction)


def centre_and_inertia(capsules):
    """Of a body's capsules together: the centre of mass (3,), and the inertia (3, 3) about it in the body's axes."""
    middles = np.array([np.add(start, end) / 2 for _, start, end in capsules])
    masses = np.array([capsule(radius, np.linalg.norm(np.subtract(end, start))) for radius, start, end in capsules])
    centre = masses @ middles / masses.sum()
    inertia = sum(inertia_about_the_middle(*shape) for shape in capsules)
    for mass, offset in zip(masses, middles - centre, strict=True):
        inertia = inertia + mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return centre, inertia


def targets(env, resets):
    """The target after each reset, with one step before the next."""
    found = []
    for arguments in resets:
        found.append(env.reset(**arguments)[0][7:10])
        env.step(STILL)
    return np.array(found)


# --- the arm ---------------------------------------------------------------------------------------------------------


def test_masses():
    finger = capsule(0.01, np.hypot(0.09137, 0.00495))
    expected = {
        "shoulder_pan": capsule(0.1, 0.6) + 2 * ball(0.05) + 2 * ball(0.03),
        "shoulder_lift": capsule(0.1, 0.2),
        "upper_arm_roll": capsule(0.02, 0.2),
        "upper_arm": capsule(0.06, 0.4),
        "elbow": capsule(0.06, 0.04),
        "forearm_roll": capsule(0.02, 0.2),
        "forearm": capsule(0.05, 0.321),
        "wrist_flex": capsule(0.01, 0.04),
        "wrist_roll": capsule(0.01, 0.04),
        "palm": capsule(0.05, 0.04),
        "left_finger": finger,
        "left_fingertip": capsule(0.01, 0.09137),
        "right_finger": finger,
        "right_fingertip": capsule(0.01, 0.09137),
        "target": 0.0,
        "world": 0.0,
    }
    model = Reacher7DoFEnv().model
    masses = {model.body(i).name: model.body_mass[i] for i in range(model.nbody)}
    assert masses == pytest.approx(expected, rel=1e-12)
    published = [24.31, 10.47, 0.285, 5.43, 1.36, 0.285, 3.04, 0.017, 0.017, 0.838, 0.033, 0.033, 0.033, 0.033]
    np.testing.assert_allclose(model.body_mass[2:], published, atol=6e-3)
    assert model.body_mass.sum() == pytest.approx(46.19, abs=5e-3)


def test_where_each_link_has_its_mass():
    """Every body is capsules between two points of its own frame; an eye is one between a point and itself."""
    eyes = [(0.05, (x, 0.05, 0.2), (x, 0.05, 0.2)) for x in (0.06, -0.06)]
    pupils = [(0.03, (x, 0.09, 0.2), (x, 0.09, 0.2)) for x in (0.06, -0.06)]
    links = {
        "shoulder_pan": [(0.1, (0, 0, -0.4), (0, 0, 0.2)), *eyes, *pupils],
        "shoulder_lift": [(0.1, (0, -0.1, 0), (0, 0.1, 0))],
        "upper_arm_roll": [(0.02, (-0.1, 0, 0), (0.1, 0, 0))],
        "upper_arm": [(0.06, (0, 0, 0), (0.4, 0, 0))],
        "elbow": [(0.06, (0, -0.02, 0), (0, 0.02, 0))],
        "forearm_roll": [(0.02, (-0.1, 0, 0), (0.1, 0, 0))],
        "forearm": [(0.05, (0, 0, 0), (0.321, 0, 0))],
        "wrist_flex": [(0.01, (0, -0.02, 0), (0, 0.02, 0))],
        "wrist_roll": [(0.01, (-0.02, 0, 0), (0.02, 0, 0))],
        "palm": [(0.05, (0.05, 0, -0.02), (0.05, 0, 0.02))],
        "left_finger": [(0.01, (0, 0, 0), (0.09137, 0.00495, 0))],
        "left_fingertip": [(0.01, (0, 0, 0), (0.09137, 0, 0))],
        "right_finger": [(0.01, (0, 0, 0), (0.09137, -0.00495, 0))],
        "right_fingertip": [(0.01, (0, 0, 0), (0.09137, 0, 0))],
    }
    model = Reacher7DoFEnv().model
    assert links.keys() == {model.body(i).name for i in range(model.nbody)} - {"world", "target"}
    for name, capsules in links.items():
        body = model.body(name)
        centre, inertia = centre_and_inertia(capsules)
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, body.iquat)
        axes = axes.reshape(3, 3)
        np.testing.assert_allclose(body.ipos, centre, rtol=0, atol=1e-12, err_msg=name)
        found = axes @ np.diag(body.inertia) @ axes.T
        np.testing.assert_allclose(found, inertia, rtol=0, atol=1e-9 * np.trace(inertia), err_msg=name)


def test_joints_and_simulation():
    model = Reacher7DoFEnv().model
    assert (model.nq, model.nv, model.nu) == (7, 7, 7)
    np.testing.assert_array_equal(model.dof_damping, [10, 10, 0.1, 1, 0.1, 0.1, 0.1])
    np.testing.assert_array_equal(model.dof_armature, np.full(7, 0.04))
    np.testing.assert_array_equal(model.jnt_axis, np.eye(3)[[2, 1, 0, 1, 0, 1, 0]])
    np.testing.assert_array_equal(model.jnt_limited, [1, 1, 1, 1, 0, 1, 0])
    assert model.opt.timestep == 0.01 and int(model.opt.integrator) == mujoco.mjtIntegrator.mjINT_RK4.value
    assert not model.opt.gravity.any() and not model.geom_contype.any() and not model.geom_conaffinity.any()


def test_fingertip_is_the_simulators():
    env, rng = Reacher7DoFEnv(), np.random.default_rng(0)
    angles = rng.uniform(-4, 4, (200, 7))
    places = fingertip(torch.as_tensor(angles)).numpy()
    for q, place in zip(angles, places, strict=True):
        env.data.qpos[:] = q
        mujoco.mj_kinematics(env.model, env.data)
        fingers = (env.data.body("left_fingertip").xpos + env.data.body("right_fingertip").xpos) / 2
        # Six rotations of lengths below 1 m, each rounded to 2^-53.
        np.testing.assert_allclose(place, fingers, rtol=0, atol=2e-15)
        np.testing.assert_allclose(place, env.data.site("fingertip").xpos, rtol=0, atol=2e-15)
    np.testing.assert_allclose(fingertip(torch.zeros(2, 3, 7)).numpy(), np.tile(TIP_AT_START, (2, 3, 1)), atol=1e-7)


def test_the_arm_does_not_feel_the_target():
    outcomes = []
    for mean in ((0.35, 0.05, 0.0), (0.9, -0.188, 0.0)):  # the second is inside the stretched arm
        env = Reacher7DoFEnv(target_mean=mean, target_std=(0, 0, 0))
        env.reset(seed=0)
        outcomes.append([env.step(action)[0] for action in uniform_actions(env.action_space, 50, seed=0)])
    arm = [i for i in range(17) if i not in (7, 8, 9)]
    np.testing.assert_array_equal(np.array(outcomes[0])[:, arm], np.array(outcomes[1])[:, arm])
    assert np.all(np.array(outcomes[1])[:, 7:10] == (0.9, -0.188, 0.0))


def test_free_rolls_may_be_read_as_angles():
    """A whole turn of the forearm's or the wrist's roll changes nothing, which is what ``angles`` tells a model."""
    env = Reacher7DoFEnv(target_std=(0, 0, 0))
    turns = np.array([0, 0, 0, 0, 2 * np.pi, 0, -4 * np.pi])
    outcomes = []
    for turn in (np.zeros(7), turns):
        env.reset(seed=0)
        rng = np.random.default_rng(1)
        env.set_state(rng.uniform(-0.5, 0.0, 7) + turn, rng.normal(size=7))
        outcomes.append([env.step(action)[0] for action in uniform_actions(env.action_space, 5, seed=0)])
    plain, turned = np.array(outcomes[0]), np.array(outcomes[1])
    turned[:, :7] -= turns
    np.testing.assert_allclose(turned, plain, atol=1e-9)


# --- reward ----------------------------------------------------------------------------------------------------------


def test_reward_by_hand():
    after = torch.zeros(3, 17, dtype=torch.float64)
    after[0, 7:10] = torch.as_tensor(TIP_AT_START)
    after[1, 7:10] = torch.as_tensor(TIP_AT_START) + torch.tensor([0.3, 0.0, -0.4])
    after[2, 0] = torch.pi / 2  # panned to the left: the tip is at (0, 0.98928 - 0.188, 0)
    after[2, 7:10] = torch.tensor([1.0, 0.98928 - 0.188, 0.0])
    action = torch.zeros(3, 7, dtype=torch.float64)
    action[1], action[2, 6] = 1.0, -90.0
    reward = ReacherReward(ctrl_cost_weight=0.1)(torch.zeros_like(after), action, after)
    np.testing.assert_allclose(reward, [0.0, -0.25 - 0.7, -1.0 - 40.0], atol=1e-12)


def test_info_explains_the_reward():
    env = BiasedReacherEnv()
    _, reset_info = env.reset(seed=0)
    assert reset_info == {"distance_to_target": pytest.approx(np.linalg.norm(TIP_AT_START - env.data.mocap_pos[0]))}
    for action in uniform_actions(env.action_space, 20, seed=0):
        observation, _, _, _, info = env.step(action)
        mujoco.mj_kinematics(env.model, env.data)
        distance = np.linalg.norm(env.data.site("fingertip").xpos - observation[7:10])
        assert info["distance_to_target"] == pytest.approx(distance, rel=1e-12)
        assert info["reward_distance"] == pytest.approx(-(distance**2), rel=1e-12)
        assert info["reward_control"] == pytest.approx(-0.01 * np.sum(action.astype(float) ** 2), rel=1e-12)


@pytest.mark.parametrize("env_id", ["Reacher7DoF-v0", "BiasedReacher-v0"])
def test_returns_of_random_and_idle_episodes(env_id):
    """Known anchors: about -1490 at random and -181 idle with PETS's targets, -1440 and -72 with the paper's."""
    num_episodes, env = 8, gymnasium.make(env_id)
    idle, random, expected = [], [], []
    for seed in range(num_episodes):
        option = {"options": {"episode": seed}}
        expected.append(-150 * np.sum((TIP_AT_START - env.reset(seed=seed, **option)[0][7:10]) ** 2))
        idle.append(sum(env.step(STILL)[1] for _ in range(150)))
        env.reset(seed=seed, **option)
        random.append(sum(env.step(action)[1] for action in uniform_actions(env.action_space, 150, seed)))
    # Without gravity the arm stays where it is, but for the elbow at the very end of its range, which gives a little.
    np.testing.assert_allclose(idle, expected, rtol=1e-6)
    mean, spread = {"Reacher7DoF-v0": ((-181, -1490), 33), "BiasedReacher-v0": ((-72, -1440), 11)}[env_id]
    # The idle return's spread follows from the target's: 150 * 2 * |tip - target| times its standard deviation.
    assert np.mean(idle) == pytest.approx(mean[0], abs=4 * spread / np.sqrt(num_episodes))
    # The torques cost 0.01 * 150 * 7 * 20^2 / 3 = 1400 +- 0.01 * 20^2 * sqrt(150 * 7 * 4 / 45) = 39.
    assert np.mean(random) == pytest.approx(mean[1], abs=4 * 45 / np.sqrt(num_episodes))


# --- targets ---------------------------------------------------------------------------------------------------------


def test_distribution_of_the_targets():
    num_resets = 1000
    error = 4 / np.sqrt(num_resets)  # four standard errors, in standard deviations
    for env, mean, std in (
        (Reacher7DoFEnv(), (0, 0.25, 0), (0.1, 0.1, 0.1)),
        (BiasedReacherEnv(), (0.35, 0.05, 0), (0.05, 0.05, 0.1)),
    ):
        env.reset(seed=0)
        starts = np.array([env.reset(options={"episode": k})[0] for k in range(num_resets)])
        found = (starts[:, 7:10] - mean) / std
        assert np.all(np.abs(found.mean(0)) < error)
        assert np.all(np.abs(found.std(0) - 1) < error)
        assert np.all(np.abs(np.corrcoef(found.T) - np.eye(3)) < error)
        assert not starts[:, [i for i in range(17) if i not in (7, 8, 9)]].any()


def test_the_papers_targets_are_the_same_everywhere():
    """Published returns are over these targets, so they must never change."""
    env = gymnasium.make("BiasedReacher-v0")
    first = targets(env, [{"seed": 1}, {}, {}])
    expected = [
        [0.35628651, 0.04339476, 0.06404227],
        [0.35514838, 0.00097364, -0.08174783],
        [0.32000748, 0.03247412, -0.10038959],
    ]
    np.testing.assert_allclose(first, expected, atol=1e-7)


def test_targets_do_not_depend_on_the_seed_of_the_run():
    env = gymnasium.make("BiasedReacher-v0")
    sequence = targets(env, [{"seed": 1}, {}, {}, {}])
    assert len(np.unique(sequence, axis=0)) == 4
    np.testing.assert_array_equal(targets(env, [{"seed": 2}, {}, {}, {}]), sequence)
    np.testing.assert_array_equal(targets(gymnasium.make("BiasedReacher-v0"), [{}, {}, {}, {}]), sequence)
    other = targets(gymnasium.make("BiasedReacher-v0", target_seed=1), [{}, {}, {}, {}])
    assert not np.any(other == sequence)


def test_a_reset_before_the_first_step_repeats_the_target():
    env = gymnasium.make("BiasedReacher-v0")
    sequence = targets(env, [{"seed": 1}, {}, {}])
    env.reset(seed=9), env.reset(), env.reset()
    np.testing.assert_array_equal(targets(env, [{}, {}, {}]), sequence)


def test_an_episode_can_be_asked_for():
    env = gymnasium.make("BiasedReacher-v0")
    sequence = targets(env, [{"seed": 1}, {}, {}, {}])
    asked = targets(env, [{"seed": 5, "options": {"episode": 2}}, {}, {"options": {"episode": 0}}, {"options": {}}])
    np.testing.assert_array_equal(asked, sequence[[2, 3, 0, 1]])


def test_an_episode_that_cannot_be(unchecked):
    env = BiasedReacherEnv()
    for wrong in (-1, 1.5, "2"):
        with pytest.raises(ValueError, match=rf'options\["episode"\] .*{re.escape(repr(wrong))}$'):
            env.reset(options={"episode": wrong})


def test_each_copy_in_a_vector_environment_goes_through_the_sequence():
    sequence = targets(gymnasium.make("BiasedReacher-v0"), [{}, {}, {}])
    vector_env = gymnasium.make_vec("BiasedReacher-v0", num_envs=2, max_episode_steps=2)
    seen = [vector_env.reset(seed=3)[0]]
    seen += [vector_env.step(np.zeros((2, 7), np.float32))[0] for _ in range(8)]
    seen = np.array(seen)[:, :, 7:10]  # the reset takes a step of its own: three observations to an episode
    np.testing.assert_array_equal(seen, np.repeat(sequence, 3, axis=0)[:, None].repeat(2, axis=1))

    sb3_env = make_vec_env("BiasedReacher-v0", n_envs=2, seed=11)
    seen = [sb3_env.reset()[:, 7:10]]
    for _ in range(301):
        seen.append(sb3_env.step(np.zeros((2, 7), np.float32))[0][:, 7:10])
    expected = sequence[[0, 0, 1, 1, 2]][:, None].repeat(2, axis=1)
    np.testing.assert_array_equal(np.array(seen)[[0, 149, 150, 299, 300]], expected)


def test_without_a_target_seed_targets_follow_the_reset():
    for env in (gymnasium.make("Reacher7DoF-v0"), gymnasium.make("BiasedReacher-v0", target_seed=None)):
        first = targets(env, [{"seed": 1}, {}, {"seed": 2}, {"options": {"episode": 0}}])
        assert len(np.unique(first, axis=0)) == 4
        np.testing.assert_array_equal(targets(env, [{"seed": 1}, {}]), first[:2])
        env.reset(seed=1)
        np.testing.assert_array_equal(env.reset()[0][7:10], first[1])  # no step in between, and yet another target


def test_arguments_are_used():
    env = gymnasium.make(
        "BiasedReacher-v0", target_mean=np.ones(3), target_std=(0, 0, 0), ctrl_cost_weight=0.5, frame_skip=1
    )
    observations, rewards, _ = play(env, np.ones((1, 7), np.float32), seed=0)
    np.testing.assert_array_equal(observations[:, 7:10], np.ones((2, 3)))
    assert rewards[0] < -0.5 * 7
    assert env.unwrapped.dt == pytest.approx(0.01) and env.unwrapped.metadata["render_fps"] == 100


@pytest.mark.parametrize(
    ("name", "value", "received"),
    [
        ("target_mean", (1.0, 2.0), "(1.0, 2.0)"),
        ("target_std", (1.0, 2.0, -1.0), "-1.0"),
        ("target_std", (1.0, 2.0, float("inf")), "inf"),
        ("target_seed", -1, "-1"),
    ],
)
def test_bad_arguments_are_named(name, value, received):
    with pytest.raises(ValueError, match=rf"{name} .*{re.escape(received)}$"):
        BiasedReacherEnv(**{name: value})
