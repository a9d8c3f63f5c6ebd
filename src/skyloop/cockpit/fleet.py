"""All drones known to the cockpit: finding, observing and forgetting them, showing lost ones, and commanding them all.

All pages share one connection to each drone. If a drone disappears, its connection searches for it and restores it. The
drone is removed only after a long absence, and only if no page shows it. Everything here runs on the event loop, except
for connecting and closing, which may block and therefore run on threads. A page's commands to all drones (land all,
stop all) work even if no drone is open or selected.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Coroutine, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from starlette.websockets import WebSocket

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.alarms import Alarm, AlarmSeverity
from skyloop.cockpit.commands import SETTLED_NS, Alive, LandAll, StopAll, decode_fleet_command, late_s, untimely
from skyloop.cockpit.discovery import Finder, FoundProxy
from skyloop.cockpit.feeds import PeriodicBroadcast, start_task
from skyloop.cockpit.station import Station
from skyloop.cockpit.stream import PageSocket
from skyloop.cockpit.telemetry import encode_json
from skyloop.errors import DecodeError, LinkError, SkyloopError, UnknownNameError
from skyloop.messages import HIGHEST_PRIORITY, FlightState, Land, LinkState

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.recordings import Recordings

SEARCH_S: Final = 0.5  #: interval between searches
FORGET_S: Final = 60.0  #: a drone lost for longer than this is removed from the page
CONNECT_S: Final = 3.0  #: time limit for connecting to a proxy
OVERVIEW_S: Final = 0.5  #: interval between overviews sent to pages
FIRST_SEARCH_S: Final = 2.0  #: maximum time that the first pages wait for slow drones

Connect = Callable[[FoundProxy], "Drone"]
_log = logging.getLogger(__name__)
LANDING_S: Final = 60.0  #: time for which the landing command is repeated
BEGIN_S: Final = 2.0  #: time limit for opening the connection needed to begin a landing
_POLL_S: Final = 0.05  # interval between checks whether a drone has landed

Json = dict[str, Any]


def observe(found: FoundProxy) -> Drone:
    """Connect to a proxy as an observer; raise ``SkyloopError`` if that takes longer than :data:`CONNECT_S`."""
    from skyloop.client.drone import open_drone

    return open_drone(found.dial, app="cockpit", access="observe", timeout_s=CONNECT_S)


class CockpitFleet:
    """The stations, by drone name.

    ``connect``: connects to a proxy; called on worker threads. ``kept``: names that stay listed once found.
    """

    def __init__(
        self,
        finder: Finder,
        connect: Connect = observe,
        *,
        kept: Collection[str] = (),
        clock: Clock = monotonic_ns,
        search_s: float = SEARCH_S,
    ) -> None:
        self.finder = finder
        self.stations: dict[str, Station] = {}
        self.problems: dict[str, str] = {}  #: proxies that were found but could not be connected to, with the reason
        self._connect = connect
        self._kept = frozenset(kept)
        self._clock = clock
        self._search_s = search_s
        self._seen_ns: dict[str, int] = {}
        self._found: dict[str, FoundProxy] = {}  # the proxies found by the last search
        self._over: set[str] = set()  # proxies that are ending, until they are no longer found
        self._connecting: dict[str, asyncio.Task[None]] = {}
        self._closing: set[asyncio.Task[None]] = set()
        self._watching: asyncio.Task[None] | None = None
        self._begun: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        """Search once, wait up to :data:`FIRST_SEARCH_S` for the proxies that were found, then keep searching."""
        await self.search()
        if self._connecting:
            await asyncio.wait(list(self._connecting.values()), timeout=FIRST_SEARCH_S)
        self._watching = asyncio.create_task(self._watch())

    async def close(self) -> None:
        """Close all connections and wait until they are closed."""
        waiting = [self._watching, *self._connecting.values()]
        if self._watching is not None:
            self._watching.cancel()
        for task in self._begun:
            task.cancel()
        await asyncio.gather(*(task for task in waiting if task is not None), *self._begun, return_exceptions=True)
        for name in list(self.stations):
            self.let_go(name)
        await asyncio.gather(*self._closing, return_exceptions=True)

    def begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Start work that continues even after the page that requested it has disconnected."""
        start_task(work, self._begun)

    async def search(self) -> None:
        """Search once: start connecting to new proxies, and remove drones that have been lost for a long time."""
        found = {one.name: one for one in await asyncio.to_thread(self.finder)}
        now_ns = self._clock()
        self._over &= found.keys()
        for name in self._over:
            del found[name]
        for name, one in found.items():
            self._seen_ns[name] = now_ns
            self._found[name] = one
            if station := self.stations.get(name):
                station.found = station.found._replace(transport=one.transport)
            elif name not in self._connecting:
                self._connecting[name] = asyncio.create_task(self._join(one))
        for name in [name for name in self.problems if name not in found]:
            del self.problems[name]
        for name, station in list(self.stations.items()):
            if station.drone.link.application is not LinkState.LOST:
                self._seen_ns[name] = now_ns
            elif self._forgotten(name, station, now_ns):
                self.let_go(name)

    def station(self, name: str) -> Station:
        """Return a drone's station; raise :class:`UnknownNameError` if there is none."""
        if name not in self.stations:
            raise UnknownNameError("drone", name, self.stations)
        return self.stations[name]

    @property
    def unreached(self) -> dict[str, str]:
        """Names of drones that were found but are not connected and can't be commanded, each with the reason."""
        waiting = dict.fromkeys(self._connecting, "the cockpit is still connecting to it")
        return {**waiting, **self.problems}

    def let_go(self, name: str, *, ending: bool = False) -> None:
        """Remove a drone; it reappears if it is found again, or if its proxy is ``ending``, after that was gone."""
        if ending:
            self._over.add(name)
        if name in self.stations:
            start_task(self.stations.pop(name).close(), self._closing)

    def _forgotten(self, name: str, station: Station, now_ns: int) -> bool:
        gone_ns = now_ns - self._seen_ns.get(name, now_ns)
        return gone_ns > nanoseconds(FORGET_S) and name not in self._kept and not station.in_use

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(self._search_s)
            try:
                await self.search()
            except (SkyloopError, OSError) as error:
                _log.warning("can't search for drones: %s", error)

    async def _join(self, found: FoundProxy) -> None:
        # A drone may move to another host under the same name; new connections will then find it there.
        found = found._replace(dial=lambda handler: self._found[found.name].dial(handler))
        try:
            drone = await asyncio.to_thread(self._connect, found)
        except SkyloopError as error:
            self.problems[found.name] = str(error)  # the next search tries again
        else:
            self.problems.pop(found.name, None)
            self.stations[found.name] = Station(found, drone)
        finally:
            del self._connecting[found.name]


