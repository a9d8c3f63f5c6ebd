"""Commands of ``skyloop``, and how they end."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

FAST_SIM = "sim://?world=empty&cameras=none&speed=6&wind=0"


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


Run = Callable[..., Ended]
