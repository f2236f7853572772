"""The command line: `dgpmpc train ENV_ID`, `evaluate PATH`, `inspect PATH`, `plot FOLDER...`, `distil PATH`; in a clone
`bench SUITE` and `report DIR`.

Says what is wrong in one line, with exit code 2; stops with 130 after Ctrl-C and with 143 after SIGTERM. What is slow
to import is imported when a command runs, so that `--help` answers at once.
"""

import importlib.metadata
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc.cli import benchmarks, distil, evaluate, inspect, plot, train


def _train() -> None:
    """Stands for `train.train` until that is called."""


_train.__doc__ = train.train.__doc__


class _Commands(TyperGroup):
    """Gives `train` its options when it is called, for they are read from the agent, whose import takes seconds."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] == "train":
            from gym_dgpmpc.cli.options import agent_asked_for, with_settings

            complete = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
            complete.command("train")(with_settings(train.train, agent_asked_for(args)))
            self.commands["train"] = get_command(complete)
        return super().resolve_command(ctx, args)


app = typer.Typer(cls=_Commands, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


def _show_version(value: bool) -> bool:
    if value:
        typer.echo(f"dgpmpc {importlib.metadata.version('gym-dgpmpc')}")
        raise typer.Exit
    return value


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Sample-efficient model-predictive control with deep Gaussian processes."""


# In the order in which `dgpmpc --help` shows them.
app.command("train")(_train)
app.command()(evaluate.evaluate)
app.command()(inspect.inspect)
app.command()(plot.plot)
app.command()(distil.distil)
benchmarks.add_benchmarks(app)