class FleetOverview:
    """All drones in one message, created twice a second for all pages."""

    def __init__(self, fleet: CockpitFleet, recordings: Recordings, period_s: float = OVERVIEW_S) -> None:
        self._fleet = fleet
        self._recordings = recordings
        self.broadcast = PeriodicBroadcast(period_s, self._make, lambda _: None)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each drone, by name, including drones that were found but did not respond."""
        recorded = self._recordings.drones()
        rows = []
        for name, station in self._fleet.stations.items():
            replay = name in self._recordings.replays
            rows.append({**station.view.overview(), "recording": name in recorded, "replay": replay})
        for name, problem in self._fleet.problems.items():
            rows.append(_silent(name, problem))
        return sorted(rows, key=lambda row: str(row["name"]))

    def _make(self) -> bytes:
        return encode_json({"type": "overview", "now_s": seconds(monotonic_ns()), "drones": self.rows()})


def _silent(name: str, problem: str) -> dict[str, Any]:
    unknown = ("battery", "position", "altitude", "yaw", "owner")
    return {
        "name": name,
        "uri": "",
        "vehicle": "",
        "transport": "",
        "state": "unknown",
        "airborne": False,
        "can_fly": False,
        "why_not": problem,
        "cameras": [],
        "me": False,
        "links": {"application": "lost", "vehicle": "connecting", "reason": problem, "remedy": ""},
        "alarms": [Alarm("application_link", AlarmSeverity.CRITICAL, problem)],
        "recording": False,
        "replay": False,
        **dict.fromkeys(unknown),
    }


class FleetSession:
    """Serves one socket of a pilot's page; its commands complete even if the page goes away. Used on the event loop."""

    def __init__(self, socket: WebSocket, fleet: CockpitFleet, person: str = "", clock: Clock = monotonic_ns) -> None:
        self._page = PageSocket(socket)
        self._send = self._page.send
        self._fleet = fleet
        self._app = f"{person} (cockpit, all)" if person else "cockpit, all"
        self._clock = clock

    async def run(self) -> None:
        await self._page.serve(self._on_messages)

    def _on_messages(self, texts: Sequence[str | bytes]) -> None:
        for text in texts:
            self._on_message(text)

    def _on_message(self, text: str | bytes) -> None:
        now_s = seconds(self._clock())
        try:
            command = decode_fleet_command(text)
        except DecodeError as error:
            self._send({"type": "refused", "do": "", "n": 0, "why": str(error)})
            return
        if isinstance(command, Alive):
            self._send({"type": "pong", "n": command.n, "now_s": now_s})
        elif problem := untimely(command, now_s):
            self._send({"type": "refused", "do": command.do, "n": command.n, "why": problem})
        else:
            stations = [station for _, station in sorted(self._fleet.stations.items()) if station.flies]
            unreached = self._fleet.unreached  # a person who stops all drones must know which could not be reached
            names = sorted([*(station.found.name for station in stations), *unreached])
            self._send({"type": "sent", "do": command.do, "n": command.n, "drones": names})
            for name, why in unreached.items():
                each = {"type": "each", "do": command.do, "n": command.n, "drone": name}
                self._send({**each, "state": "refused", "why": why})
            for station in stations:
                self._fleet.begin(self._run(command, station))

    async def _run(self, command: LandAll | StopAll, station: Station) -> None:
        subject = {"do": command.do, "n": command.n, "drone": station.found.name}
        try:
            if isinstance(command, StopAll):
                await self._stop(command, station, subject)
            else:
                await self._land(station, subject)
        except SkyloopError as error:
            self._send({"type": "each", **subject, "state": "refused", "why": str(error)})

    async def _stop(self, command: StopAll, station: Station, subject: Json) -> None:
        assert command.at_s is not None  # a command without a time has already been refused
        station.pilot_came()
        try:
            until_ns = nanoseconds(command.at_s - command.unsure_s + late_s(command))
            sent = {"type": "each", **subject, "state": "sent", "why": ""}
            await station.stop_motors(until_ns, lambda: self._send(sent))
            self._send({**sent, "state": "done"})
        finally:
            await station.pilot_went()

    async def _land(self, station: Station, subject: Json) -> None:
        """Take control with the highest priority, land, and release control."""
        if station.drone.link.application in (LinkState.LOST, LinkState.CLOSED):
            raise LinkError("the link to the proxy is lost")
        station.check_stop()
        with suppress(LinkError):
            if (await asyncio.to_thread(station.fresh_feedback)).state is FlightState.LANDED:
                self._send({"type": "each", **subject, "state": "done", "why": "landed already"})
                return
        begun_ns = monotonic_ns()
        pilot = await station.open_pilot(self._app)
        try:
            if seconds(monotonic_ns() - begun_ns) > BEGIN_S:
                raise LinkError(f"no connection within {BEGIN_S:g} s")
            await asyncio.to_thread(pilot.acquire, HIGHEST_PRIORITY)
            station.check_stop()
            from_ns = pilot.proxy_now_ns + SETTLED_NS
            if not pilot.command(Land()):
                raise LinkError(f"the link to the proxy is {pilot.link.application}")
            self._send({"type": "each", **subject, "state": "sent", "why": ""})
            while seconds(monotonic_ns() - begun_ns) < LANDING_S:
                feedback = pilot.feedback()
                if feedback.captured_ns >= from_ns and feedback.state is FlightState.LANDED:
                    self._send({"type": "each", **subject, "state": "done", "why": "landed"})
                    return
                if pilot.authority.state != "held":
                    raise LinkError("control was lost before it had landed")
                await asyncio.sleep(_POLL_S)
            raise LinkError(f"it has not landed within {LANDING_S:g} s")
        finally:
            await station.close_pilot(pilot)
