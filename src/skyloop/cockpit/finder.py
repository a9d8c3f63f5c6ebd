"""Which drones there are: the proxies of this host, found by their sockets without any of them noticing."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple, Protocol

from skyloop.transport.base import Dialer


class Found(NamedTuple):
    """A proxy that can be connected to."""

    name: str
    transport: str  #: as a person reads it: ``local``
    dial: Dialer


class Finder(Protocol):
    """Looks who is there, again and again, on threads."""

    def __call__(self) -> list[Found]:
        """Those that are there now. Raises :class:`SkyloopError`, ``OSError``."""

    def also(self, name: str) -> None:
        """Find this one too, though only others were asked for."""

    def close(self) -> None:
        """Give back what looking needs. Idempotent."""


class LocalFinder:
    """The proxies of this host that this user may reach: all, or those with a name that is wanted."""

    def __init__(self, names: Collection[str] = ()) -> None:
        """``names``: only these; none: all."""
        self._names = frozenset(names)
        self._also: set[str] = set()
        self._known: dict[tuple[str, Path], Found] = {}

    def also(self, name: str) -> None:
        self._also.add(name)

    def close(self) -> None:
        """It holds nothing."""

    def __call__(self) -> list[Found]:
        from skyloop.transport.local import dial
        from skyloop.transport.local.directory import find_directory, is_live
        from skyloop.transport.names import NAME

        folder = find_directory().path
        try:
            files = sorted(entry.path for entry in os.scandir(folder))
        except FileNotFoundError:
            return []
        found = []
        for path in map(Path, files):
            name = path.stem
            if path.suffix == ".sock" and NAME.fullmatch(name) and self._wanted(name) and is_live(path):
                found.append(self._known.setdefault((name, path), Found(name, "local", dial(name))))
        return found

    def _wanted(self, name: str) -> bool:
        return not self._names or name in self._names or name in self._also
