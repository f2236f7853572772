"""`dgpmpc evaluate PATH`."""

from pathlib import Path
from typing import Annotated

import typer

from gym_dgpmpc.cli.common import agent_file, environment_of, make, one_line_errors, prepare_video, use_threads


def evaluate(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Folder written by `dgpmpc train`, or an agent's file.")],
    env_id: Annotated[
        str | None,
        typer.Option(
            "--env",
            metavar="ENV_ID",
            help="Gymnasium id of an environment with the same spaces.",
            show_default="the one it was trained in",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to play.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the environment's starting states.")] = 1000,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
    video: Annotated[
        Path | None, typer.Option(metavar="FILE.gif", help="Write the last episode as a GIF; needs OpenGL.")
    ] = None,
) -> None:
    """Play episodes with a trained agent, without learning, and report their returns."""
    from stable_baselines3.common.evaluation import evaluate_policy

    from gym_dgpmpc.agents import MPCAgent
    from gym_dgpmpc.runs.recording import Episode, EpisodeRecorder
    from gym_dgpmpc.runs.rendering import write_gif

    returns: list[float] = []

    def show(episode: Episode) -> None:
        returns.append(float(episode.rewards.sum()))
        typer.echo(f"episode {len(returns):3d} | {len(episode.rewards):6d} steps | return {returns[-1]:9.2f}")

    with one_line_errors(ValueError, AssertionError, OSError):
        use_threads(threads)
        file = agent_file(path)
        env_id = environment_of(file, env_id)
        no_video = prepare_video(env_id) if video else "not asked for"
        recorder = EpisodeRecorder(make(env_id, render=not no_video), show)
        agent = MPCAgent.load(file, env=recorder)
        env = agent.get_env()
        assert env is not None
        env.seed(seed)
    with one_line_errors():
        evaluate_policy(agent, env, n_eval_episodes=episodes)
    typer.echo(f"mean return {sum(returns) / len(returns):.2f}, from {min(returns):.2f} to {max(returns):.2f}")
    if video is not None and no_video:
        typer.echo(f"no GIF: {no_video}")
    elif video is not None and recorder.last is not None:
        write_gif(recorder.last.frames, video, recorder.last.frames_per_second)
        typer.echo(f"last episode: {video}")
