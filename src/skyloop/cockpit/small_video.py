"""Small video of many drones for one page: over one socket, at a steady rate, in one message for all cameras.

A page that shows twelve drones would otherwise have twelve sockets, and would be woken and painted for every frame.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyloop.clock import monotonic_ns, seconds
from skyloop.cockpit.camera_feed import pack
from skyloop.cockpit.small_feed import FPS, SmallFeed, rounded_width
from skyloop.errors import SkyloopError

if TYPE_CHECKING:
    from skyloop.cockpit.station import Station
    from skyloop.cockpit.stream import PageCounts

MAX_SHOWN: Final = 64  #: cameras that one page can show at a time
_BAD_MESSAGE: Final = 1008


class _Place(msgspec.Struct, frozen=True):
    """A camera of a drone."""

    drone: str
    camera: str


class _Message(msgspec.Struct, forbid_unknown_fields=True):
    """What a page sends: a camera that it shows from now on (``width`` pixels wide), or no longer; or what it drew."""

    show: _Place | None = None
    hide: _Place | None = None
    width: int = 0
    ack: int | None = None


@dataclass(slots=True)
class _Shown:
    """A camera that one page shows."""

    width: int
    station: Station | None = None
    feed: SmallFeed | None = None
    sent: int = 0  #: serial of the last frame sent

    def release(self) -> None:
        if self.feed is not None:
            self.feed.unsubscribe()
        self.station, self.feed, self.sent = None, None, 0


class SmallVideoSender:
    """Sends one page the newest frame of each camera that it shows, all in one message, until the page goes away.

    The next message is sent when the page has drawn the one before: a slow page gets fewer frames, never older ones,
    and holds nobody else up.

    Args:
        socket: Accepted already.
        stations: All drones, by name.
        counts: Of all pages.
    """

    def __init__(self, socket: WebSocket, stations: Mapping[str, Station], counts: PageCounts) -> None:
        self._socket = socket
        self._stations = stations
        self._counts = counts
        self._shown: dict[_Place, _Shown] = {}
        self._number = 0  # of the last message
        self._waiting = 0  # for the acknowledgement of so many frames
        self._problem = ""

    async def run(self) -> None:
        """Send until the page is gone."""
        receiver = asyncio.create_task(self._receive())
        try:
            due_s = time.monotonic()
            while not receiver.done():
                due_s = max(due_s + 1.0 / FPS, time.monotonic())
                await asyncio.wait([receiver], timeout=due_s - time.monotonic())
                if not receiver.done() and not self._waiting:
                    await self._send()
            if self._problem:
                await self._socket.close(_BAD_MESSAGE, self._problem)
        except WebSocketDisconnect:
            pass  # while sending: the page went away
        finally:
            for shown in self._shown.values():
                shown.release()
            receiver.cancel()
            await asyncio.gather(receiver, return_exceptions=True)

    async def _send(self) -> None:
        heads: list[dict[str, Any]] = []
        jpegs: list[bytes] = []
        for place, shown in self._shown.items():
            self._connect(place, shown)
            frame = None if shown.feed is None else shown.feed.newest
            if frame is None or frame.serial == shown.sent or shown.station is None:
                continue
            self._counts.frames_skipped += max(0, frame.serial - shown.sent - 1) if shown.sent else 0
            shown.sent = frame.serial
            now_ns = monotonic_ns() + shown.station.drone.clock_offset_ns
            heads.append(
                {
                    "drone": place.drone,
                    "camera": place.camera,
                    "seq": frame.seq,
                    "age_s": seconds(now_ns - frame.captured_ns),
                    "width": frame.width,
                    "height": frame.height,
                    "bytes": len(frame.jpeg),
                }
            )
            jpegs.append(frame.jpeg)
        if not heads:
            return
        self._number += 1
        self._waiting = len(heads)
        await self._socket.send_bytes(pack({"ack": self._number, "frames": heads}, *jpegs))
        self._counts.frames_sent += len(heads)

    def _connect(self, place: _Place, shown: _Shown) -> None:
        """Subscribe to the camera, and again after the drone came back or was replaced."""
        station = self._stations.get(place.drone)
        if station is shown.station and shown.feed is not None:
            return
        shown.release()
        feed = None if station is None else station.small_video(place.camera, shown.width)
        if feed is not None:
            with suppress(SkyloopError):  # it is going away
                feed.subscribe()
                shown.station, shown.feed = station, feed

    async def _receive(self) -> None:
        """Handle what the page sends until it is gone, or sends what makes no sense."""
        while not self._problem:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            self._problem = self._handle(message.get("text") or "")

    def _handle(self, text: str) -> str:
        """Handle a message; return what is wrong with it."""
        try:
            message = msgspec.json.decode(text, type=_Message)
        except msgspec.DecodeError as error:
            return f"not understood: {error}"[:120]
        if message.ack is not None and message.ack == self._number and self._waiting:
            self._counts.frames_acknowledged += self._waiting
            self._waiting = 0
        for place in (message.show, message.hide):
            shown = None if place is None else self._shown.pop(place, None)
            if shown is not None:
                shown.release()
        if message.show is not None:
            if len(self._shown) >= MAX_SHOWN:
                return f"at most {MAX_SHOWN} cameras are shown at a time"
            self._shown[message.show] = _Shown(rounded_width(message.width))
        return ""
