"""The documentation site: `make docs` builds it from the pages in this folder, which GitHub shows as they are."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.ext.napoleon import GoogleDocstring
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "scripts")]
_PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

project = "Skyloop"
author = _PROJECT["authors"][0]["name"]
version = release = _PROJECT["version"]
project_copyright = author

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["measured"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4  # links to headings as GitHub makes them
myst_links_external_new_tab = False

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
autodoc_default_options = {"members": True}
autodoc_inherit_docstrings = False  # of other projects' classes, in other markup
autodoc_type_aliases = {name: f"skyloop.{name}" for name in ("Drone", "Frame", "Swarm")}
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

#: Links within the reference are checked; names of other projects are no links, as nothing is loaded from their sites.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!skyloop\.).*"),
    (r"py:class", r"skyloop\.messages\.Vector"),
    (r"py:class", r"skyloop\.\w+\.\w+\..+"),  # types of arguments that are named in no public package
]

suppress_warnings = ["ref.python"]  # `Drone` is in skyloop and in skyloop.aio

html_theme = "furo"
html_title = "Skyloop"
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True


def _untyped(docstring: Any) -> tuple[str, list[str]]:
    """The text of an attribute: napoleon takes what stands before its first colon for a type, here it is part of it."""
    lines = docstring._dedent(docstring._consume_to_end())
    return "", type(docstring)(lines, docstring._config).lines()


GoogleDocstring._consume_inline_attribute = _untyped  # type: ignore[method-assign]

_LOADED = re.compile(
    r"""<(?:script|img|iframe|source)[^>]* src="https?:|<link[^>]* rel="stylesheet"[^>]* href="https?:"""
)


def _loads_nothing(app: Sphinx, exception: Exception | None) -> None:
    """The site is read without a network, and from the file system."""
    for page in app.outdir.rglob("*.html") if exception is None else ():
        if found := _LOADED.search(page.read_text()):
            raise ExtensionError(f"{page} loads something from another host: {found[0]}")


class Commands(SphinxDirective):
    """``.. commands::``: the reference of the command line, made from the commands themselves."""

    def run(self) -> list[nodes.Node]:
        """Return the sections."""
        from command_reference import reference

        for source in (ROOT / "scripts" / "command_reference.py", *(ROOT / "src/skyloop/cli").glob("*.py")):
            self.env.note_dependency(source)
        return self.parse_text_to_nodes(reference(), allow_section_headings=True)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.add_directive("commands", Commands)
    app.connect("build-finished", _loads_nothing)
