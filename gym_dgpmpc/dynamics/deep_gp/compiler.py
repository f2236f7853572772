"""Builds the package's C++ source once, with the compiler of the machine that it runs on, and loads it.

The result is kept in the user's cache folder (`XDG_CACHE_HOME`, by default `~/.cache`), under a name that says which
source, compiler, flags and processor it was built from and for. Used by `compiled_rollout.py`; without a compiler the
package works all the same, only slower.
"""

import atexit
import ctypes
import functools
import hashlib
import os
import secrets
import shutil
import subprocess
import tempfile
import warnings
from importlib.resources import files
from pathlib import Path

FLAGS = ("-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
COMPILERS = ("c++", "g++", "clang++")
BUILD_TIMEOUT = 120.0
"""Seconds after which a compiler is taken to hang."""


class CompilerError(RuntimeError):
    """No compiler can be used, or it could not build the source. `load` turns it into a warning."""


@functools.cache
def load(name: str) -> ctypes.CDLL | None:
    """The library built from ``native/NAME.cpp``; None, with one warning, if it cannot be built."""
    source = files("gym_dgpmpc.dynamics.deep_gp").joinpath("native", f"{name}.cpp").read_bytes()
    try:
        return ctypes.CDLL(str(_build(name, source)))
    except (CompilerError, OSError, subprocess.SubprocessError) as error:
        warnings.warn(
            f"planning does without compiled code, several times slower, because {error}. Install a C++ compiler "
            "(g++ or clang++), or name one in the environment variable CXX; compile=False silences this warning",
            stacklevel=2,
        )
        return None


def find_compiler() -> list[str]:
    """The compiler's command: what CXX says, else the first of `COMPILERS` there is.

    Raises:
        CompilerError: no compiler was found.
    """
    asked = os.environ.get("CXX", "").split()
    for command in [asked] if asked else [[name] for name in COMPILERS]:
        if shutil.which(command[0]) is not None:
            return command
    raise CompilerError(f"no C++ compiler was found (looked for {' '.join(asked) or ', '.join(COMPILERS)})")


def cache_folder() -> Path:
    """Where built libraries are kept: a folder that only this user can write to, or one that ends with the process.

    Raises:
        CompilerError: the folder belongs to someone else, who could have put anything there.
    """
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "gym_dgpmpc"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:  # no home folder, or one that cannot be written: build anew in every process
        temporary = tempfile.mkdtemp(prefix="gym_dgpmpc-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        return Path(temporary)
    status = folder.stat()
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):
        raise CompilerError(f"other users can write to {folder}: remove it, or set XDG_CACHE_HOME")
    return folder


def _build(name: str, source: bytes) -> Path:
    """The path of the library, built if it is not in the cache."""
    compiler = find_compiler()
    # All that the compiler predefines with these flags: its version and the processor's instructions among them.
    described = _run([*compiler, *FLAGS, "-dM", "-E", "-x", "c++", "-"], b"")
    digest = hashlib.sha256(b"\0".join([source, " ".join([*compiler, *FLAGS]).encode(), described])).hexdigest()
    library = cache_folder() / f"{name}-{digest[:24]}.so"
    if not library.exists():
        temporary = library.with_name(f"{library.name}.{secrets.token_hex(4)}.tmp")
        try:
            _run([*compiler, *FLAGS, "-x", "c++", "-", "-o", str(temporary)], source)
            os.replace(temporary, library)
        finally:
            temporary.unlink(missing_ok=True)
    return library


def _run(command: list[str], given: bytes) -> bytes:
    done = subprocess.run(command, input=given, capture_output=True, timeout=BUILD_TIMEOUT, check=False)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise CompilerError(f"{command[0]} failed: {said[0] if said else f'exit code {done.returncode}'}")
    return done.stdout
