"""GIFs keep what they are given; where nothing can be drawn, one line says why."""

import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image, ImageSequence

from gym_dgpmpc.runs.rendering import probe_rendering, shrink, write_gif


def frames(count, height=30, width=60):
    """A white bar that moves to the right over black."""
    result = np.zeros((count, height, width, 3), dtype=np.uint8)
    for i in range(count):
        result[i, :, 5 * i : 5 * i + 5] = 255
    return list(result)


def test_gif(tmp_path):
    write_gif(frames(4), tmp_path / "a.gif", frames_per_second=25.0)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.info["duration"] == 40
        assert gif.info["loop"] == 0
        read = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(gif)]
    np.testing.assert_array_equal(read, frames(4))


def test_a_gif_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    def full_disk(image, file, *args, **kwargs):
        file.write(b"half a picture")
        raise OSError(28, "no space left on device")

    path = tmp_path / "a.gif"
    write_gif(frames(4), path, frames_per_second=25.0)
    before = path.read_bytes()
    monkeypatch.setattr(Image.Image, "save", full_disk)
    with pytest.raises(OSError, match="no space"):
        write_gif(frames(2), path, frames_per_second=25.0)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_gif_is_no_faster_than_browsers_play(tmp_path):
    write_gif(frames(2), tmp_path / "a.gif", frames_per_second=500.0)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.info["duration"] == 20


def test_gif_of_nothing(tmp_path):
    with pytest.raises(ValueError, match="frame"):
        write_gif([], tmp_path / "a.gif", frames_per_second=25.0)


def test_shrink():
    assert shrink(np.zeros((200, 400, 3), np.uint8), 100).shape == (50, 100, 3)
    small = np.zeros((20, 40, 3), np.uint8)
    assert shrink(small, 100) is small


def test_why_nothing_can_be_drawn(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no-such-backend")
    rendering = probe_rendering()
    assert not rendering.possible
    assert "no-such-backend" in rendering.why_not
    assert "libegl1" in rendering.why_not
    assert "\n" not in rendering.why_not


def test_a_missing_module_is_named_with_its_extra(monkeypatch, tmp_path):
    """Whatever OpenGL there is, Gymnasium draws the pendulum with pygame."""
    (tmp_path / "pygame.py").write_text("""raise ModuleNotFoundError("No module named 'pygame'", name="pygame")""")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    rendering = probe_rendering("Pendulum-v1")
    assert not rendering.possible
    assert rendering.why_not.endswith('without the Python module pygame: pip install "gym-dgpmpc[classic]"')


@pytest.mark.rendering
def test_the_chosen_backend_works():
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    command = [sys.executable, "-m", "gym_dgpmpc.runs.rendering"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0
    backend = result.stdout.strip()
    if not backend:
        pytest.skip(f"no OpenGL: {result.stderr.strip()}")
    script = (
        "import gymnasium, gym_dgpmpc\n"
        "env = gymnasium.make('ModCartPole-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "assert env.render().std() > 0\n"
    )
    subprocess.run([sys.executable, "-c", script], env=environment | {"MUJOCO_GL": backend}, check=True)
