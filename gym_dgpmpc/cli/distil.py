"""`dgpmpc distil PATH`: from a trained agent to a policy that acts by itself."""

from pathlib import Path
from typing import Annotated

import typer

from gym_dgpmpc.cli.common import agent_file, environment_of, make, one_line_errors, use_threads

POLICY = "policy.zip"


def distil(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Folder written by `dgpmpc train`, or an agent's file.")],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.zip", help="File of the policy.", show_default=f"{POLICY} beside the agent's file"),
    ] = None,
    export: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Also write it as TorchScript (.pt) or ONNX (.onnx); may be given twice."),
    ] = None,
    env_id: Annotated[
        str | None,
        typer.Option(
            "--env",
            metavar="ENV_ID",
            help="Gymnasium id of an environment with the same spaces, for its rewards.",
            show_default="the one it was trained in",
        ),
    ] = None,
    algorithm: Annotated[
        str,
        typer.Option(
            help="SAC, TD3, DDPG, PPO or A2C of Stable-Baselines3; TQC or CrossQ of sb3-contrib; or gradient, through "
            "the worlds' derivatives."
        ),
    ] = "SAC",
    timesteps: Annotated[
        int | None,
        typer.Option(min=1, help="Imagined steps to learn from, at most.", show_default="what suits the algorithm"),
    ] = None,
    worlds: Annotated[int, typer.Option(min=1, help="Worlds side by side.")] = 20,
    episode_steps: Annotated[
        int | None,
        typer.Option(min=1, help="Steps of an imagined episode.", show_default="the environment's, at most 200"),
    ] = None,
    trial_every: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Imagined steps between two trials in held-out worlds.",
            show_default="what suits the algorithm",
        ),
    ] = None,
    patience: Annotated[int, typer.Option(min=1, help="Trials without a better one, after which it is done.")] = 8,
    encoded: Annotated[
        bool,
        typer.Option(
            help="Feed the policy angles as sine and cosine, and everything in units of its spread; its file then "
            "names a class of this package. Without, the file needs nothing but Stable-Baselines3."
        ),
    ] = True,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed.", show_default="the agent's")] = None,
    episodes: Annotated[
        int, typer.Option(min=0, help="Episodes to play with it in the real environment when it is done.")
    ] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
) -> None:
    """Train a policy in worlds drawn from the agent's model, for actions in a fraction of a millisecond.

    The file is one of Stable-Baselines3's. The environment is not asked, but for its rewards, unless --episodes says
    so.
    """
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    from gym_dgpmpc.agents import MPCAgent
    from gym_dgpmpc.agents.bars import Bars
    from gym_dgpmpc.imagination.algorithms import algorithm_class, budget_of
    from gym_dgpmpc.imagination.export import check_suffix, export_policy
    from gym_dgpmpc.imagination.policies import Trial, imagine

    def show(trial: Trial) -> None:
        earned = f"return in held-out worlds {trial.mean_return:9.2f} +- {trial.standard_error:.2f}"
        typer.echo(f"{trial.timesteps:7d} imagined steps | {earned}")

    with one_line_errors(ValueError, TypeError, AssertionError, OSError):
        use_threads(threads)
        file = agent_file(path)
        out = file.parent / POLICY if out is None else out
        for each in export or []:
            check_suffix(each)
        env = Monitor(make(environment_of(file, env_id), render=False))
        agent = MPCAgent.load(file, env=env)
        with Bars(True) as bars:
            timesteps = timesteps or budget_of(algorithm_class(algorithm)).total_timesteps
            bars.begin(timesteps)
            found = imagine(
                agent,
                algorithm,
                timesteps,
                num_worlds=worlds,
                episode_steps=episode_steps,
                trial_every=trial_every,
                patience=patience,
                encoded=encoded,
                seed=seed,
                on_trial=show,
                on_progress=bars.step,
            )
        found.model.save(out)
        written = [out, *(export_policy(found.model, each) for each in export or [])]
    typer.echo(
        f"best after {found.best.timesteps} imagined steps; return in fresh worlds {found.fresh.mean_return:.2f} +- "
        f"{found.fresh.standard_error:.2f}; {found.seconds:.0f} s"
    )
    if episodes:
        with one_line_errors():
            env.reset(seed=1000)
            returns, _ = evaluate_policy(found.model, env, episodes, return_episode_rewards=True)
        assert isinstance(returns, list)
        typer.echo(
            f"in the environment: mean return of {episodes} episodes {sum(returns) / episodes:.2f}, from "
            f"{min(returns):.2f} to {max(returns):.2f}"
        )
    for each in written:
        typer.echo(f"  {each}")
