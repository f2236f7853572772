"""Loads the package's C++ sources as libraries: those that a wheel brings, else built once, on the user's machine.

A released wheel brings each source for several levels of processors (`LEVELS`), of which the best is loaded that runs
here. Without one, as in a clone, the compiler of the machine builds the source. The result is kept in the user's cache
folder (`XDG_CACHE_HOME`, by default `~/.cache`), under a name that says which source, compiler, flags and processor it
was built from and for, and which bytes it holds: a file that does not hold them is built anew, for loading it may kill
the process. Where that folder cannot be used, a temporary one can. Used by `dynamics/deep_gp/compiled_rollout.py` and
`inference/compiled_layers.py`; without a compiler the package works all the same, only slower. Compiled code is called
through `in_threads`.

`hatch_build.py` runs this file by itself when a wheel is built, where neither PyTorch nor this package is installed.
"""

import atexit
import ctypes
import functools
import hashlib
import os
import platform
import secrets
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

SOURCES: Mapping[str, tuple[str, ...]] = {
    "dynamics/deep_gp/native/rollout.cpp": ("-ffp-contract=off",),
    "inference/native/layers.cpp": (),
}
"""The C++ of the package, with the compiler's flags that each needs beside `FLAGS`."""

FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
NATIVE = ("-march=native",)
"""For a library that is built where it runs."""

LEVELS: Mapping[str, tuple[str, ...]] = (
    {
        "AVX512": ("-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mfma"),
        "AVX2": ("-mavx2", "-mfma"),
        "DEFAULT": (),
    }
    if platform.machine().lower() in ("x86_64", "amd64")
    else {"DEFAULT": ()}
)
"""What a wheel's libraries may ask of this kind of processor, the most first, by PyTorch's names; on ARM it is NEON."""

PREBUILT = "prebuilt"
"""Folder of the package with a wheel's libraries."""

COMPILERS = ("c++", "g++", "clang++")
BUILD_TIMEOUT = 120.0
"""Seconds after which a compiler is taken to hang."""


class CompilerError(RuntimeError):
    """No compiler can be used, or it could not build the source. `load` turns it into a warning."""


@functools.cache
def load(source: str, *flags: str) -> ctypes.CDLL | None:
    """The library built from a source, "room/native/name.cpp"; None, with one warning, if it cannot be built.

    Args:
        flags: of the compiler, beside `FLAGS`.
    """
    path, package = Path(source), files("gym_dgpmpc")
    content = package.joinpath(*path.parts).read_bytes()
    try:
        brought = _load_prebuilt(Path(str(package.joinpath(PREBUILT))), path.stem, content, flags)
        return _load(path.stem, content, flags) if brought is None else brought
    except (CompilerError, OSError, subprocess.SubprocessError) as error:
        warn_once(f"{error}. Install a C++ compiler (g++ or clang++), or name one in the environment variable CXX")
        return None


@functools.cache
def warn_once(reason: str) -> None:
    """Say why there is no compiled code, once for each reason."""
    warnings.warn(
        f"planning or training does without compiled code, several times slower, because {reason}; compile=False "
        "silences this warning",
        stacklevel=3,
    )


def build_for_wheel(package: Path, folder: Path) -> list[Path]:
    """Build all of `SOURCES` for all of `LEVELS`, at once, into an empty folder.

    Args:
        package: the folder of this package's source.

    Raises:
        CompilerError, OSError, subprocess.SubprocessError: one cannot be built.
    """
    compiler = find_compiler()

    def build(wanted: tuple[str, str]) -> Path:
        source, level = wanted
        content, flags = (package / source).read_bytes(), (*FLAGS, *SOURCES[source], *LEVELS[level])
        library = _build([*compiler, *flags, "-x", "c++", "-"], content)
        return _keep(folder, _prebuilt_stem(Path(source).stem, level, content, flags), library)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(build, [(source, level) for source in SOURCES for level in LEVELS]))


