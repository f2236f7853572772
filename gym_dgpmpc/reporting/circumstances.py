"""With what and where results are made: versions, machine, and the revision of this package's source."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("gym-dgpmpc", "gymnasium", "mujoco", "numpy", "stable-baselines3", "torch")
UNKNOWN = "unknown"


def versions() -> dict[str, str]:
    """Of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}


def machine() -> dict[str, Any]:
    """System, processor, cores, and the threads that PyTorch uses."""
    return {
        "system": platform.system(),
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
    }


def revision(package: Path = Path(__file__).parents[1]) -> str:
    """The commit of a package's source, marked "-dirty" if the package differs from it; "unknown" without one.

    Other files of the repository do not count, and neither does a repository that the package only happens to be
    installed in.
    """

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(package), *arguments]
        try:
            result = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError:  # there is no git
            return None
        return result.stdout.strip() if result.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    if commit is None or not git("ls-files", "--", "."):
        return UNKNOWN
    return commit + ("-dirty" if git("status", "--porcelain", "--", ".") else "")
