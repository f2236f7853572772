"""What results say of the code that made them is true."""

import importlib.metadata
import platform
import shutil
import subprocess

import pytest

from gym_dgpmpc.runs import provenance as circumstances
from gym_dgpmpc.runs.provenance import UNKNOWN, machine, processor, revision, versions


@pytest.fixture
def package(tmp_path):
    """A package in a repository with one commit."""
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (tmp_path / "results.csv").write_text("")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "--message", "one")
    return folder


def git(folder, *arguments):
    return subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


@needs_git
def test_the_commit_and_whether_the_package_differs_from_it(package):
    commit = git(package, "rev-parse", "HEAD")
    assert revision(package) == commit
    (package.parent / "results.csv").write_text("more")
    assert revision(package) == commit
    (package / "new.py").write_text("")
    assert revision(package) == f"{commit}-dirty"
    (package / "new.py").unlink()
    (package / "__init__.py").write_text("changed")
    assert revision(package) == f"{commit}-dirty"


@needs_git
def test_a_package_installed_in_a_repository_is_not_of_it(package):
    installed = package.parent / "lib" / "another"
    installed.mkdir(parents=True)
    assert revision(installed) == UNKNOWN


def test_without_a_repository_or_git(tmp_path, monkeypatch):
    assert revision(tmp_path) == UNKNOWN

    def missing(*args, **kwargs):
        raise FileNotFoundError("git")

    monkeypatch.setattr(circumstances.subprocess, "run", missing)
    assert revision() == UNKNOWN


def test_versions_and_machine():
    assert {"python", *circumstances.PACKAGES} <= versions().keys()
    assert versions().keys() <= {"python", *circumstances.PACKAGES, *circumstances.OPTIONAL}
    assert machine()["threads"] == 1
    assert machine()["processor"] == processor()


def test_optional_packages_are_told_where_they_are(monkeypatch):
    def version(name):
        if name in circumstances.OPTIONAL and name != "ray":
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.2"

    monkeypatch.setattr(circumstances.importlib.metadata, "version", version)
    assert versions() == {"python": platform.python_version(), **dict.fromkeys([*circumstances.PACKAGES, "ray"], "1.2")}


def test_the_processor_by_its_name(tmp_path):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nmodel name\t: Some CPU: 9 @ 2 GHz\nprocessor\t: 1\nmodel name\t: Other\n")
    assert processor(cpuinfo) == "Some CPU: 9 @ 2 GHz"


def test_the_processor_where_the_system_does_not_tell_its_name(tmp_path, monkeypatch):
    cpuinfo = tmp_path / "cpuinfo"  # as on ARM
    cpuinfo.write_text("processor\t: 0\nCPU part\t: 0xd0c\n")
    monkeypatch.setattr(platform, "processor", lambda: "")
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert processor(cpuinfo) == processor(tmp_path / "none") == "aarch64"
    monkeypatch.setattr(platform, "processor", lambda: "a name")
    assert processor(tmp_path / "none") == "a name"
