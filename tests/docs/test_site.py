"""The documentation site shows every page and every public name; `make docs` builds it and checks its links."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

import skyloop
from skyloop.cli.commands import COMMANDS
from tests.support.pages import ROOT, blocks

DOCS = ROOT / "docs"
REFERENCE = {path.stem: path.read_text() for path in (DOCS / "api").glob("*.rst")}
_TOCTREE = re.compile(r"^:::\{toctree\}\n(.*?)^:::$", re.MULTILINE | re.DOTALL)


def listed() -> list[str]:
    """The pages of the site's navigation."""
    lines = "\n".join(_TOCTREE.findall((DOCS / "index.md").read_text())).splitlines()
    return [line.strip() for line in lines if line.strip() and not line.startswith(":")]


def test_the_navigation_has_each_page_once() -> None:
    pages = [path for path in (*DOCS.rglob("*.md"), *DOCS.rglob("*.rst")) if path.parent.name != "generated"]
    names = [str(path.relative_to(DOCS).with_suffix("")) for path in pages]
    assert sorted(listed()) == sorted(name for name in names if name != "index")


@pytest.mark.parametrize("name", [name for name in vars(skyloop)["__all__"] if name != "__version__"])
def test_the_reference_has_each_name_that_skyloop_offers(name: str) -> None:
    assert re.search(rf"\b{name}\b", REFERENCE["skyloop"])


def test_names_not_documented_elsewhere_are_shown_with_skyloop() -> None:
    left_out = ",".join(re.findall(r":exclude-members: (.+)", "\n".join(REFERENCE.values())))
    for name in filter(None, (name.strip() for name in left_out.split(","))):
        assert re.search(rf"^\.\. auto(class|function):: {name}$", REFERENCE["skyloop"], re.MULTILINE), name


def test_the_reference_has_each_command_with_its_options() -> None:
    """``make docs`` checks the result in the site."""
    text = runpy.run_path(str(ROOT / "scripts" / "command_reference.py"))["reference"]()
    sections = dict(re.findall(r"^\.\. program:: skyloop (.+)\n((?:(?!\.\. program::).*\n)*)", text, re.MULTILINE))
    assert set(COMMANDS) <= set(sections)
    assert ".. option:: --seconds N" in sections["demo"]
    assert ".. option:: --json" in sections["log recover"]
    assert "asks first, except with ``--yes``" in sections["stop"]
    assert "   skyloop land [OPTIONS] NAME..." in sections["land"]
    assert "Show this message" not in text
    assert str(Path.home()) not in text, "it is the same on each machine"


INDEX = (DOCS / "index.md").read_text()


def test_the_first_page_shows_a_flight_before_the_first_program() -> None:
    first = INDEX.index("![")
    assert INDEX[first:].partition("(")[2].startswith("pictures/examples/follow_marker.webp)")
    assert first < INDEX.index("```python")


@pytest.mark.parametrize("page", ["index.md", *(f"start/{path.name}" for path in (DOCS / "start").glob("*.md"))])
def test_the_first_programs_fit_beside_the_navigation(page: str) -> None:
    """The key line of the first page's program was cut at the right edge, in a window of 1280 px."""
    for block in blocks("python"):
        if block.page == DOCS / page:
            assert max(map(len, block.code.splitlines())) <= 88, str(block)


def test_the_guides_are_grouped() -> None:
    trees = [re.findall(r"^[\w/-]+$", tree, re.MULTILINE) for tree in _TOCTREE.findall(INDEX)]
    guides = [tree for tree in trees if not any(page.startswith(("api/", "start/")) for page in tree)]
    assert max(map(len, guides)) <= 11


def test_remedies_come_first_in_the_search() -> None:
    """A search for "lost connection" found 37 pages, and Troubleshooting not among the first eight."""
    scorer = (DOCS / "search_scorer.js").read_text()
    assert "troubleshooting: 40" in scorer
    symptoms = (DOCS / "troubleshooting.md").read_text().lower()
    assert all(word in symptoms for word in ("lost connection", "does not take off", "no frame comes"))
