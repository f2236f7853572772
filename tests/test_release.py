"""What a release says of itself: the page of the package, its citation, and hooks that check what CI checks."""

import importlib.metadata
import re
import runpy
import subprocess
import sys
import types

import pytest

from tests.package_page import CLONE, PAGE, generated, package_page, repository

PROJECT = (CLONE / "pyproject.toml").read_text(encoding="utf-8")


def test_the_package_page_is_that_of_the_readme():
    assert PAGE.read_text(encoding="utf-8") == generated(), "write it anew: python -m tests.package_page"
    assert f'readme = "{PAGE.relative_to(CLONE).as_posix()}"' in PROJECT


def test_every_link_of_the_package_page_is_absolute():
    targets = re.findall(r"\]\(([^)]+)\)", PAGE.read_text(encoding="utf-8"))
    assert targets
    assert [target for target in targets if not target.startswith("https://")] == []


README = "See [there](docs/a.md#b), [`c`](https://c.org/x) and\n![a picture](docs/d.gif)\n"


@pytest.mark.parametrize(
    ("address", "page"),
    [
        (None, "See there, [`c`](https://c.org/x) and\n*In the repository: a picture.*\n"),
        (
            "https://e.org/f",
            "See [there](https://e.org/f/blob/HEAD/docs/a.md#b), [`c`](https://c.org/x) and\n"
            "![a picture](https://e.org/f/raw/HEAD/docs/d.gif)\n",
        ),
    ],
)
def test_links_lead_to_the_repository_if_it_has_an_address(address, page):
    assert package_page(README, address) == page


def test_the_address_is_that_of_the_project():
    assert (
        repository('[project.urls]\nHomepage = "https://a.org"\nRepository = "https://e.org/f/"\n') == "https://e.org/f"
    )
    assert repository('[project]\nname = "a"\n\n[tool]\nRepository = "https://e.org"\n') is None


def test_the_citation_is_of_this_version_and_of_the_paper():
    citation = (CLONE / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {importlib.metadata.version('gym-dgpmpc')}\n" in citation
    assert f'\nversion = "{importlib.metadata.version("gym-dgpmpc")}"\n' in PROJECT
    readme = (CLONE / "README.md").read_text(encoding="utf-8")
    assert "Sample-efficient reinforcement learning using deep Gaussian processes" in citation
    for name in ("Gadd", "Heinonen", "Lähdesmäki", "Kaski"):
        assert f"family-names: {name}\n" in citation
        assert name in readme


def test_hooks_run_what_make_lint_runs():
    makefile = (CLONE / "Makefile").read_text(encoding="utf-8")
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)[1]
    commands = re.findall(r"\$\(BIN\)/(.*)", lint)
    hooks = (CLONE / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    assert re.findall(r"entry: \.venv/bin/(.*)", hooks) == commands
    assert len(commands) == 3


@pytest.fixture
def hook(monkeypatch, tmp_path):
    """The class of hatch_build.py, with a package whose compiler builds nothing."""
    interface = types.ModuleType("interface")
    interface.BuildHookInterface = type("BuildHookInterface", (), {})  # type: ignore[attr-defined]
    for name in ("hatchling", "hatchling.builders", "hatchling.builders.hooks", "hatchling.builders.hooks.plugin"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, "hatchling.builders.hooks.plugin.interface", interface)
    package = tmp_path / "gym_dgpmpc"
    package.mkdir()
    (package / "compiler.py").write_text(
        "PREBUILT = 'prebuilt'\ndef build_for_wheel(package, folder):\n"
        "    (folder / 'a.so').write_bytes(b'x')\n    return [folder / 'a.so']\n"
    )
    made = runpy.run_path(str(CLONE / "hatch_build.py"))["CompiledCode"]()
    made.root = str(tmp_path)
    return made


@pytest.mark.parametrize(("asked", "version"), [("", "standard"), ("0", "standard"), ("1", "editable")])
def test_a_wheel_is_pure_unless_compiled_code_is_asked_for(monkeypatch, hook, asked, version):
    monkeypatch.setenv("GYM_DGPMPC_COMPILE", asked)
    data = {"force_include": {}}
    hook.initialize(version, data)
    assert data == {"force_include": {}}


def test_a_wheel_with_compiled_code_fits_one_system_and_any_python(monkeypatch, hook, tmp_path):
    monkeypatch.setenv("GYM_DGPMPC_COMPILE", "1")
    for _ in range(2):  # what an earlier build left is not in the way
        data = {"force_include": {}}
        hook.initialize("standard", data)
    library = tmp_path / "build" / "prebuilt" / "a.so"
    assert data["force_include"] == {str(library): "gym_dgpmpc/prebuilt/a.so"} and data["pure_python"] is False
    assert re.fullmatch(r"py3-none-\w+", data["tag"])


def test_the_file_that_builds_wheels_needs_nothing_but_the_standard_library():
    """`hatch_build.py` runs compiler.py where nothing else is installed: -S leaves site-packages out."""
    program = f"import runpy; print(len(runpy.run_path({str(CLONE / 'gym_dgpmpc' / 'compiler.py')!r})['SOURCES']))"
    done = subprocess.run([sys.executable, "-S", "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout == "2\n", done.stderr
    assert '"/hatch_build.py"' in PROJECT and "wheel.hooks.custom]" in PROJECT
