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
from gym_dgpmpc.settings import refuse_unknown

if TYPE_CHECKING:
    from gym_dgpmpc.runs.training import TrainingRun

DEFAULT_EPISODES = 15
DEFAULT_AGENT = "dgp-mpc"
RUN = "Run"


def train(
    env_id: Annotated[
        str, typer.Argument(metavar="ENV_ID", help="Gymnasium id of the environment, such as ModCartPole-v0.")
    ],
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
        int, typer.Option(min=0, help="Seed of everything random, the environment included.", rich_help_panel=RUN)
    ] = 0,
    threads: Annotated[
        int,
        typer.Option(min=1, help="CPU threads. More than one helps only on idle cores.", rich_help_panel=RUN),
    ] = 1,
    progress: Annotated[
        bool | None,
        typer.Option(
            "--progress/--no-progress", help="Show a progress bar.", show_default="on a terminal", rich_help_panel=RUN
        ),
    ] = None,
    video: Annotated[
        bool,
        typer.Option("--video/--no-video", help="Write a GIF of the last episode; needs OpenGL.", rich_help_panel=RUN),
    ] = True,
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
    agent = asked.pop("agent") or DEFAULT_AGENT
    with one_line_errors(ValueError, TypeError):
        arguments = _fill_in(env_id, {**asked, "seed": seed}, agent)
    with one_line_errors(ValueError, AssertionError, OSError):
        if episodes is not None and timesteps is not None:
            raise ValueError("give either --episodes or --timesteps, not both")
        use_threads(threads)
        no_video = prepare_video(env_id) if video else "--no-video was given"
        env = make(env_id, render=not no_video)
        run = _set_up_run(env, agent, arguments, out, overwrite, episodes, timesteps, checkpoint_every)
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
        typer.echo(f"\ninterrupted; the same command goes on from the checkpoint in {run.folder.path}")
        raise typer.Exit(EXIT_TERMINATED if isinstance(stop, SystemExit) else EXIT_INTERRUPTED) from None
    finally:
        run.folder.close()
    _summarise(run, time.perf_counter() - started)
    if video and no_video:
        typer.echo(f"no GIF: {no_video}")
    typer.echo(
        f"next: dgpmpc evaluate {run.folder.path}; the same command with more --episodes learns on; "
        f"tensorboard --logdir {run.folder.path} shows the logs"
    )


def _set_up_run(
    env: gymnasium.Env,
    agent: str,
    arguments: dict[str, Any],
    out: Path | None,
    overwrite: bool,
    episodes: int | None,
    timesteps: int | None,
    checkpoint_every: int | None,
) -> "TrainingRun":
    """The run that the options describe."""
    from gym_dgpmpc.cli.options import AGENTS
    from gym_dgpmpc.runs.folder import RunFolder
    from gym_dgpmpc.runs.training import TrainingRun, step_limit

    assert env.spec is not None
    env_id, max_steps = env.spec.id, env.spec.max_episode_steps
    if timesteps is None:
        if max_steps is None:
            raise ValueError(f"episodes of {env_id} have no time limit, so they may never end: give --timesteps")
        episodes = episodes or DEFAULT_EPISODES
        timesteps = step_limit(episodes, max_steps, arguments["learning_starts"])
    folder = RunFolder(
        out or Path("runs") / f"{env_id}-seed{arguments['seed']}",
        {"environment": env_id, "agent": agent, **_identifying(arguments, agent)},
        defaults={"agent": DEFAULT_AGENT}
        | _identifying(_fill_in(env_id, dict.fromkeys(arguments) | {"planner": arguments["planner"]}, agent), agent),
        overwrite=overwrite,
    )
    try:
        run = TrainingRun(
            folder,
            env,
            partial(AGENTS[agent].agent_class, **arguments),
            num_episodes=episodes,
            total_timesteps=timesteps,
            checkpoint_every=checkpoint_every,
            title=f"{env_id}, {_model(arguments)}, seed {arguments['seed']}",
        )
        folder.write_settings(episodes=episodes, timesteps=timesteps)
    except BaseException:
        folder.close()
        raise
    return run


def _model(arguments: dict[str, Any]) -> str:
    """What a title says of the agent's model."""
    if "members" in arguments:
        return " and ".join(arguments["members"])
    return f"L = {arguments['num_layers']}, {arguments['kernel']}"


def _fill_in(env_id: str, asked: dict[str, Any], agent: str = DEFAULT_AGENT) -> dict[str, Any]:
    """Every argument: as given, else from the preset for the environment, else the agent's default.

    Raises:
        TypeError: a setting that the agent with this planner does not have was given.
    """
    from gym_dgpmpc.cli.options import AGENTS

    agent_class, settings_for = AGENTS[agent]
    given, preset = {name: value for name, value in asked.items() if value is not None}, settings_for(env_id)
    planner = given.setdefault("planner", preset.get("planner", "cem"))
    known = {**agent_class.own_settings(), **agent_class.part_settings(planner)}
    others = {"planner", "reward_fn", "terminated_fn"}
    refuse_unknown(f"an agent {agent} that plans by {planner}", given, {*known, *others})
    filled = {name: known[name].default if name in known else None for name in asked if name in {*known, *others}}
    filled |= {name: value for name, value in preset.items() if name in known}
    if "num_candidates" in given and "num_elites" in filled:
        filled["num_elites"] = None  # the preset's elites are a part of the preset's candidates
    return filled | given


def _identifying(arguments: dict[str, Any], agent: str) -> dict[str, Any]:
    """The arguments that tell one run from another; settings that depend on the machine do not."""
    from gym_dgpmpc.cli.options import AGENTS

    settings = AGENTS[agent].agent_class.part_settings(arguments["planner"])
    return {name: value for name, value in arguments.items() if name not in settings or settings[name].is_saved}


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
