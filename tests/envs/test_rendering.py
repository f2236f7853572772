"""Rendered frames show cart, pole and target where they are. OpenGL is used in a process of its own."""

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
np.save(sys.argv[1], frames)
"""


@pytest.fixture(scope="module", params=["egl", "osmesa"])
def frames(request, tmp_path_factory):
    """Of either task: the start, after 12 steps, and after setting the state that these steps led to.

    Then one of each of two environments drawing in turn, and of the first once the second is closed.
    """
    path = tmp_path_factory.mktemp("frames") / "frames.npy"
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


def pixel(x, z, width=720, height=240):
    """Where a point of the plane y = 0 appears, (column, row): a camera 6.3 m away, looking down by 6 degrees."""
    tilt = np.radians(6.0)
    depth = 6.3 - z * np.sin(tilt)
    focal_length = height / 2 / np.tan(np.radians(22.0) / 2)
    return width / 2 + focal_length * x / depth, height / 2 - focal_length * z * np.cos(tilt) / depth


def centre(frame, hue):
    """Mean (column, row) of the pixels of a colour."""
    red, green, blue = frame.astype(int).transpose(2, 0, 1)
    mask = {
        "target": (red > 120) & (green < 110) & (blue < 110) & (red - green > 80),
        "cart": (blue - red > 60) & (blue > 90),
        "pole": (red - blue > 90) & (green - blue > 40),
    }[hue]
    assert mask.sum() > 50, f"no {hue} to be seen"
    rows, columns = np.nonzero(mask)
    return columns.mean(), rows.mean()


@pytest.mark.parametrize(("first", "start", "target"), [(0, 2.4, 2.0), (3, 0.0, 0.0)])
def test_what_is_seen(frames, first, start, target):
    assert frames.shape[1:] == (240, 720, 3) and frames.dtype == np.uint8
    still, moved, moved_set = frames[first : first + 3]
    np.testing.assert_allclose(centre(still, "target"), pixel(target, 0.6), atol=2)
    np.testing.assert_allclose(centre(still, "cart"), pixel(start, 0.0), atol=3)
    np.testing.assert_allclose(centre(still, "pole"), pixel(start, -0.33), atol=6)
    assert centre(moved, "cart")[0] < centre(still, "cart")[0] - 50
    np.testing.assert_array_equal(moved, moved_set)  # the frame shows the present state, not the one before


def test_environments_do_not_disturb_one_another(frames):
    left, right, left_again = frames[6:]
    np.testing.assert_allclose(centre(left, "target"), pixel(-1.0, 0.6), atol=2)
    np.testing.assert_allclose(centre(right, "target"), pixel(1.0, 0.6), atol=2)
    np.testing.assert_array_equal(left_again, left)
