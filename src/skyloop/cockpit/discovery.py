"""Find the proxies on this host and on the network."""

from __future__ import annotations

import threading
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from skyloop.transport.base import Dialer

if TYPE_CHECKING:
    from skyloop.network import FabricSettings
    from skyloop.network.session import FabricSession


class FoundProxy(NamedTuple):
    """A proxy that can be connected to."""

    name: str
    transport: str  #: transport as shown to users, such as ``local``
    dial: Dialer


class Finder(Protocol):
    """Searches for proxies repeatedly, on threads other than that of the event loop."""

    def __call__(self) -> list[FoundProxy]:
        """Return the proxies that can be connected to now."""

    def add_name(self, name: str) -> None:
        """Also find this proxy if the search is limited to certain names."""

    def close(self) -> None:
        """Release the resources of the search. Idempotent."""


class LocalFinder:
    """Finds the proxies on this host that this user can reach."""

    def __init__(self, names: Collection[str] = ()) -> None:
        """Prepare the search. ``names``: the names to search for; if empty, all names are searched for."""
        self._names = frozenset(names)
        self._also: set[str] = set()
        self._known: dict[tuple[str, Path], FoundProxy] = {}

    def add_name(self, name: str) -> None:
        self._also.add(name)

    def close(self) -> None:
        """Do nothing: each search closes what it opens."""

    def __call__(self) -> list[FoundProxy]:
        from skyloop.transport.local import dial
        from skyloop.transport.local.directory import find_directory

        found = []
        for name, path in find_directory().running().items():
            if self._wanted(name):
                found.append(self._known.setdefault((name, path), FoundProxy(name, "local", dial(name))))
        return found

    def _wanted(self, name: str) -> bool:
        return not self._names or name in self._names or name in self._also


class NetworkFinder:
    """Finds the proxies on this host, and those on the network that have other names. Any thread.

    The first search opens a session and keeps it open, so later searches are cheap.
    """

    def __init__(self, local: Finder, settings: FabricSettings, wanted: frozenset[str] = frozenset()) -> None:
        """Prepare the search.

        ``local``: finds the proxies of this host. ``settings``: how to join the network. ``wanted``: the names to
        search for; if empty, search for all names.
        """
        self._local = local
        self._settings = settings
        self._wanted = wanted
        self._lock = threading.Lock()  # guards the settings and the following fields: several threads may search
        self._session: FabricSession | None = None
        self._known: dict[str, FoundProxy] = {}

    def add_name(self, name: str) -> None:
        self._local.add_name(name)
        if self._wanted:
            self._wanted |= {name}

    def __call__(self) -> list[FoundProxy]:
        from skyloop.network.discovery import runs

        found = {one.name: one for one in self._local()}
        for name, _ in sorted(runs(self._open())):
            if name not in found and (not self._wanted or name in self._wanted):
                found[name] = self._found(name)
        return [found[name] for name in sorted(found)]

    def close(self) -> None:
        from skyloop.network.session import release

        with self._lock:
            session, self._session = self._session, None
        if session is not None:
            release(session)

    def _open(self) -> FabricSession:
        from skyloop.network.config import Part
        from skyloop.network.session import acquire, release

        with self._lock:
            current = self._settings.current()
            if self._session is not None and current is not self._settings:
                release(self._session)  # the roster has changed, and revoked members must not be discovered anymore
                self._session = None
            self._settings = current
            if self._session is None:
                self._session = acquire(current, Part.APP)
            return self._session

    def _found(self, name: str) -> FoundProxy:
        from skyloop.network import dial

        with self._lock:
            if name not in self._known:
                self._known[name] = FoundProxy(name, "network", dial(name, self._settings))
            return self._known[name]
