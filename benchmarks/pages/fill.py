"""Puts tables into the marked places of a page. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping

from skyloop.errors import UsageError

_BLOCK = re.compile(r"(<!-- measured: (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def fill(page: str, blocks: Mapping[str, str]) -> str:
    """The page with these texts between ``<!-- measured: NAME -->`` and ``<!-- end -->``; other places stay.

    Raises :class:`UsageError` for a text that the page has no place for.
    """
    placed: set[str] = set()

    def put(match: re.Match[str]) -> str:
        name = match[2]
        if name not in blocks:
            return match[0]
        placed.add(name)
        return f"{match[1]}{blocks[name].strip()}\n{match[4]}"

    filled = _BLOCK.sub(put, page)
    missing = sorted(set(blocks) - placed)
    if missing:
        raise UsageError(f"the page has no place marked <!-- measured: {missing[0]} -->")
    return filled
