"""The documentation site: `make docs` builds it from the pages in this folder, which GitHub shows as they are."""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from collections.abc import Iterator
from inspect import isclass
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.errors import ExtensionError
from sphinx.ext.napoleon import GoogleDocstring

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
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["measured"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4  # links to headings as GitHub makes them
myst_links_external_new_tab = False

autosummary_generate = False  # see _write_pages
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
html_favicon = "../src/skyloop/cockpit/static/icon.svg"
html_search_scorer = str(ROOT / "docs" / "search_scorer.js")
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


# The reference: one page for each class and each command, written before the pages are read ----------------------

_MODULE = re.compile(r"^\.\. automodule:: (\S+)\n(?:   :exclude-members: (.+)\n)?", re.MULTILINE)
_CLASSES = re.compile(r"^(?:\.\. autoclass:: \w+\n)+", re.MULTILINE)
_NAME = re.compile(r"^\.\. autoclass:: (\w+)$", re.MULTILINE)
_GENERATED = "generated"  #: folder of ``api``, not in the repository


def _classes(module: str, left_out: str | None) -> list[str]:
    """Names of a module's public classes; errors stay together on its page."""
    found = importlib.import_module(module)
    public = getattr(found, "__all__", None) or [
        name for name, value in vars(found).items() if getattr(value, "__module__", "") == module
    ]
    without = {name.strip() for name in (left_out or "").split(",")}
    named = ((name, getattr(found, name)) for name in public if not name.startswith("_") and name not in without)
    return [name for name, value in named if isclass(value) and not issubclass(value, Exception)]


def _split(text: str) -> str:
    """Return a page of ``api`` with each class moved to a separate page, and replaced by a table of links."""

    def of_module(match: re.Match[str]) -> str:
        module, left_out = match[1], match[2]
        classes = _classes(module, left_out)
        names = ", ".join(filter(None, [left_out, *classes]))
        exclude = f"   :exclude-members: {names}\n" if names else ""
        return f".. automodule:: {module}\n{exclude}\n{_table(classes)}"

    def of_package(match: re.Match[str]) -> str:
        return _table(_NAME.findall(match[0]))

    return _CLASSES.sub(of_package, _MODULE.sub(of_module, text))


def _table(classes: list[str]) -> str:
    """A table of classes of the module that the text is about, with links to their pages."""
    if not classes:
        return ""
    rows = "".join(f"   {name}\n" for name in classes)
    return f".. autosummary::\n   :toctree: {_GENERATED}\n   :nosignatures:\n\n{rows}\n"


def _pages(api: Path) -> Iterator[tuple[str, str]]:
    """Names and texts of the pages to write."""
    for page in sorted(api.glob("*.rst")):
        text = page.read_text()
        found = [(module, _classes(module, left_out)) for module, left_out in _MODULE.findall(text)]
        for module, names in (*found, ("skyloop", _NAME.findall(text))):
            for name in names:
                lines = (name, "=" * len(name), "", f".. currentmodule:: {module}", "", f".. autoclass:: {name}", "")
                yield f"{module}.{name}", "\n".join(lines)
    from command_reference import pages

    yield from pages()


def _write_pages(app: Sphinx, _: Config) -> None:
    folder = Path(app.srcdir) / "api" / _GENERATED
    folder.mkdir(exist_ok=True)
    texts = {folder / f"{name}.rst": text for name, text in _pages(folder.parent)}
    for old in set(folder.iterdir()) - set(texts):
        old.unlink()
    for path, text in texts.items():
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def _read(_: Sphinx, name: str, source: list[str]) -> None:
    if name.startswith("api/") and not name.startswith(f"api/{_GENERATED}"):
        from command_reference import overview

        source[0] = _split(source[0]).replace(".. commands::\n", overview(_GENERATED))


# What the theme leaves out for people who use a screen reader or only the keyboard ------------------------------

_MENDED = (
    (re.compile(r'role="heading">'), 'role="heading" aria-level="2">'),
    (re.compile(r"<pre>"), '<pre tabindex="0">'),  # its lines may be wider than the page
    (re.compile(r'<div class="table-wrapper( [^"]*)?">'), r'<div class="table-wrapper\1" tabindex="0">'),
    (  # the lines of a long signature are no list
        re.compile(r'<dl>\s*((?:<dd><em class="sig-param">(?:(?!</?d[ld]>).)*</dd>\s*)+)</dl>', re.DOTALL),
        lambda found: '<div style="margin-left: 2rem">' + re.sub("<(/?)dd>", r"<\1div>", found[1]) + "</div>",
    ),
    (re.compile(r'<aside class="sidebar-drawer">'), '<aside class="sidebar-drawer" aria-label="Pages">'),
    (re.compile(r'<aside class="toc-drawer( [^"]*)?">'), r'<aside class="toc-drawer\1" aria-label="On this page">'),
)


def _mend(app: Sphinx, exception: Exception | None) -> None:
    for page in app.outdir.rglob("*.html") if exception is None else ():
        before = text = page.read_text()
        for pattern, mended in _MENDED:
            text = pattern.sub(mended, text)
        if text != before:
            page.write_text(text)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("config-inited", _write_pages)
    app.connect("source-read", _read)
    app.connect("build-finished", _loads_nothing)
    app.connect("build-finished", _mend)
