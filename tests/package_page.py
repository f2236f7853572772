"""Writes `PACKAGE.md`, what a package index shows: README.md, whose relative links lead nowhere there.

They become absolute if `[project.urls]` of pyproject.toml names the `Repository`; without an address they become plain
text, and a picture says what it shows.

    python -m tests.package_page
"""

import re
from pathlib import Path

CLONE = Path(__file__).parents[1]
PAGE = CLONE / "PACKAGE.md"


def repository(project: str) -> str | None:
    """The address in the text of pyproject.toml, if there is one."""
    found = re.search(r'^\[project\.urls\]\n(?:.+\n)*?Repository = "([^"]+)"', project, re.MULTILINE)
    return found[1].rstrip("/") if found else None


def package_page(readme: str, address: str | None) -> str:
    """The text of the README with links that lead somewhere from anywhere."""

    def link(match: re.Match[str]) -> str:
        is_picture, text, target = match.groups()
        if re.match(r"[a-z]+:", target):
            return match[0]
        if address is None:
            return f"*In the repository: {text}.*" if is_picture else text
        return f"{is_picture}[{text}]({address}/{'raw' if is_picture else 'blob'}/HEAD/{target})"

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", link, readme)


def generated() -> str:
    """The text of the file."""
    address = repository((CLONE / "pyproject.toml").read_text(encoding="utf-8"))
    return package_page((CLONE / "README.md").read_text(encoding="utf-8"), address)


if __name__ == "__main__":
    PAGE.write_text(generated(), encoding="utf-8")
