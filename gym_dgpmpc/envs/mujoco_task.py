"""What the package's MuJoCo tasks have in common: loading a model, checked actions, rendering, checked arguments."""

import math
from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from operator import index
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv
from numpy.typing import NDArray

from gym_dgpmpc.types import TerminatedFn


class MujocoTask(MujocoEnv):
    """A MuJoCo environment of this package, without its task: `step` and `reset_model` are a subclass's.

    Args:
        model_file: name of the MJCF file under ``envs/assets``.
        observation_size: numbers in an observation; all are unbounded float64.
        frame_skip: simulator steps in one environment step.
        render_mode: one of ``metadata["render_modes"]``, or None.
        width: of rendered images, in pixels.
        height: of rendered images, in pixels.
        camera: attributes of the viewer's camera.
        camera_name: a camera of the model, to take pictures with instead of that one.

    Raises:
        ValueError: an argument is out of its range; the message names it.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}  # noqa: RUF012

    terminated_fn: TerminatedFn | None = None
    """None means that an episode never terminates. An environment where that is unknown lacks the attribute."""

    def __init__(
        self,
        model_file: str,
        observation_size: int,
        *,
        frame_skip: int,
        render_mode: str | None,
        width: int,
        height: int,
        camera: Mapping[str, Any],
        camera_name: str | None = None,
    ) -> None:
        frame_skip, width, height = (
            whole(name, value) for name, value in (("frame_skip", frame_skip), ("width", width), ("height", height))
        )
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}; got {render_mode!r}")
        with as_file(files("gym_dgpmpc.envs") / "assets" / model_file) as path:
            super().__init__(
                str(path),
                frame_skip,
                observation_space=spaces.Box(-np.inf, np.inf, (observation_size,), np.float64),
                render_mode=render_mode,
                width=width,
                height=height,
                default_camera_config=dict(camera),
                camera_name=camera_name,
            )
        self.metadata = {**type(self).metadata, "render_fps": round(1 / self.dt)}

    def perform(self, action: NDArray[Any]) -> NDArray[Any]:
        """Simulate one environment step, and return the action as performed: a float array, clipped to the bounds.

        The reward depends on the clipped action, not on the one that was passed.

        Raises:
            ValueError: the action has another shape than the action space, or is not finite.
        """
        action, box = np.asarray(action), self.action_space
        assert isinstance(box, spaces.Box)
        if action.shape != box.shape or not np.all(np.isfinite(action)):
            raise ValueError(f"an action must be an array of shape {box.shape} of finite numbers; got {action!r}")
        if not np.issubdtype(action.dtype, np.floating):
            action = action.astype(np.float32)
        action = action.clip(box.low, box.high)
        self.do_simulation(action, self.frame_skip)
        return action

    def render(self) -> Any:
        """Draw the present state in the way ``render_mode`` says."""
        # A simulator step leaves the bodies' places one step behind, and with them a camera that follows a body.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self._make_context_current()
        return super().render()

    def close(self) -> None:
        """Release what rendering holds; harmless when done before, or when nothing was rendered."""
        viewer = self._make_context_current()
        if viewer is not None:  # freed later, with another environment's context current, it would free that one's
            viewer.con.free()
        super().close()
        self.mujoco_renderer.viewer = None

    def _make_context_current(self) -> Any:
        """Give OpenGL back to this environment's viewer, if there is one: another may have drawn in between."""
        viewer: Any = self.mujoco_renderer.viewer
        if viewer is not None:
            viewer.make_context_current()
        return viewer


def finite(name: str, value: float) -> float:
    """The value as a float.

    Raises:
        ValueError: it is not a finite number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a finite number; got {value!r}") from error
    if not math.isfinite(number):
        raise ValueError(f"{name} must be a finite number; got {value!r}")
    return number


def not_negative(name: str, value: float) -> float:
    """The value as a float.

    Raises:
        ValueError: it is not a finite number of at least 0.
    """
    if (number := finite(name, value)) < 0:
        raise ValueError(f"{name} must not be negative; got {value!r}")
    return number


def whole(name: str, value: int, least: int = 1) -> int:
    """The value as an int.

    Raises:
        ValueError: it is not a whole number of at least ``least``.
    """
    try:
        number = index(value)
    except TypeError:
        number = least - 1
    if number < least:
        what = "a positive integer" if least == 1 else f"an integer from {least} on"
        raise ValueError(f"{name} must be {what}; got {value!r}")
    return number


def point(name: str, value: Sequence[float] | NDArray[Any], what: str, size: int) -> tuple[float, ...]:
    """The value as a tuple of ``size`` floats; the error says ``what`` was expected.

    Raises:
        ValueError: it is not that many finite numbers.
    """
    coordinates = np.asarray(value, dtype=object)
    if coordinates.shape != (size,):
        raise ValueError(f"{name} must be {what}; got {value!r}")
    return tuple(finite(name, coordinate) for coordinate in coordinates)
