"""Write the tables generated from the code into pages, between ``<!-- made: NAME -->`` and ``<!-- end -->``.

python -m scripts.doc_tables            # `make docs` does it first
python -m scripts.doc_tables --check    # exits with 1 if a page is out of date, like the tests
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from benchmarks.pages.fill import fill
from skyloop.messages.command import ENDINGS
from skyloop.proxy.parameters import OWN

DOCS: Final = Path(__file__).parents[1] / "docs"


def parameters() -> str:
    """Return the proxy's parameters with their defaults."""
    rows = []
    for own in OWN:
        number = isinstance(own.value, float)
        default = f"{own.value:g}" if number else str(own.value)
        limits = f"{own.minimum:g} to {own.maximum:g}" if number else ""
        rows.append((f"`{own.name}`", default, own.unit, limits, own.description))
    return table(("name", "default", "unit", "range", "meaning"), rows)


def fates() -> str:
    """Return the causes that end an intent."""
    return table(("fate", "what ends an intent"), [(f"`{fate.value}`", words) for fate, words in ENDINGS.items()])


def attempts() -> str:
    """Return the attempts of intruders, and where they succeeded."""
    from tests.promises.security.deeds import COLUMNS, DEEDS, works

    rows = [(deed.what, *("**works**" if works(deed, who) else "–" for who in COLUMNS)) for deed in DEEDS]
    return table(("tries to", *COLUMNS.values()), rows)


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    lines = ["|".join(f" {cell} " if cell else " " for cell in row) for row in (head, *rows)]
    return "\n".join([f"|{lines[0]}|", "|" + "---|" * len(head), *(f"|{line}|" for line in lines[1:])])


PAGES: Final[Mapping[str, Mapping[str, Callable[[], str]]]] = {
    "proxy.md": {"parameters": parameters, "fates": fates},
    "security.md": {"attempts": attempts},
}


def made(page: str) -> tuple[str, str]:
    """Return a page as it is, and as it should be."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return text, fill(text, {name: make() for name, make in PAGES[page].items()}, "made")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    stale = False
    for page in PAGES:
        text, wanted = made(page)
        if text == wanted:
            continue
        stale = True
        print(f"docs/{page} {'is out of date' if check else 'written'}")
        if not check:
            (DOCS / page).write_text(wanted, encoding="utf-8")
    return int(stale and check)


if __name__ == "__main__":
    sys.exit(main())
