"""What the commands have in common: errors on one line, exit codes, threads, making an environment."""

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium
import typer

from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.extras import how_to_install, missing_module

EXIT_ERROR, EXIT_INTERRUPTED, EXIT_TERMINATED = 2, 130, 143


@contextmanager
def one_line_errors(*expected: type[Exception]) -> Iterator[None]:
    """Report this package's errors, Gymnasium's and those of the ``expected`` types in one line; others are bugs."""
    kinds: tuple[type[Exception], ...] = (DGPMPCError, gymnasium.error.Error, *expected)
    try:
        yield
    except kinds as error:
        typer.echo(f"error: {' '.join(str(error).split()) or _kind_and_place(error)}", err=True)
        raise typer.Exit(EXIT_ERROR) from error


def _kind_and_place(error: Exception) -> str:
    """Kind and place of an error without a message, such as a bare assertion in an environment."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} at {last.filename}:{last.lineno}: {last.line}"


def use_threads(threads: int) -> None:
    import torch

    torch.set_num_threads(threads)


def prepare_video(env_id: str) -> str:
    """Choose how MuJoCo draws off-screen, before it does; returns why it cannot, or an empty text."""
    from gym_dgpmpc.runs.rendering import probe_rendering

    make(env_id, render=False).close()  # so that a mistake in the id is not taken for a missing OpenGL
    rendering = probe_rendering(env_id)
    if rendering.mujoco_gl:
        os.environ["MUJOCO_GL"] = rendering.mujoco_gl
    return rendering.why_not


def agent_file(path: Path) -> Path:
    """The agent's file of a folder that `dgpmpc train` wrote, or the file itself.

    Raises:
        ValueError: there is none.
    """
    from gym_dgpmpc.checkpoints.folder import NEWEST

    file = path / NEWEST if path.is_dir() else path
    if not file.is_file():
        raise ValueError(f"expected a folder of `dgpmpc train` or an agent's file, but there is no file {file}")
    return file


def environment_of(file: Path, env_id: str | None) -> str:
    """The id that was asked for, or else that of the environment in which the file's agent was trained.

    Raises:
        ValueError: the file does not say it.
        CheckpointError: it cannot be read.
    """
    from gym_dgpmpc.checkpoints.format import read_checkpoint
    from gym_dgpmpc.checkpoints.restore import about_environment

    env_id = env_id or about_environment(read_checkpoint(file)).get("environment")
    if env_id is None:
        raise ValueError(f"{file} does not say which environment it was trained in: give --env ENV_ID")
    return env_id


def make(env_id: str, *, render: bool) -> gymnasium.Env:
    if ":" in env_id and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # the user's own module may lie here, as for `python -m`
    try:
        return gymnasium.make(env_id, render_mode="rgb_array") if render else gymnasium.make(env_id)
    except ModuleNotFoundError as error:
        module = missing_module(error) or env_id.partition(":")[0]
        told = f"the environment {env_id} needs the Python module {module}: {how_to_install(module)}"
        raise ValueError(told) from error
