"""Parts of the documentation's pages: code blocks, code in the text, sections."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [
        *(ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING", "SECURITY")),
        *(ROOT / "docs").rglob("*.md"),
    ]
)
#: Only such a comment right above a block, with the reason, excludes the block from the tests.
_SKIPPED = re.compile(r"<!-- not run: (.+) -->")
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block of code."""

    page: Path
    line: int  #: number of its first line of code
    language: str
    code: str
    skipped: str  #: why it is not run; empty if it is run

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(*languages: str) -> list[Block]:
    """Return all blocks in these languages, page by page."""
    return [
        block
        for page in PAGES
        for block in _blocks(page, page.read_text())
        if not languages or block.language in languages
    ]


def _blocks(page: Path, text: str) -> list[Block]:
    found = []
    for match in _BLOCK.finditer(text):
        above = text[: match.start()].rstrip().rpartition("\n")[2]
        skipped = _SKIPPED.fullmatch(above)
        line = text.count("\n", 0, match.start()) + 2
        found.append(Block(page, line, match[1], match[2], skipped[1] if skipped else ""))
    return found


def prose(page: Path) -> str:
    """Return a page without its code blocks."""
    return _BLOCK.sub("", page.read_text())


def spans(page: Path) -> list[str]:
    """Return the code within a page's text."""
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose(page))]


def section(page: str, heading: str) -> str:
    """Return the text under a heading of a page, up to the next one of the same or a higher level."""
    text = (ROOT / page).read_text()
    rank = len(heading) - len(heading.lstrip("#"))
    found = re.search(rf"^{re.escape(heading)}$\n(.*?)(?=^#{{1,{rank}}} |\Z)", text, re.MULTILINE | re.DOTALL)
    assert found, f"{page} has no heading {heading!r}"
    return found[1]


def rows(table: str) -> list[list[str]]:
    """Return the cells of the tables in a text, without headers, rulers and the backquotes around whole cells."""
    found: list[list[str]] = []
    lines = table.splitlines()
    for number, line in enumerate(lines):
        ruler_next = number + 1 < len(lines) and lines[number + 1].startswith("|-")
        if line.startswith("| ") and not ruler_next:
            found.append([cell.strip() for cell in line.strip("|").split("|")])
    return found
