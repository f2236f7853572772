"""What results are made with: versions of packages, the machine, and the revision of this package's source."""

import importlib.metadata
import os
import platform
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("gym-dgpmpc", "gymnasium", "mujoco", "numpy", "stable-baselines3", "torch")
OPTIONAL = ("dask", "distributed", "gpytorch", "gymnasium-robotics", "minari", "ray")
"""Packages of the extras; recorded where they are installed."""

UNKNOWN = "unknown"


def versions() -> dict[str, str]:
    """Versions of Python, of the packages that results depend on, and of the optional ones that are installed."""
    found = {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}
    for name in OPTIONAL:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """The processor's name, if the system gives it; else its architecture."""
    lines = cpuinfo.read_text(errors="replace").splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(filter(None, names), "") or platform.processor() or platform.machine()


def machine() -> dict[str, Any]:
    """System, processor, cores, and the threads that PyTorch uses."""
    return {
        "system": platform.system(),
        "processor": processor(),
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
        except OSError:  # git is not installed
            return None
        return result.stdout.strip() if result.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    if commit is None or not git("ls-files", "--", "."):
        return UNKNOWN
    return commit + ("-dirty" if git("status", "--porcelain", "--", ".") else "")
