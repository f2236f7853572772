"""`dgpmpc bench` and `dgpmpc report`, whose code is in the repository's package `benchmarks` and is not installed.

In a clone these are the commands of `benchmarks/commands.py`; elsewhere they say in one line where the benchmarks are.
"""

import importlib
import importlib.util
import os
import sys
from pathlib import Path

import typer

from gym_dgpmpc.cli.common import EXIT_ERROR

NAMES = ("bench", "report")


def add_benchmarks(app: typer.Typer) -> None:
    """Add the commands `NAMES`."""
    if make_importable():
        commands = importlib.import_module("benchmarks.commands")
        for name in NAMES:
            app.command()(getattr(commands, name))
        return
    for name in NAMES:
        anything = {"ignore_unknown_options": True, "allow_extra_args": True}
        app.command(name, context_settings=anything)(_say_where_the_benchmarks_are)


def _say_where_the_benchmarks_are(context: typer.Context) -> None:
    """Not installed: the benchmarks are in a clone of the repository."""
    typer.echo(
        f"error: the benchmarks are in the repository and not in the installed package: clone it, install it from the "
        f'clone with `pip install -e ".[bench]"`, and run `dgpmpc {context.info_name}` there',
        err=True,
    )
    raise typer.Exit(EXIT_ERROR)


def make_importable() -> bool:
    """Put the clone that this package is in on Python's path, or else the clone that is the current folder.

    Returns:
        Whether ``import benchmarks`` finds the benchmarks of this package, and not another package of that name.
    """
    package = Path(__file__).parents[2]
    if _is_clone(package):
        sys.path.insert(0, str(package))  # before any other package of that name
        return _finds(package)
    if os.path.isdir(os.curdir) and _is_clone(here := Path.cwd()):
        # Behind the installed package, so that worker processes, which get this path, import that one as well.
        sys.path.insert(1 + sys.path.index(str(package)) if str(package) in sys.path else len(sys.path), str(here))
        return _finds(here)
    return False


def _is_clone(folder: Path) -> bool:
    """Whether a folder is a clone of this package's repository, judged without importing anything from it."""
    project = folder / "pyproject.toml"
    if not (os.path.isfile(folder / "benchmarks" / "commands.py") and os.path.isfile(project)):
        return False
    return 'name = "gym-dgpmpc"' in project.read_text(encoding="utf-8", errors="replace").splitlines()


def _finds(clone: Path) -> bool:
    """Whether ``import benchmarks`` would import those of the clone."""
    spec = importlib.util.find_spec("benchmarks")
    ours = clone / "benchmarks" / "__init__.py"
    return spec is not None and spec.origin is not None and os.path.realpath(spec.origin) == os.path.realpath(ours)