def in_threads(call: Callable[[int, int], int], ranges: Sequence[tuple[int, int]]) -> int:
    """The sum of what ``call(first, last)`` returns for all ranges, each of them on a thread of its own."""
    if len(ranges) == 1:
        return call(*ranges[0])
    return sum(_threads(len(ranges)).map(lambda each: call(*each), ranges))


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
    """Where built libraries are kept: a folder that only this user can write to.

    Raises:
        CompilerError: the folder belongs to someone else, who could have put anything there.
        OSError: there is no such folder, and none can be made.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        folder = (Path(base) if base else Path.home() / ".cache") / "gym_dgpmpc"
    except RuntimeError as error:  # no HOME, and a user whom the system does not know: as containers have it
        raise FileNotFoundError(str(error)) from error
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):
        raise CompilerError(f"other users can write to {folder}: remove it, or set XDG_CACHE_HOME")
    return folder


@functools.cache
def _threads(num_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(num_threads, thread_name_prefix="compiled")


if hasattr(os, "register_at_fork"):  # a forked child inherits the pools, but none of their threads
    os.register_at_fork(after_in_child=_threads.cache_clear)


def _load_prebuilt(folder: Path, name: str, source: bytes, flags: Sequence[str]) -> ctypes.CDLL | None:
    """The best library of a wheel that this processor runs, if it is of this very source and whole."""
    if not folder.is_dir():
        return None
    import torch  # not where wheels are built

    levels = list(LEVELS)
    capability = torch.backends.cpu.get_cpu_capability()
    first = levels.index(capability) if capability in levels else len(levels) - 1
    for level in levels[first:]:
        stem = _prebuilt_stem(name, level, source, (*FLAGS, *flags, *LEVELS[level]))
        for library in folder.glob(f"{stem}-*.so"):
            with suppress(OSError):
                if library.name == _file_name(stem, library.read_bytes()):
                    return ctypes.CDLL(str(library))
    return None


def _prebuilt_stem(name: str, level: str, source: bytes, flags: Sequence[str]) -> str:
    """Says what a wheel's library was built from and for."""
    return f"{name}-{level}-{hashlib.sha256(b'%b %b' % (source, ' '.join(flags).encode())).hexdigest()[:24]}"


def _load(name: str, source: bytes, flags: Sequence[str]) -> ctypes.CDLL:
    """The library: the one that is kept, else a new one.

    Raises:
        CompilerError, subprocess.SubprocessError: it cannot be built.
        OSError: nowhere can it be written and loaded from.
    """
    command = [*find_compiler(), *FLAGS, *NATIVE, *flags, "-x", "c++", "-"]
    # All that the compiler predefines with these flags: its version and the processor's instructions among them.
    described = _run([*command, "-dM", "-E"], b"")
    digest = hashlib.sha256(b"\0".join([source, " ".join(command).encode(), described])).hexdigest()
    stem = f"{name}-{digest[:24]}"
    with suppress(OSError):
        library = _kept(cache_folder(), stem)
        if library is not None:
            return ctypes.CDLL(str(library))
    built = _build(command, source)
    with suppress(OSError):  # a folder that is full, cannot be written, or that nothing may be executed from
        return ctypes.CDLL(str(_keep(cache_folder(), stem, built)))
    temporary = Path(tempfile.mkdtemp(prefix="gym_dgpmpc-"))
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return ctypes.CDLL(str(_keep(temporary, stem, built)))


def _build(command: list[str], source: bytes) -> bytes:
    """The bytes of a library built from the source."""
    with tempfile.TemporaryDirectory(prefix="gym_dgpmpc-") as folder:
        library = Path(folder) / "built.so"
        _run([*command, "-o", str(library)], source)
        if not library.exists():
            raise CompilerError(f"{command[0]} wrote no library")
        return library.read_bytes()


def _kept(folder: Path, stem: str) -> Path | None:
    """The library of an earlier process, if it holds the bytes that its name tells; a damaged one is removed."""
    for library in folder.glob(f"{stem}-*.so"):
        if library.name == _file_name(stem, library.read_bytes()):
            return library
        library.unlink()
    return None


def _keep(folder: Path, stem: str, built: bytes) -> Path:
    """Write the library so that neither another process nor a power cut sees half of it."""
    library = folder / _file_name(stem, built)
    temporary = library.with_name(f"{library.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "xb") as file:
            file.write(built)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, library)
    finally:
        temporary.unlink(missing_ok=True)
    return library


def _file_name(stem: str, content: bytes) -> str:
    """The name of a library that holds these bytes."""
    return f"{stem}-{hashlib.sha256(content).hexdigest()[:24]}.so"


def _run(command: list[str], given: bytes) -> bytes:
    done = subprocess.run(command, input=given, capture_output=True, timeout=BUILD_TIMEOUT, check=False)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise CompilerError(f"{command[0]} failed: {said[0] if said else f'exit code {done.returncode}'}")
    return done.stdout
