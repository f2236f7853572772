"""Puts compiled code into a wheel: hatchling runs this file when it builds one.

Only if the environment variable GYM_DGPMPC_COMPILE is 1, as for a release (CONTRIBUTING.md). The wheel then fits one
kind of system and processor, and any version of Python. Every other wheel is pure: its sources are built where they are
first used, so that an installation from source needs no compiler and no time.
"""

import importlib.util
import os
import shutil
import sysconfig
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


def load_compiler(package: Path) -> ModuleType:
    """`gym_dgpmpc.compiler` by itself, for nothing that the package imports is installed here."""
    spec = importlib.util.spec_from_file_location("compiler", package / "compiler.py")
    assert spec is not None and spec.loader is not None
    compiler = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(compiler)
    return compiler


class CompiledCode(BuildHookInterface):
    """Adds the libraries of `gym_dgpmpc.compiler.build_for_wheel`."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build them, and say what the wheel fits; does nothing unless it is asked for.

        Raises:
            RuntimeError: there is no compiler, or it could not build them.
        """
        if version == "editable" or os.environ.get("GYM_DGPMPC_COMPILE") != "1":
            return
        package, folder = Path(self.root, "gym_dgpmpc"), Path(self.root, "build", "prebuilt")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        compiler = load_compiler(package)
        for library in compiler.build_for_wheel(package, folder):
            build_data["force_include"][str(library)] = f"gym_dgpmpc/{compiler.PREBUILT}/{library.name}"
        system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data.update(pure_python=False, tag=f"py3-none-{system}")
