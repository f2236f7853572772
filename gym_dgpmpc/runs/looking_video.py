"""An episode as a moving picture, with step, return and action drawn into it, for TensorBoard."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import Image, ImageDraw
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv
from tensorboard.compat.proto.summary_pb2 import Summary

from gym_dgpmpc.runs.recording import frame_rate
from gym_dgpmpc.runs.rendering import gif, shrink

MOST_ACTIONS = 4
"""Numbers of an action that a picture names."""


class EpisodeVideo:
    """Gathers pictures of the first environment while its episode runs.

    Args:
        env: the environments, made with ``render_mode="rgb_array"``.

    Raises:
        ValueError: they do not render such pictures.
    """

    def __init__(self, env: VecEnv):
        if env.render_mode != "rgb_array":
            raise ValueError(f'video needs an environment made with render_mode="rgb_array", got {env.render_mode!r}')
        self._env = env
        spec, metadata = env.get_attr("spec", [0])[0], env.get_attr("metadata", [0])[0]
        self._steps_per_frame, self._frames_per_second = frame_rate(metadata, spec)
        self._frames: list[ndarray] = []

    def add(self, rewards: Sequence[float], action: Float[ndarray, " A"]) -> None:
        """A picture of where the environment is, if one is due after so many steps."""
        if len(rewards) % self._steps_per_frame == 0:
            shown = " ".join(f"{value:+.2f}" for value in action[:MOST_ACTIONS])
            frame = self._env.get_images()[0]
            assert frame is not None
            self._frames.append(
                annotated(shrink(frame), f"step {len(rewards)}  return {sum(rewards):.2f}  action {shown}")
            )

    def write(self, outputs: Sequence[TensorBoardOutputFormat], step: int) -> None:
        """Give TensorBoard the episode, and begin anew."""
        frames, self._frames = self._frames, []
        if not frames:
            return
        height, width = frames[0].shape[:2]
        image = Summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=gif(frames, self._frames_per_second)
        )
        summary = Summary(value=[Summary.Value(tag="look/video", image=image)])
        for output in outputs:
            # SB3's own way to log a video needs moviepy.
            output.writer._get_file_writer().add_summary(summary, step)
            output.writer.flush()


def annotated(frame: ndarray, text: str) -> ndarray:
    """The frame [height, width, 3], uint8, with a line of text below it, white on black."""
    height, width = frame.shape[:2]
    picture = Image.new("RGB", (width, height + 16))
    picture.paste(Image.fromarray(frame))
    ImageDraw.Draw(picture).text((3, height + 2), text, fill="white")
    return np.asarray(picture)
