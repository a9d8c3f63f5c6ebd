"""Drones on the network, beside those of this host."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skyloop.cockpit.finder import Finder, Found

if TYPE_CHECKING:
    from skyloop.transport.fabric import FabricSettings
    from skyloop.transport.fabric.session import Session


class NetworkFinder:
    """Those of this host first, then those that can be reached over the network under another name.

    Opens one session at the first look and keeps it, so that a further look costs little.
    """

    def __init__(self, near: Finder, settings: FabricSettings, wanted: frozenset[str] = frozenset()) -> None:
        """``wanted``: only these names; empty: all."""
        self._near = near
        self._settings = settings
        self._wanted = wanted
        self._session: Session | None = None
        self._known: dict[str, Found] = {}

    def also(self, name: str) -> None:
        self._near.also(name)
        if self._wanted:
            self._wanted |= {name}

    def __call__(self) -> list[Found]:
        from skyloop.transport.fabric.finding import runs

        found = {one.name: one for one in self._near()}
        for name, _ in sorted(runs(self._open())):
            if name not in found and (not self._wanted or name in self._wanted):
                found[name] = self._far(name)
        return [found[name] for name in sorted(found)]

    def close(self) -> None:
        from skyloop.transport.fabric.session import release

        session, self._session = self._session, None
        if session is not None:
            release(session)

    def _open(self) -> Session:
        from skyloop.transport.fabric.config import Part
        from skyloop.transport.fabric.session import acquire

        if self._session is None:
            self._session = acquire(self._settings, Part.APP)
        return self._session

    def _far(self, name: str) -> Found:
        from skyloop.transport.fabric import dial

        if name not in self._known:
            self._known[name] = Found(name, "network", dial(name, self._settings))
        return self._known[name]
