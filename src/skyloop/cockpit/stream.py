"""The senders: one object per open page and stream. A page that does not keep up gets less, never anything older.

Video: one frame is on its way at a time; the page acknowledges it when it has drawn it, and only then gets the newest.
Telemetry: the newest state about twenty times a second, as far as the socket takes it; made once for all pages.
"""

from __future__ import annotations

import asyncio
import json
import struct
from dataclasses import dataclass, field
from typing import Any

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyloop.cockpit.beat import Beat
from skyloop.cockpit.feeds import CameraFeed, NewsFeed
from skyloop.cockpit.station import Station
from skyloop.cockpit.telemetry import encode_json
from skyloop.messages import Annotation, Points, Polyline, Text

_LENGTH = struct.Struct(">I")
_BAD_MESSAGE = 1008
UNKNOWN = 4404  #: close code: no such drone or camera


@dataclass(slots=True)
class PageCounts:
    """What all pages were sent since the start."""

    pages: int = 0  #: open now
    frames_sent: int = 0
    frames_acknowledged: int = 0
    frames_skipped: int = 0  #: not sent because the page still had one to draw
    sources: set[str] = field(default_factory=set)  #: of drawings that were sent


def pack_frame(head: dict[str, Any], jpeg: bytes) -> bytes:
    """A binary message: length of the head (4 bytes, big-endian), the head as JSON, the JPEG file."""
    text = json.dumps(head, separators=(",", ":")).encode()
    return _LENGTH.pack(len(text)) + text + jpeg


def drawing_values(annotation: Annotation) -> dict[str, Any]:
    """An annotation as JSON values for a page."""
    return {
        "type": "drawing",
        "source": annotation.source,
        "captured_ns": str(annotation.captured_ns),  # too large for JavaScript's numbers
        "width": annotation.width,
        "height": annotation.height,
        "shapes": [_shape(shape) for shape in annotation.shapes],
    }


def _shape(shape: Polyline | Points | Text) -> dict[str, Any]:
    if isinstance(shape, Text):
        return {"kind": "text", "text": shape.text, "at": shape.at, "colour": shape.colour}
    if isinstance(shape, Points):
        return {"kind": "points", "points": shape.points, "colour": shape.colour}
    return {"kind": "line", "points": shape.points, "closed": shape.closed, "colour": shape.colour}


class VideoSender:
    """Sends one camera to one page until the page goes away."""

    def __init__(self, socket: WebSocket, feed: CameraFeed, news: NewsFeed, counts: PageCounts) -> None:
        self._socket = socket
        self._feed = feed
        self._news = news
        self._counts = counts
        self._wake = asyncio.Event()
        self._sent = 0  # serial of the last frame sent; not the frame, which would keep its memory from the proxy
        self._sent_ns = 0  # and its capture
        self._waiting = False  # for its acknowledgement
        self._drawn: dict[str, int] = {}  # capture of the newest drawing sent, by source

    async def run(self) -> None:
        """Returns when the page is gone."""
        self._feed.join(self._wake.set)
        self._news.join(self._wake.set)
        receiver = asyncio.create_task(self._receive())
        receiver.add_done_callback(lambda _: self._wake.set())
        try:
            while not receiver.done():
                await self._wake.wait()
                self._wake.clear()
                await self._send_frame()
                await self._send_drawings()
            if not receiver.result():
                await self._socket.close(_BAD_MESSAGE, 'expected {"ack": number of a frame}')
        except WebSocketDisconnect:
            pass  # while sending: the page went away
        finally:
            self._feed.leave(self._wake.set)
            self._news.leave(self._wake.set)
            receiver.cancel()
            await asyncio.gather(receiver, return_exceptions=True)

    async def _receive(self) -> bool:
        """Takes acknowledgements until the page is gone (True) or sends something else (False)."""
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return True
            number = _acknowledged(message.get("text") or "")
            if number is None:
                return False
            if self._waiting and number == self._sent:
                self._waiting = False
                self._counts.frames_acknowledged += 1
                self._wake.set()

    async def _send_frame(self) -> None:
        picture = self._feed.newest
        if self._waiting or picture is None or picture.serial == self._sent:
            return
        skipped = picture.serial - self._sent - 1 if self._sent else 0
        jpeg = await self._feed.jpeg(picture)
        frame = picture.frame
        head = {
            "ack": picture.serial,
            "camera": frame.camera,
            "seq": frame.seq,
            "captured_ns": str(frame.captured_ns),
            "age_s": frame.age_s,
            "width": frame.shape[1],
            "height": frame.shape[0],
        }
        self._waiting, self._sent, self._sent_ns = True, picture.serial, frame.captured_ns
        await self._socket.send_bytes(pack_frame(head, jpeg))
        self._counts.frames_sent += 1
        self._counts.frames_skipped += skipped

    async def _send_drawings(self) -> None:
        """Drawings of the frame sent last, or older ones: so there are never more of them than of frames."""
        for (camera, source), annotation in list(self._news.drawings.items()):
            captured = annotation.captured_ns
            if camera != self._feed.camera or captured > self._sent_ns:
                continue
            if self._drawn.get(source) != captured:
                self._drawn[source] = captured
                self._counts.sources.add(source)
                await self._socket.send_text(json.dumps(drawing_values(annotation), separators=(",", ":")))


