"""Count phrases that no native writer of technical English uses, in docstrings, comments, messages and Markdown.

    python scripts/prose.py                    # findings per 1,000 words of each part of the project
    python scripts/prose.py --list docs/faq.md # every finding in some files or folders, as "file:line: pattern: words"
    python scripts/prose.py --check            # holds the ceilings of scripts/budgets.toml: `make check`

A finding is a sentence to rewrite, not a word to replace, and a few are right as they are. The patterns are calibrated
on well-known packages, where they find next to nothing (per 1,000 words: httpx, websockets, click and typer 0.1,
starlette, uvicorn and anyio 0.0, pytest and hypothesis 0.2). Run the script on their folders before you add one.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).parents[1]
BUDGETS: Final = ROOT / "scripts" / "budgets.toml"
LEAST_WORDS: Final = 4  #: in a string constant that counts as text
SKIPPED: Final = {"node_modules", "static", "build", "__pycache__"}  #: folders

_BE: Final = r"(?:is|are|was|were|be|been|being)"
_DOES: Final = (
    r"(?:is|are|was|were|has|had|does|comes?|came|goes|went|flies|flew|asks?|waits?|wants?|needs?|takes?|stands?|sees?|"
    r"holds?|follows?|arrives?|happens?|remains?|belongs?|becomes?|became|gets?|makes?|knows?|moves?|reads?|runs?|sends?)"
)
#: The names of the patterns and their expressions, matched without regard to case.
PATTERNS: Final = {
    "clause for a noun": rf"(?:^|[.:;(] |\b(?:of|for|by|to|with|from|than|as|and|or|but) )"
    rf"(?:who|whoever|what|whatever|whom) (?:\w+ )?{_DOES}\b(?!\?)",
    "archaic": r"\b(?:anew|in vain|thereby|whereby|thereof|therein|wherefrom|whereupon|farther|till)\b",
    "to be had": rf"\b{_BE} (?:to be had|of no use|at fault|left of)\b|\bnothing is known\b",
    "still standing": r"\b(?:stands?|stood|standing) still\b|\bgo(?:es|ing)? on\b",
    "by itself": r"\b(?:by (?:itself|themselves)|(?:of|on) (?:its|their) own)\b",
    "so much": r"\b(?:(?:for )?so (?:long|many|much|often)(?! as\b)|at most so|as (?:it|they) came)\b",
    "telling": rf"\b{_BE} (?:told|said|heard|asked for|looked at|thought of|waited for|spoken of|given up|let go)\b",
    "inverted": r"\b(?:one after the other|again and again|in the meantime|at the latest|twice at most|each time that|"
    r"no more than that|as the case may be|no fault|do(?:es)? without|comes by|and the like)\b",
}
_COMPILED: Final = {name: re.compile(words, re.IGNORECASE | re.MULTILINE) for name, words in PATTERNS.items()}


class Finding(NamedTuple):
    """A phrase to rewrite."""

    path: Path
    line: int
    pattern: str
    words: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.pattern}: …{self.words}…"


def python_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of each comment, and of each string constant that has several words."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) >= LEAST_WORDS:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#: ")


def markdown_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of each line outside of code, without inline code and the targets of links."""
    is_code = False
    for number, line in enumerate(source.splitlines(), 1):
        if line.lstrip().startswith("```"):
            is_code = not is_code
        elif not is_code:
            yield number, re.sub(r"`[^`]*`|\]\([^)]*\)", " ", line)


def search(root: Path) -> tuple[int, list[Finding]]:
    """Return the number of words below a file or folder, and the findings in them."""
    files = [root] if root.is_file() else sorted(path for end in ("py", "md") for path in root.rglob(f"*.{end}"))
    words, found = 0, []
    for path in files:
        if SKIPPED & set(path.relative_to(root).parts):
            continue
        source = path.read_text(encoding="utf-8")
        for line, text in python_texts(source) if path.suffix == ".py" else markdown_texts(source):
            words += len(text.split())
            for name, pattern in _COMPILED.items():
                for hit in pattern.finditer(text):
                    around = " ".join(text[max(0, hit.start() - 25) : hit.end() + 25].split())
                    found.append(Finding(path, line + text.count("\n", 0, hit.start()), name, around))
    return words, found


def main(arguments: Sequence[str]) -> int:
    """Return 0 unless a ceiling is to be held and is not."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").partition("\n")[0],
        epilog="Example: python scripts/prose.py --list docs/faq.md",
    )
    parser.add_argument("paths", nargs="*", type=Path, help="files and folders [default: those with a ceiling]")
    parser.add_argument("--list", action="store_true", help="print every finding")
    parser.add_argument("--check", action="store_true", help="hold the ceilings of scripts/budgets.toml")
    options = parser.parse_args(arguments)
    ceilings = tomllib.loads(BUDGETS.read_text(encoding="utf-8"))["prose"]
    exceeded = []
    for path in options.paths or [ROOT / name for name in ceilings]:
        words, found = search(path)
        rate = 1000.0 * len(found) / max(1, words)
        name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else str(path)
        if options.list:
            print(*found, sep="\n", end="\n" if found else "")
        if not options.check:
            print(f"{name}: {len(found)} findings in {words:,} words, {rate:.1f} per 1,000")
        elif rate > ceilings.get(name, 0.0):
            exceeded.append(
                f"{name}: {rate:.2f} findings per 1,000 words, at most {ceilings.get(name, 0.0)} are allowed"
            )
    print(*exceeded, sep="\n", file=sys.stderr, end="\n" if exceeded else "")
    return 1 if exceeded else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
