"""Put tables into the marked places of a page. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping

from skyloop.errors import UsageError


def fill(page: str, blocks: Mapping[str, str], kind: str = "measured") -> str:
    """Return the page with these texts between ``<!-- measured: NAME -->`` and ``<!-- end -->``; other places stay.

    ``kind`` replaces ``measured``. Raises :class:`UsageError` if the page has no place for a text.
    """
    placed: set[str] = set()

    def put(match: re.Match[str]) -> str:
        name = match[2]
        if name not in blocks:
            return match[0]
        placed.add(name)
        return f"{match[1]}{blocks[name].strip()}\n{match[4]}"

    filled = re.sub(rf"(<!-- {kind}: (\S+) -->\n)(.*?)(<!-- end -->)", put, page, flags=re.DOTALL)
    missing = sorted(set(blocks) - placed)
    if missing:
        raise UsageError(f"the page has no place marked <!-- {kind}: {missing[0]} -->")
    return filled
