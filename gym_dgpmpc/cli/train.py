"""`dgpmpc train ENV_ID`."""

import os
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium
import typer

from gym_dgpmpc.cli.common import (
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    make,
    one_line_errors,
    prepare_video,
    use_threads,
)
from gym_dgpmpc.cli.request import (
    DEFAULT_AGENT,
    DEFAULT_EPISODES,
    Request,
    fill_in,
    identifying,
    new_request,
    resumed_request,
)
from gym_dgpmpc.formats import FigureFormat

if TYPE_CHECKING:
    from gym_dgpmpc.runs.training import TrainingRun

RUN = "Run"


def train(
    env_id: Annotated[
        str | None, typer.Argument(metavar="ENV_ID", help="Gymnasium id of the environment, such as ModCartPole-v0.")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Go on with the run in a folder, with all that it was begun with, in place of ENV_ID.",
            rich_help_panel=RUN,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results. An interrupted run in it goes on.",
            show_default="runs/ENV_ID-seedSEED",
            rich_help_panel=RUN,
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Start anew and delete the run in the folder.", rich_help_panel=RUN)
    ] = False,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Planned episodes, after those with random actions.",
            show_default=str(DEFAULT_EPISODES),
            rich_help_panel=RUN,
        ),
    ] = None,
    timesteps: Annotated[
        int | None,
        typer.Option(
            min=1, help="Environment steps in all, random ones included; instead of --episodes.", rich_help_panel=RUN
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Seed of everything random, the environment included.",
            show_default="0",
            rich_help_panel=RUN,
        ),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="CPU threads. More than one helps only on idle cores.",
            show_default="1",
            rich_help_panel=RUN,
        ),
    ] = None,
    progress: Annotated[
        bool | None,
        typer.Option(
            "--progress/--no-progress", help="Show a progress bar.", show_default="on a terminal", rich_help_panel=RUN
        ),
    ] = None,
    video: Annotated[
        bool | None,
        typer.Option(
            "--video/--no-video",
            help="Write a GIF of the last episode; needs OpenGL.",
            show_default="video",
            rich_help_panel=RUN,
        ),
    ] = None,
    look: Annotated[
        bool | None,
        typer.Option(
            "--look/--no-look",
            help="Log forecasts, coverage, training and planning of each episode for TensorBoard.",
            show_default="no-look",
            rich_help_panel=RUN,
        ),
    ] = None,
    formats: Annotated[
        list[FigureFormat] | None,
        typer.Option(
            "--format",
            help="Format of the figures; may be given several times.",
            show_default="png",
            rich_help_panel=RUN,
        ),
    ] = None,
    checkpoint_every: Annotated[
        int | None,
        typer.Option(
            min=1, help="Steps between checkpoints within an episode, besides the one at its end.", rich_help_panel=RUN
        ),
    ] = None,
    *,
    asked: dict[str, Any],
) -> None:
    """Train an agent, and write its results, pictures and the agent itself to a folder.

    Options that you leave out come from the preset for ENV_ID, if there is one, else from the agent's defaults.
    """
    options = {
        "episodes": episodes,
        "timesteps": timesteps,
        "threads": threads,
        "video": video,
        "look": look,
        "checkpoint_every": checkpoint_every,
        "formats": [each.value for each in formats] if formats else None,
    }
    with one_line_errors(ValueError, TypeError, OSError):
        if episodes is not None and timesteps is not None:
            raise ValueError("give either --episodes or --timesteps, not both")
        agent, given = asked.pop("agent"), {**asked, "seed": seed}
        if resume is not None:
            if overwrite or out is not None:
                raise ValueError("--resume goes on in its folder: give neither --out nor --overwrite with it")
            request = resumed_request(resume, env_id, agent, given, options)
        elif env_id is not None:
            request = new_request(env_id, out, agent, given, options)
        else:
            raise ValueError("give ENV_ID, the environment to learn in, or --resume FOLDER")
    with one_line_errors(ValueError, AssertionError, OSError):
        use_threads(request.options["threads"])
        video = request.options["video"]
        no_video = prepare_video(request.env_id) if video else "--no-video was given"
        env = make(request.env_id, render=not no_video)
        run = _set_up_run(env, request, overwrite)
    if run.is_complete:
        typer.echo(f"the run in {run.folder.path} has finished: ask for more --episodes, or --overwrite it")
        return
    if run.folder.goes_on:
        typer.echo(f"{run.folder.path} goes on after step {run.agent.num_timesteps}")
    started = time.perf_counter()
    try:
        with one_line_errors():
            run.train(progress_bar=os.isatty(1) if progress is None else progress)
    except (KeyboardInterrupt, SystemExit) as stop:
        path = run.folder.path
        told = f"the same command goes on from the checkpoint in {path}, and so does dgpmpc train --resume {path}"
        typer.echo(f"\ninterrupted; {told}")
        raise typer.Exit(EXIT_TERMINATED if isinstance(stop, SystemExit) else EXIT_INTERRUPTED) from None
    finally:
        run.folder.close()
    _summarise(run, time.perf_counter() - started)
    if video and no_video:
        typer.echo(f"no GIF: {no_video}")
    typer.echo(
        f"next: dgpmpc evaluate {run.folder.path}; dgpmpc train --resume {run.folder.path} with more --episodes learns "
        f"on; tensorboard --logdir {run.folder.path} shows the logs"
    )


