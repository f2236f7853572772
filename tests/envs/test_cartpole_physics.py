"""The simulated cart-pole against the equations of motion, derived here from the two capsules alone.

With the pole's centre of mass at distance l from the hinge, at angle phi from hanging straight down, and J the
pole's inertia about the hinge, the Lagrangian of cart (mass m) and pole (mass p) is

    T - V = (m + p) v^2 / 2 - p l cos(phi) v w + J w^2 / 2 + p g l cos(phi),    v = dx/dt, w = dtheta/dt,

with generalised forces F - v on the cart and -w on the hinge (both damping constants are 1).
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gym_dgpmpc.envs import ModCartPoleEnv, SwingUpCartPoleEnv

GRAVITY, DENSITY = 9.81, 1000.0
POLE_TIP = np.array([0.001, -0.6])  # the pole's capsule ends a millimetre off the vertical


def capsule(radius, length):
    """Mass, and inertia about a transverse axis through the centre, of a cylinder closed by two half balls."""
    tube, balls = DENSITY * np.pi * radius**2 * length, DENSITY * 4 / 3 * np.pi * radius**3
    inertia_tube = tube * (radius**2 / 4 + length**2 / 12)
    inertia_balls = balls * (2 / 5 * radius**2 + length**2 / 4 + 3 / 8 * length * radius)
    return tube + balls, inertia_tube + inertia_balls


CART_MASS, _ = capsule(0.1, 0.2)
POLE_MASS, POLE_INERTIA = capsule(0.049, np.linalg.norm(POLE_TIP))
LEVER = np.linalg.norm(POLE_TIP) / 2
HINGE_INERTIA = POLE_INERTIA + POLE_MASS * LEVER**2
TILT = np.arctan(POLE_TIP[0] / -POLE_TIP[1])  # phi = theta - TILT


def acceleration(state, force, damping=1.0):
    _, theta, v, w = state
    phi = theta - TILT
    coupling = -POLE_MASS * LEVER * np.cos(phi)
    inertia = np.array([[CART_MASS + POLE_MASS, coupling], [coupling, HINGE_INERTIA]])
    forces = np.array(
        [
            force - damping * v - POLE_MASS * LEVER * np.sin(phi) * w**2,
            -damping * w - POLE_MASS * GRAVITY * LEVER * np.sin(phi),
        ]
    )
    return np.linalg.solve(inertia, forces)


def energy(state):
    _, theta, v, w = state
    phi = theta - TILT
    kinetic = (CART_MASS + POLE_MASS) * v**2 / 2 - POLE_MASS * LEVER * np.cos(phi) * v * w + HINGE_INERTIA * w**2 / 2
    return kinetic - POLE_MASS * GRAVITY * LEVER * np.cos(phi)


def test_masses():
    env = SwingUpCartPoleEnv()
    masses = env.model.body("cart").mass[0], env.model.body("pole").mass[0]
    assert masses == pytest.approx((CART_MASS, POLE_MASS), rel=1e-12)
    assert masses == pytest.approx((10.472, 5.0186), abs=5e-5)


def test_accelerations():
    env = SwingUpCartPoleEnv()
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(50):
        state, action = rng.normal(scale=[0.5, 3.0, 2.0, 5.0]), rng.uniform(-3, 3)
        state[0] = np.clip(state[0], -2, 2)
        env.data.ctrl[:] = action
        env.set_state(state[:2], state[2:])
        np.testing.assert_allclose(env.data.qacc, acceleration(state, 100 * action), rtol=1e-9, atol=1e-9)


def test_trajectory():
    env = SwingUpCartPoleEnv()
    state, _ = env.reset(seed=0)
    worst = 0.0
    for step in range(100):
        action = np.array([np.cos(0.4 * step)])
        truth = solve_ivp(
            lambda _, s, force: np.concatenate([s[2:], acceleration(s, force)]),
            (0, env.dt),
            state,
            args=(100 * action[0],),
            method="DOP853",
            rtol=1e-11,
            atol=1e-11,
        ).y[:, -1]
        state = env.step(action)[0]
        assert abs(state[0]) < 2.4
        worst = max(worst, np.abs(state - truth).max())
    # Two RK4 steps of 0.02 s, from rates below 10 rad/s: local error (10 * 0.02)^5 / 120 = 3e-6 rad, times the rate.
    assert worst < 1e-4


def test_energy_is_kept_without_damping():
    env = SwingUpCartPoleEnv()
    env.reset(seed=0)
    env.model.dof_damping[:] = 0.0
    env.set_state(np.array([0.0, 2.5]), np.array([0.2, 0.0]))
    before = energy(np.concatenate([env.data.qpos, env.data.qvel]))
    swing = POLE_MASS * GRAVITY * 2 * LEVER
    for _ in range(100):
        state = env.step(np.zeros(1))[0]
        assert abs(state[0]) < 2.4
        assert energy(state) == pytest.approx(before, abs=1e-3 * swing)


def test_damping_brings_the_pole_to_rest():
    env = SwingUpCartPoleEnv()
    env.reset(seed=0)
    env.set_state(np.array([0.0, 1.0]), np.zeros(2))
    for _ in range(500):
        state = env.step(np.zeros(1))[0]
    # The cart's friction is weak for its mass: of its first drift exp(-20 s * 1 N s/m / 15.5 kg) = 0.27 is left.
    np.testing.assert_allclose(state[1:], [TILT, 0, 0], atol=5e-3)


@pytest.mark.parametrize("side", [-1, 1])
def test_the_end_of_the_rail_is_soft(side):
    env = SwingUpCartPoleEnv(reset_noise_scale=0.0)
    env.reset(seed=0)
    positions = side * np.array([env.step(np.array([3.0 * side]))[0][0] for _ in range(500)])
    assert positions.max() == pytest.approx(2.646, abs=0.01)  # the impact passes the limit ...
    assert 2.5 < positions[-50:].mean() < 2.6  # ... and the force then holds the cart against the spring
    assert np.ptp(positions[-50:]) < 0.01


def test_a_positive_force_drives_the_modified_task_into_the_end():
    env = ModCartPoleEnv()
    for seed in range(20):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        positions = [env.step(rng.uniform(0, 3, 1))[0][0] for _ in range(10)]
        assert max(positions) > 2.5


def test_frame_skip_only_sets_how_often_one_decides():
    coarse, fine = SwingUpCartPoleEnv(), SwingUpCartPoleEnv(frame_skip=1)
    coarse.reset(seed=0), fine.reset(seed=0)
    for step in range(20):
        action = np.array([np.sin(step)])
        fine.step(action)
        np.testing.assert_array_equal(coarse.step(action)[0], fine.step(action)[0])
