"""The tests that the pages name for their promises exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.pages import PAGES, ROOT, rows, section, spans

SECURITY = "docs/security.md"
_TEST = re.compile(r"test_\w+")
_DEFINED = re.compile(r"^\s*(?:async )?def (test_\w+)", re.MULTILINE)


@pytest.fixture(scope="module")
def existing() -> set[str]:
    return {name for file in (ROOT / "tests").rglob("test_*.py") for name in _DEFINED.findall(file.read_text())}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tests_named_on_pages_exist(page: Path, existing: set[str]) -> None:
    named = [span for span in spans(page) if _TEST.fullmatch(span)]
    assert [name for name in named if name not in existing] == []


def test_each_promise_names_its_tests() -> None:
    promises = [cells for cells in rows(section(SECURITY, "## Threat model")) if "`test" in cells[-1]]
    assert len(promises) > 15
    table = section(SECURITY, "## Threat model").partition("| promise | held by |")[2]
    assert [cells[0] for cells in rows(table) if not re.search(r"`(test_\w+|tests/[\w/]+\.py)`", cells[-1])] == []