def _set_up_run(env: gymnasium.Env, request: Request, overwrite: bool) -> "TrainingRun":
    """The run that is asked for."""
    from gym_dgpmpc.cli.options import AGENTS
    from gym_dgpmpc.runs.folder import RunFolder
    from gym_dgpmpc.runs.plotting import title_of
    from gym_dgpmpc.runs.training import TrainingRun, step_limit

    assert env.spec is not None
    env_id, max_steps, (_, agent, arguments, options, out) = env.spec.id, env.spec.max_episode_steps, request
    episodes, timesteps = options.pop("episodes"), options.pop("timesteps")
    if timesteps is None:
        if max_steps is None:
            raise ValueError(f"episodes of {env_id} have no time limit, so they may never end: give --timesteps")
        episodes = episodes or DEFAULT_EPISODES
        timesteps = step_limit(episodes, max_steps, arguments["learning_starts"])
    as_default = fill_in(env_id, dict.fromkeys(arguments) | {"planner": arguments["planner"]}, agent)
    settings = {"environment": env_id, "agent": agent, **identifying(arguments, agent)}
    folder = RunFolder(
        out or Path("runs") / f"{env_id}-seed{arguments['seed']}",
        settings,
        defaults={"agent": DEFAULT_AGENT, **identifying(as_default, agent)},
        overwrite=overwrite,
    )
    try:
        run = TrainingRun(
            folder,
            env,
            partial(AGENTS[agent].agent_class, **arguments),
            num_episodes=episodes,
            total_timesteps=timesteps,
            checkpoint_every=options["checkpoint_every"],
            title=title_of(settings),
            formats=options["formats"],
            look=options["look"],
        )
        folder.write_settings(episodes=episodes, timesteps=timesteps, options={"env_id": request.env_id, **options})
    except BaseException:
        folder.close()
        raise
    return run


def _summarise(run: "TrainingRun", seconds: float) -> None:
    """Say how it went and where everything is."""
    agent, folder = run.agent, run.folder
    planned = [row.episode_return for row in folder.rows() if row.actions == "planned"]
    typer.echo(f"\n{agent.num_timesteps} environment steps; this command took {seconds / 60:.1f} minutes")
    if planned:
        mean, best = sum(planned) / len(planned), max(planned)
        typer.echo(
            f"return of {len(planned)} planned episodes: mean {mean:.2f}, best {best:.2f}, last {planned[-1]:.2f}"
        )
    for file in [*run.figures, folder.agent_file, folder.episodes_file]:
        typer.echo(f"  {file}")
