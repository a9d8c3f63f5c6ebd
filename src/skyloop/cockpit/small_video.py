"""Send small video streams from many drones to a page over one socket, at a steady rate, several pictures per message.

Otherwise, a page that shows twelve drones would need twelve sockets, and would wake and repaint for every frame.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyloop.clock import monotonic_ns, seconds
from skyloop.cockpit.encoded_feed import FPS, SmallFeed, pack, rounded_width
from skyloop.cockpit.feeds import Wake
from skyloop.cockpit.stream import PageStream, encoding_values, picture_values
from skyloop.errors import SkyloopError

if TYPE_CHECKING:
    from skyloop.cockpit.station import Station
    from skyloop.cockpit.stream import PageCounts

SEND_HZ: Final = 60.0  #: maximum number of messages per second
GATHER_S: Final = 0.005  #: time for which a picture waits for pictures of other cameras, which often arrive together
MAX_SHOWN: Final = 64  #: maximum number of cameras shown on one page at a time
_BAD_MESSAGE: Final = 1008  # WebSocket close code: policy violation (RFC 6455)


class _Place(msgspec.Struct, frozen=True):
    drone: str
    camera: str


class _Message(msgspec.Struct, forbid_unknown_fields=True):
    show: _Place | None = None  #: show this camera
    hide: _Place | None = None  #: stop showing this camera
    width: int = 0  #: with ``show``: width of the pane [device pixels]
    h264: bool = False  #: with ``show``: whether the page decodes H.264
    key: _Place | None = None  #: the page can't decode this camera's pictures until the next key frame
    ack: int | None = None  #: number of the message that the page has drawn


@dataclass(slots=True)
class _Shown:
    """A camera that one page shows."""

    width: int
    h264: bool
    station: Station | None = None
    stream: PageStream | None = None
    feed: SmallFeed | None = None
    sent: int = 0  #: serial number of the last JPEG sent

    def connect(self, station: Station | None, camera: str, wake: Wake) -> None:
        """Subscribe to the camera, again if the drone was replaced; to JPEGs only while nothing else is shown."""
        if station is not self.station:
            self.release()
            self.station = station
        if station is None:
            return
        if self.h264 and self.stream is None:
            info = station.camera_info(camera)
            if info is not None:
                self.stream = PageStream(station, info, self.width, FPS, wake)
        if self.stream is not None and self.stream.shows:
            self.release_feed()
        elif self.feed is None:
            feed = station.small_video(camera, rounded_width(self.width))
            if feed is not None:
                with suppress(SkyloopError):  # the drone is being closed
                    feed.subscribe()
                    self.feed, self.sent = feed, 0

    def release_feed(self) -> None:
        if self.feed is not None:
            self.feed.unsubscribe()
            self.feed = None

    def release(self) -> None:
        self.release_feed()
        if self.stream is not None:
            self.stream.close()
        self.station = self.stream = None


class SmallVideoSender:
    """Sends one page the new frames of all cameras that it shows in one message, until the page disconnects.

    The next message is sent once the page has drawn the previous one. A slow page therefore receives fewer frames, but
    never older ones, and does not delay other pages.
    """

    def __init__(self, socket: WebSocket, stations: Mapping[str, Station], counts: PageCounts) -> None:
        self._socket = socket
        self._stations = stations
        self._counts = counts
        self._shown: dict[_Place, _Shown] = {}
        self._number = 0  # number of the last message
        self._waiting = 0  # frames not yet acknowledged
        self._problem = ""
        self._wake = asyncio.Event()

    async def run(self) -> None:
        receiver = asyncio.create_task(self._receive())
        receiver.add_done_callback(lambda _: self._wake.set())
        due_s = time.monotonic()
        try:
            while not receiver.done():
                with suppress(TimeoutError):  # JPEGs do not wake this task
                    await asyncio.wait_for(self._wake.wait(), 1.0 / SEND_HZ)
                self._wake.clear()
                await asyncio.sleep(max(due_s - time.monotonic(), GATHER_S))
                due_s = time.monotonic() + 1.0 / SEND_HZ
                if not receiver.done() and not self._waiting:
                    await self._send()
            if self._problem:
                await self._socket.close(_BAD_MESSAGE, self._problem)
        except WebSocketDisconnect:
            pass  # the page disconnected during a send
        finally:
            for shown in self._shown.values():
                shown.release()
            receiver.cancel()
            await asyncio.gather(receiver, return_exceptions=True)

    async def _send(self) -> None:
        heads: list[dict[str, Any]] = []
        datas: list[bytes] = []
        for place, shown in self._shown.items():
            shown.connect(self._stations.get(place.drone), place.camera, self._wake.set)
            for values, data in self._pictures(shown):
                heads.append({"drone": place.drone, "camera": place.camera, **values, "bytes": len(data)})
                datas.append(data)
        if not heads:
            return
        self._number += 1
        self._waiting = len(heads)
        head = {"ack": self._number, "now_s": seconds(monotonic_ns()), "frames": heads}
        await self._socket.send_bytes(pack(head, *datas))
        self._counts.frames_sent += len(heads)

    def _pictures(self, shown: _Shown) -> Iterator[tuple[dict[str, Any], bytes]]:
        """Yield a camera's pictures that have not been sent, with their data; only for H.264 may there be several."""
        stream, feed, station = shown.stream, shown.feed, shown.station
        if station is None:
            return
        if stream is not None:
            before = stream.skipped
            for one in stream.take():
                picture = one.picture
                stream.sent(self._number + 1, one)
                values = picture_values(picture, one.age_s, picture.width, picture.height)
                yield values | {"h264": encoding_values(one)}, picture.data
            self._counts.frames_skipped += stream.skipped - before
            if stream.shows:
                return
        frame = None if feed is None else feed.newest
        if frame is not None and frame.serial != shown.sent:
            self._counts.frames_skipped += max(0, frame.serial - shown.sent - 1) if shown.sent else 0
            shown.sent = frame.serial
            now_ns = monotonic_ns() + station.drone.clock_offset_ns
            age_s = seconds(now_ns - frame.captured_ns)
            yield picture_values(frame, age_s, frame.width, frame.height), frame.jpeg

    async def _receive(self) -> None:
        """Handle the page's messages until it disconnects or sends an invalid one."""
        while not self._problem:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            self._problem = self._handle(message.get("text") or "")

    def _handle(self, text: str) -> str:
        """Handle a message; return the problem with it, or an empty string if it is valid."""
        try:
            message = msgspec.json.decode(text, type=_Message)
        except msgspec.DecodeError as error:
            return f"not understood: {error}"[:120]
        if message.ack is not None and message.ack == self._number and self._waiting:
            self._counts.frames_acknowledged += self._waiting
            self._waiting = 0
            self._wake.set()
            for shown in self._shown.values():
                if shown.stream is not None:
                    shown.stream.acknowledged(message.ack)
        if message.key is not None and (shows := self._shown.get(message.key)) is not None and shows.stream is not None:
            shows.stream.restart()
        for place in (message.show, message.hide):
            hidden = None if place is None else self._shown.pop(place, None)
            if hidden is not None:
                hidden.release()
        if message.show is not None:
            if len(self._shown) >= MAX_SHOWN:
                return f"at most {MAX_SHOWN} cameras can be shown at a time"
            self._shown[message.show] = _Shown(message.width, message.h264)
        return ""
