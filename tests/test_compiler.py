"""Building the compiled code: where it is kept, and that the package works without it."""

import functools
import os
import re
import stat
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from gym_dgpmpc import compiler
from gym_dgpmpc.dynamics.deep_gp import compiled_rollout
from gym_dgpmpc.dynamics.deep_gp.draws import CompiledPathwiseSampler
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.inference import compiled_layers
from gym_dgpmpc.types import Transitions
from tests.oracles.models import normal, seeded

needs_compiler = pytest.mark.skipif(not compiled_rollout.is_available(), reason="no C++ compiler works here")

SOURCE = "native/small.cpp"  # in place of the package's, which take seconds
REMEMBERED = compiler.load, compiler.warn_once, compiled_rollout._library, compiled_layers._library


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """A cache of its own for every test, and no memory of what was loaded before."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for remembered in REMEMBERED:
        remembered.cache_clear()
    yield
    for remembered in REMEMBERED:
        remembered.cache_clear()


@pytest.fixture
def sources(monkeypatch, tmp_path):
    """A folder in place of the package's, with a source that is built at once."""
    folder = tmp_path / "sources"
    (folder / "native").mkdir(parents=True)
    (folder / SOURCE).write_text('extern "C" int answer() { return 42; }')
    monkeypatch.setattr(compiler, "files", lambda _: folder)
    return folder


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("no-such-compiler", "compiler.*no-such-compiler"),
        ("false", r"\bfalse\b.*exit code 1"),
    ],
)
def test_without_a_compiler_one_warning_and_the_same_worlds(monkeypatch, command, complaint):
    monkeypatch.setenv("CXX", command)
    model = DeepGPDynamics(3, 2, num_inducing=5, first_training_iterations=2, num_samples=2)
    observation = normal(seeded(), 10, 3).float()
    with pytest.warns(UserWarning, match=complaint):
        model.fit(Transitions(observation, observation[:, :2], observation), seeded())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        world = model.draw(2, 3, seeded())
    assert not isinstance(world, CompiledPathwiseSampler)
    assert world(observation.expand(2, -1, -1).clone(), observation[:, :2], 0).isfinite().all()


def test_who_does_not_want_it_is_not_warned(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    model = DeepGPDynamics(3, 2, num_inducing=5, first_training_iterations=2, num_samples=2, compile=False)
    observation = normal(seeded(), 10, 3).float()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.fit(Transitions(observation, observation[:, :2], observation), seeded())
        model.draw(2, 3, seeded())


@needs_compiler
@pytest.mark.usefixtures("sources")
def test_is_built_once(tmp_path, monkeypatch):
    assert compiler.load(SOURCE) is not None
    (library,) = (tmp_path / "gym_dgpmpc").iterdir()
    built = library.stat().st_mtime_ns
    compiler.load.cache_clear()
    assert compiler.load(SOURCE) is not None
    (again,) = (tmp_path / "gym_dgpmpc").iterdir()
    assert (again, again.stat().st_mtime_ns) == (library, built)
    # Other flags, another library: what was built for another machine is never loaded.
    monkeypatch.setattr(compiler, "FLAGS", (*compiler.FLAGS, "-DOTHER"))
    compiler.load.cache_clear()
    assert compiler.load(SOURCE) is not None
    assert len(list((tmp_path / "gym_dgpmpc").iterdir())) == 2
    assert compiler.load(SOURCE, "-DOF_ITS_OWN") is not None
    assert len(list((tmp_path / "gym_dgpmpc").iterdir())) == 3


@needs_compiler
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="this system has no such permissions")
@pytest.mark.usefixtures("sources")
def test_a_cache_that_others_can_write_to_is_not_used():
    folder = compiler.cache_folder()
    folder.chmod(0o777)
    with pytest.warns(UserWarning, match=re.escape(str(folder))):
        assert compiler.load(SOURCE) is None
    folder.chmod(0o700)
    assert stat.S_IMODE(compiler.cache_folder().stat().st_mode) == 0o700


