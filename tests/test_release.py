"""What a release says of itself: the page of the package, its citation, and hooks that check what CI checks."""

import importlib.metadata
import re

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
