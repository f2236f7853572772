"""Rendered frames show bodies and targets where they are. OpenGL is used in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import gym_dgpmpc

pytestmark = pytest.mark.rendering

NO_OPENGL = 77

SCRIPT = f"""
import os, sys
try:
    import mujoco
    if os.environ["MUJOCO_GL"] == "egl":
        from mujoco.egl import GLContext
    else:
        from mujoco.osmesa import GLContext
    context = GLContext(64, 64)
    context.make_current()
    context.free()
except Exception as error:
    print(f"{{type(error).__name__}}: {{error}}")
    sys.exit({NO_OPENGL})

import gymnasium, numpy as np, gym_dgpmpc
frames = []
for env_id in ("ModCartPole-v0", "SwingUpCartPole-v0"):
    env = gymnasium.make(env_id, render_mode="rgb_array", reset_noise_scale=0.0)
    env.reset(seed=0)
    frames.append(env.render())
    task = env.unwrapped
    for _ in range(12):
        observation = env.step(np.array([-1.5], np.float32))[0]
    frames.append(env.render())
    task.set_state(observation[:2], observation[2:])
    frames.append(env.render())
    env.close()

left, right = (gymnasium.make("SwingUpCartPole-v0", render_mode="rgb_array", target=(x, 0.6)) for x in (-1.0, 1.0))
for env in (left, right):
    env.reset(seed=0)
    env.render()
frames += [left.render(), right.render()]
right.close()
right.close()
frames.append(left.render())

others = {{}}
for env_id in ("BiasedReacher-v0", "VelocityHalfCheetah-v0", "RiskSensitiveHalfCheetah-v0"):
    env = gymnasium.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    task, others[env_id] = env.unwrapped, [env.render()]
    for _ in range(10):
        env.step(0.5 * env.action_space.high)
    others[env_id].append(env.render())
    task.set_state(task.data.qpos.copy(), task.data.qvel.copy())
    others[env_id].append(env.render())
    far = np.zeros(task.model.nq)
    far[0] = 1.0 if "Reacher" in env_id else 7.3
    task.set_state(far, np.zeros(task.model.nv))
    others[env_id].append(env.render())
    env.close()
np.savez(sys.argv[1], cartpole=frames, **others)
"""


@pytest.fixture(scope="module", params=["egl", "osmesa"])
def frames(request, tmp_path_factory):
    """Of either cart-pole: the start, after 12 steps, and after setting the state that these steps led to.

    Then one of each of two environments drawing in turn, and of the first once the second is closed. Of the others,
    by their ids: the same after 10 steps, and with the first joint turned or moved along.
    """
    path = tmp_path_factory.mktemp("frames") / "frames.npz"
    environment = {
        **os.environ,
        "MUJOCO_GL": request.param,
        "PYOPENGL_PLATFORM": request.param,
        "PYTHONPATH": str(Path(gym_dgpmpc.__file__).parents[1]),
    }
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(path)], env=environment, capture_output=True, text=True, timeout=120
    )
    if result.returncode == NO_OPENGL:
        pytest.skip(f"no OpenGL through {request.param} on this machine: {result.stdout.strip()}")
    assert result.returncode == 0, result.stderr
    return np.load(path)


def projected(offset, tilt, distance, field_of_view, width, height):
    """Where a point appears, (column, row), that is ``offset`` from what a camera looks at along y, down by a tilt."""
    x, y, z = offset
    sine, cosine = np.sin(np.radians(tilt)), np.cos(np.radians(tilt))
    depth = distance + y * cosine - z * sine
    focal_length = height / 2 / np.tan(np.radians(field_of_view) / 2)
    return width / 2 + focal_length * x / depth, height / 2 - focal_length * (y * sine + z * cosine) / depth


def pixel(x, z):
    """Where a point of the plane y = 0 appears in a picture of the cart-pole."""
    return projected((x, 0.0, z), tilt=6.0, distance=6.3, field_of_view=22.0, width=720, height=240)


def centre(frame, hue):
    """Mean (column, row) of the pixels of a colour."""
    red, green, blue = frame.astype(int).transpose(2, 0, 1)
    mask = {
        "target": (red > 120) & (green < 110) & (blue < 110) & (red - green > 80),
        "cart": (blue - red > 60) & (blue > 90),
        "pole": (red - blue > 90) & (green - blue > 40),  # and the reacher's hand
    }[hue]
    assert mask.sum() > 50, f"no {hue} to be seen"
    rows, columns = np.nonzero(mask)
    return columns.mean(), rows.mean()


@pytest.mark.parametrize(("first", "start", "target"), [(0, 2.4, 2.0), (3, 0.0, 0.0)])
def test_what_is_seen(frames, first, start, target):
    assert frames["cartpole"].shape[1:] == (240, 720, 3) and frames["cartpole"].dtype == np.uint8
    still, moved, moved_set = frames["cartpole"][first : first + 3]
    np.testing.assert_allclose(centre(still, "target"), pixel(target, 0.6), atol=2)
    np.testing.assert_allclose(centre(still, "cart"), pixel(start, 0.0), atol=3)
    np.testing.assert_allclose(centre(still, "pole"), pixel(start, -0.33), atol=6)
    assert centre(moved, "cart")[0] < centre(still, "cart")[0] - 50
    np.testing.assert_array_equal(moved, moved_set)  # the frame shows the present state, not the one before


def test_environments_do_not_disturb_one_another(frames):
    left, right, left_again = frames["cartpole"][6:]
    np.testing.assert_allclose(centre(left, "target"), pixel(-1.0, 0.6), atol=2)
    np.testing.assert_allclose(centre(right, "target"), pixel(1.0, 0.6), atol=2)
    np.testing.assert_array_equal(left_again, left)


def test_the_reacher(frames):
    still, moved, moved_set, panned = frames["BiasedReacher-v0"]
    assert still.shape == (480, 480, 3) and still.dtype == np.uint8

    def place(x, y, z):
        return projected((x - 0.35, y, z), tilt=35.0, distance=2.6, field_of_view=35.0, width=480, height=480)

    target = np.random.default_rng([0, 0]).normal((0.35, 0.05, 0.0), (0.05, 0.05, 0.1))
    for frame in (still, moved):
        np.testing.assert_allclose(centre(frame, "target"), place(*target), atol=2)
    # The middle of the hand is 0.9 m along the arm, which turns about the shoulder at y = -0.188.
    np.testing.assert_allclose(centre(still, "pole"), place(0.9, -0.188, 0.0), atol=12)
    np.testing.assert_allclose(centre(panned, "pole"), place(0.9 * np.cos(1), 0.9 * np.sin(1) - 0.188, 0.0), atol=12)
    assert np.any(still != moved)
    np.testing.assert_array_equal(moved, moved_set)


@pytest.mark.parametrize("env_id", ["VelocityHalfCheetah-v0", "RiskSensitiveHalfCheetah-v0"])
def test_the_cheetah(frames, env_id):
    still, moved, moved_set, far = frames[env_id]
    assert still.shape == (320, 480, 3) and still.dtype == np.uint8
    np.testing.assert_array_equal(moved, moved_set)
    np.testing.assert_array_equal(frames["VelocityHalfCheetah-v0"][1], moved)
    for frame in (moved, far):  # the camera goes with it, and the floor goes by
        np.testing.assert_allclose(centre(frame, "cart"), centre(still, "cart"), atol=30)
        assert np.mean(frame != still) > 0.1
