"""The documentation site shows every page and every public name; `make docs` builds it and checks its links."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

import skyloop
from skyloop.cli.commands import COMMANDS
from tests.docs.pages import ROOT

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


def test_what_other_packages_leave_out_is_shown_with_skyloop() -> None:
    left_out = ",".join(re.findall(r":exclude-members: (.+)", "\n".join(REFERENCE.values())))
    for name in filter(None, (name.strip() for name in left_out.split(","))):
        assert re.search(rf"^\.\. auto(class|function):: {name}$", REFERENCE["skyloop"], re.MULTILINE), name


def test_the_reference_has_each_command_with_its_options() -> None:
    """What becomes of it in the site is checked by ``make docs``."""
    text = runpy.run_path(str(ROOT / "scripts" / "command_reference.py"))["reference"]()
    sections = dict(re.findall(r"^\.\. program:: skyloop (.+)\n((?:(?!\.\. program::).*\n)*)", text, re.MULTILINE))
    assert set(COMMANDS) <= set(sections)
    assert ".. option:: --seconds N" in sections["demo"]
    assert ".. option:: --json" in sections["log recover"]
    assert "asks before, except with ``--yes``" in sections["stop"]
    assert "   skyloop land [OPTIONS] NAME..." in sections["land"]
    assert "Show this message" not in text
    assert str(Path.home()) not in text, "it is the same on each machine"
