"""Python modules that only an extra of the package brings; how to say that one is missing."""

EXTRAS = {
    "gymnasium_robotics": "robotics",
    "minari": "minari",
    "moviepy": "video",
    "onnx": "onnx",
    "pygame": "classic",
    "rl_zoo3": "zoo",
}
"""Module -> the extra that installs it."""


def how_to_install(module: str) -> str:
    """For an error's text: the command that installs the module with its extra, or "install it"."""
    extra = EXTRAS.get(module.partition(".")[0])
    return f'pip install "gym-dgpmpc[{extra}]"' if extra else "install it"


def missing_module(error: ModuleNotFoundError) -> str | None:
    """The module that was not found, be it named by the error itself or by one that it was raised from."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ModuleNotFoundError) and cause.name:
            return cause.name
        cause = cause.__cause__ or cause.__context__
    return None
