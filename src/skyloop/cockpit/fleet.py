"""All drones that the cockpit knows: found, connected to as an observer, shown as lost, and forgotten.

One connection a drone, for all pages. A drone that vanishes is looked for by its own link and comes back by itself;
only when it was gone for long, and no page shows it, it is let go of. All of this is on the event loop; connecting and
closing, which may wait, are on threads.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.cockpit.finder import Finder, Found
from skyloop.cockpit.station import Station
from skyloop.errors import SkyloopError
from skyloop.messages import LinkState

if TYPE_CHECKING:
    from skyloop.client import Drone

LOOK_S: Final = 0.5
FORGET_S: Final = 60.0  #: gone for so long, a drone is no longer shown as lost
CONNECT_S: Final = 3.0
FIRST_LOOK_S: Final = 2.0  #: how long the first pages wait for those that are slow to answer

Connect = Callable[[Found], "Drone"]
_log = logging.getLogger(__name__)


def observe(found: Found) -> Drone:
    """Connect as an observer. Raises :class:`SkyloopError`."""
    from skyloop.client import Drone

    return Drone(found.dial, app="cockpit", access="observe").open(timeout_s=CONNECT_S)


class Fleet:
    """Stations by name. ``kept`` names are shown for ever once they were there."""

    def __init__(
        self,
        finder: Finder,
        connect: Connect = observe,
        *,
        kept: Collection[str] = (),
        clock: Clock = monotonic_ns,
        look_s: float = LOOK_S,
    ) -> None:
        self.finder = finder
        self.stations: dict[str, Station] = {}
        self.problems: dict[str, str] = {}  #: those found that could not be connected to: why
        self._connect = connect
        self._kept = frozenset(kept)
        self._clock = clock
        self._look_s = look_s
        self._seen_ns: dict[str, int] = {}
        self._connecting: dict[str, asyncio.Task[None]] = {}
        self._closing: set[asyncio.Task[None]] = set()
        self._watching: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Look for the first time, wait for who answers soon, and go on looking."""
        await self.look()
        if self._connecting:
            await asyncio.wait(list(self._connecting.values()), timeout=FIRST_LOOK_S)
        self._watching = asyncio.create_task(self._watch())

    async def close(self) -> None:
        """End all connections and wait for that."""
        waiting = [self._watching, *self._connecting.values()]
        if self._watching is not None:
            self._watching.cancel()
        await asyncio.gather(*(task for task in waiting if task is not None), return_exceptions=True)
        for name in list(self.stations):
            self.let_go(name)
        await asyncio.gather(*self._closing, return_exceptions=True)

    async def look(self) -> None:
        """Look once who is there: connect to new ones, let go of those that are gone for good."""
        found = {one.name: one for one in await asyncio.to_thread(self.finder)}
        now_ns = self._clock()
        for name, one in found.items():
            self._seen_ns[name] = now_ns
            if name not in self.stations and name not in self._connecting:
                self._connecting[name] = asyncio.create_task(self._join(one))
        for name in [name for name in self.problems if name not in found]:
            del self.problems[name]
        for name, station in list(self.stations.items()):
            if station.drone.link.application is not LinkState.LOST:
                self._seen_ns[name] = now_ns
            elif self._forgotten(name, station, now_ns):
                self.let_go(name)

    def want(self, name: str) -> None:
        """Show this one too, though others only were asked for."""
        self.finder.also(name)

    def let_go(self, name: str) -> None:
        """Show it no longer; found again, it comes back. Does nothing for what is not there."""
        if name in self.stations:
            task = asyncio.create_task(self.stations.pop(name).close())
            self._closing.add(task)
            task.add_done_callback(self._closing.discard)

    def _forgotten(self, name: str, station: Station, now_ns: int) -> bool:
        gone_ns = now_ns - self._seen_ns.get(name, now_ns)
        return gone_ns > nanoseconds(FORGET_S) and name not in self._kept and not station.in_use

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(self._look_s)
            try:
                await self.look()
            except (SkyloopError, OSError) as error:
                _log.warning("can't look for drones: %s", error)

    async def _join(self, found: Found) -> None:
        try:
            drone = await asyncio.to_thread(self._connect, found)
        except SkyloopError as error:
            self.problems[found.name] = str(error)  # tried again with the next look
        else:
            self.problems.pop(found.name, None)
            self.stations[found.name] = Station(found, drone)
        finally:
            del self._connecting[found.name]
