"""Off-screen pictures of an environment: whether this machine can draw them, and writing them as a GIF.

Without OpenGL, creating a context may raise or abort the interpreter, so it is tried first in a process of its own.
`python -m gym_dgpmpc.runs.rendering` prints the value for MUJOCO_GL that works here, if one does.
"""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy import ndarray
from PIL import Image

from gym_dgpmpc.extras import how_to_install

MAX_FRAME_WIDTH = 480
PROBE_SECONDS = 120
HOW_TO_GET_OPENGL = (
    "software rendering comes with libegl1 libegl-mesa0 libgl1-mesa-dri (Debian, Ubuntu: apt-get install) "
    "or with libosmesa6 and MUJOCO_GL=osmesa"
)
_PROBE = """
import sys
import gymnasium
import gym_dgpmpc
env = gymnasium.make(sys.argv[1], render_mode="rgb_array")
env.reset(seed=0)
assert env.render().ndim == 3
"""


class Rendering(NamedTuple):
    """Whether an environment can be drawn here; if not, ``why_not`` says so in one line."""

    possible: bool
    mujoco_gl: str | None = None
    """The value of MUJOCO_GL to set first; None: leave it as it is."""
    why_not: str = ""


def probe_rendering(env_id: str = "ModCartPole-v0") -> Rendering:
    """Draw one picture of an environment in a process of its own, with each of MuJoCo's backends until one works."""
    why_not = []
    for backend in _backends():
        environment = os.environ | ({"MUJOCO_GL": backend} if backend else {})
        reason = _try_to_draw(env_id, environment)
        if reason is None:
            return Rendering(True, backend)
        missing = re.search(r"No module named '([\w.]+)'", reason)
        if missing:  # which no other backend brings
            module = missing[1]
            told = f"{env_id} cannot be drawn without the Python module {module}: {how_to_install(module)}"
            return Rendering(False, None, told)
        why_not.append(f"{backend or 'default'}: {reason}")
    return Rendering(False, None, f"{env_id} cannot be drawn here ({'; '.join(why_not)}); {HOW_TO_GET_OPENGL}")


def shrink(frame: ndarray, max_width: int = MAX_FRAME_WIDTH) -> ndarray:
    """A rendered frame [height, width, 3], made smaller if it is wider than ``max_width`` pixels."""
    height, width = frame.shape[:2]
    if width <= max_width:
        return frame
    return np.asarray(Image.fromarray(frame).resize((max_width, round(height * max_width / width))))


def write_gif(frames: Sequence[ndarray], path: str | Path, frames_per_second: float) -> None:
    """Write frames [height, width, 3], uint8, as an endless GIF, played no faster than browsers can (50 a second).

    Raises:
        ValueError: there are no frames.
        OSError: it cannot be written; an old file is untouched.
    """
    from gym_dgpmpc.checkpoints.files import replace_file  # which takes seconds to import

    content = gif(frames, frames_per_second)

    def save(file: IO[bytes]) -> None:
        file.write(content)

    replace_file(Path(path), save)


def gif(frames: Sequence[ndarray], frames_per_second: float) -> bytes:
    """The content of such a GIF.

    Raises:
        ValueError: there are no frames.
    """
    if not frames:
        raise ValueError("a GIF needs at least one frame, got none")
    # The format counts in hundredths of a second, and browsers slow down pictures shorter than two of them.
    duration = max(round(100 / frames_per_second), 2) * 10
    # One palette for the whole episode: a palette for each frame flickers and costs space.
    middle = Image.fromarray(frames[len(frames) // 2]).quantize(128)
    images = [Image.fromarray(frame).quantize(palette=middle, dither=Image.Dither.NONE) for frame in frames]
    file = BytesIO()
    images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=False)
    return file.getvalue()


def _backends() -> list[str | None]:
    """The values of MUJOCO_GL to try, None for what is set or the platform's default."""
    if os.environ.get("MUJOCO_GL") or not sys.platform.startswith("linux"):
        return [None]
    return ["egl", "osmesa", *(["glfw"] if os.environ.get("DISPLAY") else [])]


def _try_to_draw(env_id: str, environment: dict[str, str]) -> str | None:
    """None if it works, else the reason in a few words."""
    command = [sys.executable, "-c", _PROBE, env_id]
    try:
        result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return f"no answer within {PROBE_SECONDS} s"
    if result.returncode == 0:
        return None
    # The first error in a chain is the cause; what follows it (a failing clean-up, say) is not.
    errors = re.findall(r"^(?:\S.*?\b)?(\w*Error\b.*)", result.stderr, re.MULTILINE)
    return (errors[0] if errors else f"exit status {result.returncode}")[:200]


if __name__ == "__main__":
    rendering = probe_rendering()
    if rendering.possible:
        print(rendering.mujoco_gl or os.environ.get("MUJOCO_GL", ""))
    else:
        print(rendering.why_not, file=sys.stderr)