def load_in_another_process(folder, **environment):
    """What a new process says that loads the library and counts the files in TMPDIR while it has it."""
    program = f"""
import os, pathlib
from gym_dgpmpc import compiler
compiler.files = lambda _: pathlib.Path({str(folder)!r})
assert compiler.load({SOURCE!r}) is not None
print(len(os.listdir(os.environ["TMPDIR"])))
"""
    return subprocess.run(
        [sys.executable, "-c", program],
        env={name: value for name, value in (os.environ | environment).items() if value is not None},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@needs_compiler
def test_without_a_folder_to_write_to_it_is_built_elsewhere_and_removed_in_the_end(tmp_path, sources):
    (tmp_path / "file").write_text("not a folder")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    done = load_in_another_process(sources, XDG_CACHE_HOME=str(tmp_path / "file"), TMPDIR=str(temporary))
    assert done.stdout == "1\n", done.stderr
    assert not list(temporary.iterdir())


@needs_compiler
@pytest.mark.usefixtures("sources")
@pytest.mark.parametrize("failing", ["home", "write", "execute"])
def test_a_cache_that_cannot_be_used_is_done_without(failing, tmp_path, monkeypatch):
    """No HOME and an unknown user (containers); a folder that is full; one that nothing may be executed from."""

    def fail(*_):
        raise {"home": RuntimeError("no home"), "write": OSError(28, "no space left on device")}[failing]

    real = compiler.ctypes.CDLL

    def refuse_the_cache(path):
        if path.startswith(str(tmp_path)):
            raise OSError("failed to map segment from shared object")
        return real(path)

    if failing == "home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(Path, "home", fail)
    elif failing == "write":
        keep = compiler._keep
        monkeypatch.setattr(
            compiler, "_keep", lambda f, *rest: fail() if f.is_relative_to(tmp_path) else keep(f, *rest)
        )
    else:
        monkeypatch.setattr(compiler.ctypes, "CDLL", refuse_the_cache)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compiler.load(SOURCE).answer() == 42


@pytest.mark.usefixtures("sources")
def test_without_any_folder_there_is_the_warning(monkeypatch):
    def fail(*_, **__):
        raise FileNotFoundError("no usable temporary directory")

    monkeypatch.setattr(compiler.tempfile, "TemporaryDirectory", fail)
    monkeypatch.setattr(compiler, "find_compiler", lambda: ["echo"])
    with pytest.warns(UserWarning, match="temporary directory"):
        assert compiler.load(SOURCE) is None


@needs_compiler
@pytest.mark.parametrize("size", [4096, 0])
def test_a_damaged_library_is_built_anew(size, tmp_path, sources):
    """Loading one that was cut would kill the process: its pages are missing when they are touched."""
    assert compiler.load(SOURCE) is not None
    (library,) = (tmp_path / "gym_dgpmpc").iterdir()
    whole = library.read_bytes()
    library.unlink()  # not cut where it is: this process has it mapped
    library.write_bytes(whole[:size])
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    done = load_in_another_process(sources, TMPDIR=str(temporary))
    assert (done.returncode, done.stdout, done.stderr) == (0, "0\n", "")
    (again,) = (tmp_path / "gym_dgpmpc").iterdir()
    assert again.stat().st_size == len(whole)


@pytest.mark.usefixtures("sources")
def test_a_compiler_that_writes_nothing_is_named(monkeypatch):
    monkeypatch.setenv("CXX", "echo")
    with pytest.warns(UserWarning, match="echo wrote no library"):
        assert compiler.load(SOURCE) is None


@pytest.fixture
def wheel(monkeypatch, sources):
    """The folder of a wheel's libraries, which say their level; no compiler helps out afterwards."""
    (sources / SOURCE).write_text(
        "#if defined(__AVX512F__)\n#define L 512\n#elif defined(__AVX2__)\n#define L 2\n#else\n#define L 0\n#endif\n"
        'extern "C" int answer() { return L; }'
    )
    monkeypatch.setattr(compiler, "SOURCES", {SOURCE: ()})
    folder = sources / compiler.PREBUILT
    folder.mkdir()
    assert len(compiler.build_for_wheel(sources, folder)) == len(compiler.LEVELS)
    monkeypatch.setenv("CXX", "no-such-compiler")
    return folder


needs_levels = pytest.mark.skipif("AVX512" not in compiler.LEVELS, reason="this kind of processor has one level")


@needs_compiler
@needs_levels
@pytest.mark.parametrize(("capability", "answer"), [("DEFAULT", 0), ("AVX2", 2), ("AVX512", 512), ("SVE256", 0)])
def test_of_a_wheel_the_best_library_is_loaded_that_runs_here(monkeypatch, wheel, tmp_path, capability, answer):
    if capability == "AVX512" and torch.backends.cpu.get_cpu_capability() != "AVX512":
        pytest.skip("this processor has no AVX512")
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    assert compiler.load(SOURCE).answer() == answer
    assert not (tmp_path / "gym_dgpmpc").exists()  # nothing was built


@needs_compiler
def test_a_wheels_library_of_another_source_or_of_other_flags_is_not_used(monkeypatch, wheel, sources):
    assert compiler.load(SOURCE) is not None
    compiler.load.cache_clear()
    with pytest.warns(UserWarning, match="no-such-compiler"):
        assert compiler.load(SOURCE, "-DOTHER") is None
    (sources / SOURCE).write_text('extern "C" int answer() { return 43; }')
    compiler.load.cache_clear()
    compiler.warn_once.cache_clear()
    with pytest.warns(UserWarning, match="no-such-compiler"):
        assert compiler.load(SOURCE) is None


@needs_compiler
def test_a_damaged_library_of_a_wheel_is_left_alone(wheel):
    for library in wheel.iterdir():
        library.write_bytes(library.read_bytes()[:100])
    with pytest.warns(UserWarning, match="no-such-compiler"):
        assert compiler.load(SOURCE) is None
    assert len(list(wheel.iterdir())) == len(compiler.LEVELS)


def test_the_sources_of_a_wheel_are_those_that_are_loaded():
    assert set(compiler.SOURCES) == {compiled_rollout.SOURCE, compiled_layers.SOURCE}
    for source in compiler.SOURCES:
        assert (Path(compiler.__file__).parent / source).is_file()


def test_memory_that_cannot_be_had_is_an_error(monkeypatch):
    """The compiled code says by its result that it could not allocate; nothing is then returned as if computed."""

    class Library:
        def points(self):
            return 8

        def kernel_number(self, name):
            return 0

        def rollout(self, *_):
            return 1

    monkeypatch.setattr(compiled_rollout, "_library", functools.cache(Library))
    monkeypatch.setattr(compiled_layers, "can_take", lambda *_: False)
    model = DeepGPDynamics(3, 2, num_inducing=5, first_training_iterations=2, num_samples=2, compile=True)
    observation = normal(seeded(), 10, 3).float()
    model.fit(Transitions(observation, observation[:, :2], observation), seeded())
    world = model.draw(2, 3, seeded())
    with pytest.raises(MemoryError, match="rollout"):
        world.trajectories(observation[0], torch.zeros(4, 3, 2))