class BeatSender:
    """Sends what a beat makes to one page until the page goes away."""

    def __init__(self, socket: WebSocket, beat: Beat) -> None:
        self._socket = socket
        self._beat = beat
        self._wake = asyncio.Event()

    async def run(self) -> None:
        """Returns when the page is gone."""
        gone = asyncio.create_task(self._until_gone())
        gone.add_done_callback(lambda _: self._wake.set())
        wake = self._wake.set  # the same object to join and to leave with
        self._beat.join(wake)
        try:
            while not gone.done() and not self._beat.ended:
                await self._wake.wait()
                self._wake.clear()
                if not gone.done() and not self._beat.ended:
                    await self._send()
            if not gone.done():
                await self._socket.close(UNKNOWN, "it is not here any more")
            elif gone.result() != "websocket.disconnect":
                await self._socket.close(_BAD_MESSAGE, "nothing is expected here")
        except WebSocketDisconnect:
            pass  # while sending: the page went away
        finally:
            self._beat.leave(wake)
            gone.cancel()
            await asyncio.gather(gone, return_exceptions=True)

    async def _send(self) -> None:
        await self._socket.send_text(self._beat.made.decode())

    async def _until_gone(self) -> str:
        """Nothing is expected from the page here: returns the type of whatever comes."""
        return str((await self._socket.receive())["type"])


class TelemetrySender(BeatSender):
    """Sends a drone's state and events; before them the vehicle, whenever it is another one."""

    def __init__(self, socket: WebSocket, station: Station) -> None:
        super().__init__(socket, station.beat)
        self._station = station
        self._vehicle: dict[str, Any] | None = None
        self._told = 0  # number of the last event

    async def _send(self) -> None:
        view = self._station.view
        vehicle = view.vehicle()
        if vehicle != self._vehicle:
            self._vehicle = vehicle
            await self._socket.send_text(encode_json(vehicle).decode())
        fresh = self._station.news.events_after(self._told)
        self._told = fresh[-1][0] if fresh else self._told
        events = encode_json(view.events(fresh))
        await self._socket.send_text((self._beat.made + b',"events":' + events + b"}").decode())


class _Ack(msgspec.Struct):
    """What a page sends when it has drawn a frame."""

    ack: int


def _acknowledged(text: str) -> int | None:
    """The number acknowledged; None if it is something else."""
    try:
        return msgspec.json.decode(text, type=_Ack).ack
    except msgspec.DecodeError:
        return None
