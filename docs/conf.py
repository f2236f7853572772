"""The documentation site: `make docs` builds it with Sphinx from the pages that the repository shows as they are.

No page exists twice. The source folder is the repository itself, so that relative links between pages and to files
mean the same on the site; the table of contents is read from docs/README.md.
"""

import importlib
import importlib.metadata
import inspect
import re
from pathlib import Path

from docutils.nodes import Node, TextElement
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext.autodoc import Options
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import make_refnode
from sphinx.util.typing import ExtensionMetadata

ROOT = Path(__file__).parents[1]

project = "gym_dgpmpc"
author = "The gym_dgpmpc authors"
project_copyright = author
version = release = importlib.metadata.version("gym-dgpmpc")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
root_doc = "docs/README"
RESULTS = "benchmarks/results/"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", f"{RESULTS}**/*.md"]
templates_path = ["templates"]

html_theme = "furo"
html_title = "gym_dgpmpc"
html_additional_pages = {"index": "index.html"}
html_copy_source = False
html_show_sphinx = False

smartquotes_action = "D"  # of what is quoted in a docstring much is a setting
highlight_language = "text"  # of blocks that are indented: output, formulas, shell

myst_heading_anchors = 4  # the anchors that the repository's page gives to headings

default_role = "py:obj"  # `name` in a docstring is a link where the reference has the name, and code elsewhere
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

linkcheck_anchors = False
linkcheck_timeout = 20


class Docstring(SphinxDirective):
    """The docstring of an object as a part of the page: Gymnasium's environments describe themselves in Markdown."""

    required_arguments = 1

    def run(self) -> list[Node]:
        module, _, name = self.arguments[0].rpartition(".")
        text = inspect.getdoc(getattr(importlib.import_module(module), name)) or ""
        first, heading, rest = re.sub(r"^##", "###", text, flags=re.MULTILINE).partition("###")
        sections = self.parse_text_to_nodes(heading + rest, allow_section_headings=True)
        return self.parse_text_to_nodes(first) + sections


def with_contents(page: str) -> str:
    """The index with a table of contents for each of its sections: what the items of its lists begin with a link to."""
    first, *sections = page.split("\n## ")
    for number, section in enumerate(sections):
        items = re.findall(r"^- \[([^\]]*)\]\(([^)#]*)\.md\)", section, re.MULTILINE)
        listed = [f"{title} <{page}>" for title, page in items]
        contents = "\n".join(["```{toctree}", ":hidden:", f":caption: {section.splitlines()[0]}", "", *listed, "```"])
        sections[number] = f"{section}\n{contents}\n"
    return "\n## ".join([first, *sections])


def apart(page: str, docname: str) -> str:
    """A page of results, which pages link to and no table of contents has."""
    title = "" if page.startswith("# ") else f"# {Path(docname).name}\n\n"
    return f"---\norphan: true\n---\n{title}{page}"


def without_links_to_folders(page: str, folder: Path) -> str:
    """The site has files but no folders to look into."""

    def shown(link: re.Match[str]) -> str:
        return link[1] if (folder / link[2]).is_dir() else link[0]

    return re.sub(r"\[([^\]]+)\]\(([^)#:]+)\)", shown, page)


def read_page(app: Sphinx, docname: str, source: list[str]) -> None:
    """Called with every page before it is parsed."""
    if docname == root_doc:
        source[0] = with_contents(source[0])
    if docname.startswith(RESULTS):
        source[0] = apart(source[0], docname)
    source[0] = without_links_to_folders(source[0], (ROOT / docname).parent)


SECTIONS = ("Args:", "Attributes:", "Raises:", "Returns:")


def read_docstring(app: Sphinx, what: str, name: str, obj: object, options: Options, lines: list[str]) -> None:
    """A docstring has its code indented, and means asterisks, bars and underscores as they are, as in [*b, S]."""
    read: list[str] = []
    is_code, section = False, ""
    for line in lines:
        is_indented = line.startswith("    ")
        if line and not is_indented:
            is_code, section = False, line
        elif is_indented and not is_code and section not in SECTIONS and read and not read[-1]:
            is_code = True
            read += ["::", ""]
        pieces = [line] if is_code else re.split(r"(``[^`]+``|`[^`]+`)", line)
        if not is_code:
            pieces[::2] = [re.sub(r"(?<!\\)([*|]|_\b)", r"\\\1", piece) for piece in pieces[::2]]
        read.append("".join(pieces))
    lines[:] = read


def find_by_last_name(app: Sphinx, env: BuildEnvironment, node: pending_xref, shown: TextElement) -> Node | None:
    """What a docstring names without its module, if only one object of the reference is called so."""
    if node["reftype"] != "obj":
        return None
    objects = env.get_domain("py").get_objects()
    places = {(page, anchor) for name, _, _, page, anchor, _ in objects if name.endswith(f".{node['reftarget']}")}
    if len(places) != 1:
        return None
    return make_refnode(app.builder, node["refdoc"], *places.pop(), shown)


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("docstring", Docstring)
    app.connect("source-read", read_page)
    app.connect("autodoc-process-docstring", read_docstring, priority=400)  # before Napoleon's
    app.connect("missing-reference", find_by_last_name)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
