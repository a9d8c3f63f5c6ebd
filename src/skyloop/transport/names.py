"""What can be the name of a proxy: one of a socket's file and of one chunk of a network key."""

from __future__ import annotations

import re
from typing import Final

from skyloop.errors import UsageError

NAME: Final = re.compile(r"[a-z0-9][a-z0-9_.-]{0,47}")


def check_name(name: str) -> None:
    """Raise :class:`UsageError` for what cannot be the name of a proxy."""
    if not NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot be the name of a proxy: 1 to 48 lower-case letters, digits, '_', '-' and '.', "
            "the first one a letter or a digit"
        )
