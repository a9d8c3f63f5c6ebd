"""A page's commands to all drones at once: land all, stop all. No drone has to be opened or chosen for them."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from starlette.websockets import WebSocket

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.commands import SETTLED_NS, Alive, LandAll, StopAll, decode_fleet_command, late_s, untimely
from skyloop.cockpit.stream import PageSocket
from skyloop.errors import DecodeError, LinkError, SkyloopError
from skyloop.messages import HIGHEST_PRIORITY, FlightState, Land, LinkState

if TYPE_CHECKING:
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.station import Station

LANDING_S: Final = 60.0  #: as long as a landing is repeated
BEGIN_S: Final = 2.0  #: a landing for which there is no connection by then is not begun
_POLL_S: Final = 0.05

Json = dict[str, Any]


class FleetSession:
    """Serves one socket of a pilot's page; what it began goes on when the page is gone. On the event loop."""

    def __init__(self, socket: WebSocket, fleet: Fleet, person: str = "", clock: Clock = monotonic_ns) -> None:
        """Prepare the session; :meth:`run` serves it.

        Args:
            socket: Accepted already.
            fleet: The drones.
            person: The name of who flies, if it is known.
            clock: The monotonic clock [ns].
        """
        self._page = PageSocket(socket)
        self._send = self._page.send
        self._fleet = fleet
        self._app = f"{person} (cockpit, all)" if person else "cockpit, all"
        self._clock = clock

    async def run(self) -> None:
        """Serve the page until it is gone."""
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
            unreached = self._fleet.unreached  # a person who stops all must know of whom that is not true
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
        assert command.at_s is not None  # or it would be untimely
        station.pilot_came()
        try:
            until_ns = nanoseconds(command.at_s - command.unsure_s + late_s(command))
            sent = {"type": "each", **subject, "state": "sent", "why": ""}
            await station.stop_motors(until_ns, lambda: self._send(sent))
            self._send({**sent, "state": "done"})
        finally:
            await station.pilot_went()

    async def _land(self, station: Station, subject: Json) -> None:
        """Take control with the highest priority, land, and give control back."""
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
                raise LinkError(f"there was no connection within {BEGIN_S:g} s")
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
