"""How Sphinx makes the documentation's site of the Markdown that is read in the repository, too: `make site`.

The source folder is the whole repository, so each link in a page holds as it stands: to a page, to a file of code, to a
heading. One that leads nowhere ends the build, and so does a page that no index leads to.
"""

from __future__ import annotations

import re
from pathlib import Path

from sphinx.application import Sphinx

import skytether

ROOT = Path(__file__).parents[1]
INDEXES = {"docs/index", "docs/decisions/index", "terraform/README"}
"""Pages whose lists of links are the site's navigation."""

project = "Skytether"
version = release = skytether.__version__
copyright = "The Skytether developers"  # noqa: A001 (Sphinx's word)
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md", "terraform/**.md", "helm/**.md", "services/**.md"]
exclude_patterns = [".*", "build", "platform", "tests", "images", "ros1", "docs/examples", "**/.terraform"]
default_role = "code"
html_theme = "furo"
html_title = "Skytether"
html_copy_source = False
html_show_sphinx = False
myst_heading_anchors = 4
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"


def add_navigation(_app: Sphinx, document: str, source: list[str]) -> None:
    """Have the pages that an index lists below each heading be a part of the navigation."""
    if document not in INDEXES:
        return
    parts = re.split(r"^##? (.+)$", source[0], flags=re.MULTILINE)
    for heading, text in zip(parts[1::2], parts[2::2], strict=True):
        heads = re.findall(r"^(?:- |\| )(.+?)(?:: | \| )", text, re.MULTILINE)
        links = [link for head in heads for link in re.findall(r"\[([^\]]+)\]\(([^)#]+\.md)\)", head)]
        if links:
            rows = "\n".join(f"{title.replace('`', '')} <{path}>" for title, path in links)
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {heading}\n\n{rows}\n```\n"


def read_indexes_again(*_: object) -> list[str]:
    """Which pages there are beside them is no part of what they say themselves."""
    return sorted(INDEXES)


def open_at_the_top(app: Sphinx, failure: Exception | None) -> None:
    """The site's own address leads to its first page."""
    if failure is None:
        page = f'<meta http-equiv="refresh" content="0; url={root_doc}.html">'
        Path(app.outdir, "index.html").write_text(f"<!doctype html>{page}\n")


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", add_navigation)
    app.connect("env-get-outdated", read_indexes_again)
    app.connect("build-finished", open_at_the_top)
