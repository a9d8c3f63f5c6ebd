"""The overview that a proxy publishes once a second: a row of its vehicle, and of all others of the same process."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import msgspec

from skyloop.clock import nanoseconds
from skyloop.messages import Overview, VehicleOverview, encode
from skyloop.transport.base import OVERVIEW, TransportServer

PERIOD_NS: Final = nanoseconds(1.0)
_FRESH_NS: Final = PERIOD_NS // 2  # an overview so young is sent again instead of making another one
_replace = msgspec.structs.replace


class OverviewRegistry:
    """The rows of all proxies of a process, made and encoded once for all that publish them. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: dict[Callable[[], VehicleOverview], None] = {}
        self._seq = 0
        self._made_ns: int | None = None
        self._packets: list[bytes] = []

    def add(self, row: Callable[[], VehicleOverview]) -> None:
        """Add a vehicle.

        Args:
            row: Returns its row; called on any proxy's ticker.
        """
        with self._lock:
            self._sources[row] = None
            self._made_ns = None

    def remove(self, row: Callable[[], VehicleOverview]) -> None:
        """Remove a vehicle. Does nothing if it is not there."""
        with self._lock:
            self._sources.pop(row, None)
            self._made_ns = None

    def packets(self, now_ns: int) -> list[bytes]:
        """Return the overview of now, encoded, in as many packets as it needs."""
        with self._lock:
            if self._made_ns is None or not 0 <= now_ns - self._made_ns < _FRESH_NS:
                rows = sorted((row() for row in self._sources), key=lambda row: row.name)
                self._seq += 1
                self._made_ns = now_ns
                whole = Overview(at_ns=now_ns, seq=self._seq, total=len(rows), vehicles=tuple(rows))
                self._packets = _encoded(whole)
            return self._packets


class OverviewPublisher:
    """Publishes the overview on one proxy's transport while anybody subscribes to it, once a second.

    A new subscriber is sent one at once.
    """

    def __init__(self, server: TransportServer, row: Callable[[], VehicleOverview]) -> None:
        self.registry = OverviewRegistry()  #: whose rows are published; by default only one's own
        self._server = server
        self._row = row
        self._subscribers = 0
        self._due_ns = 0

    def share(self, registry: OverviewRegistry) -> None:
        """Publish the rows of others too, and give them one's own. Call before :meth:`begin`.

        Does nothing where applications may be let in to one proxy and not to another: they would see the others' rows.
        """
        if not self._server.restricted:
            self.registry = registry

    def begin(self) -> None:
        """Show the vehicle in the overview."""
        self.registry.add(self._row)

    def end(self) -> None:
        """Show it no longer."""
        self.registry.remove(self._row)

    def tick(self, now_ns: int) -> None:
        """Publish the overview if it is due. Call some times a second."""
        before, self._subscribers = self._subscribers, self._server.subscribers(OVERVIEW)
        if self._subscribers and (self._subscribers > before or now_ns >= self._due_ns):
            self._due_ns = now_ns + PERIOD_NS
            for packet in self.registry.packets(now_ns):
                self._server.publish(OVERVIEW, packet)


def _encoded(page: Overview) -> list[bytes]:
    """Encode rows to one packet, or to several if they are too many for one."""
    try:
        return [encode(page)]
    except ValueError:
        if len(page.vehicles) < 2:
            raise
        half = len(page.vehicles) // 2
        one = _replace(page, vehicles=page.vehicles[:half])
        other = _replace(page, first=page.first + half, vehicles=page.vehicles[half:])
        return _encoded(one) + _encoded(other)
