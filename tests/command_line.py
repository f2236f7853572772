"""Calling `dgpmpc` in tests, and what its errors look like."""

from typer.testing import CliRunner

from gym_dgpmpc import cli

SMALLEST = ["--layers=1", "--inducing=4", "--features=4", "--particles=2", "--horizon=3", "--candidates=6"]
SMALLEST += ["--iterations=1", "--first-training-iterations=2", "--training-iterations=2", "--samples=2"]
SMALLEST += ["--sample-spacing=1", "--resample-samples=0"]
"""Options of `dgpmpc train` with which a run takes a second."""


def dgpmpc(*arguments):
    """What a command in the present folder prints, and its exit code."""
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def is_one_line_error(result, *texts):
    assert result.exit_code == 2
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    for text in texts:
        assert text in result.stderr
    return True
