"""What is sent to pages: one object per open socket. A page that does not keep up gets less, never anything older.

Video: one JPEG is on its way at a time; the page acknowledges it when it has drawn it, and only then gets the newest.
Of H.264, whose pictures build on one another, a few are; a page that leaves out one goes on with a key picture.
Telemetry: the newest state about twenty times a second, as far as the socket takes it; made once for all pages.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyloop.clock import monotonic_ns, seconds
from skyloop.cockpit.encoded_feed import CameraFeed, pack
from skyloop.cockpit.feeds import PeriodicBroadcast
from skyloop.cockpit.page_stream import PageStream, Sent
from skyloop.cockpit.station import Station
from skyloop.cockpit.telemetry import encode_json

DRAWN_BYTES = 65_536  #: of drawings that are sent to a page with one frame: about what the frame itself has
MAX_WAITING: Final = 256  #: answers to a page that does not read; what comes on top is not sent
MAX_COUNTED = 256  #: sources of drawings that are named in the counts

_BAD_MESSAGE = 1008
_LOOK_S: Final = 0.2
UNKNOWN = 4404  #: close code: no such drone or camera


@dataclass(slots=True)
class PageCounts:
    """What all pages were sent since the start."""

    pages: int = 0  #: open now
    frames_sent: int = 0
    frames_acknowledged: int = 0
    frames_skipped: int = 0  #: not sent because the page still had one to draw
    sources: set[str] = field(default_factory=set)  #: of drawings that were sent


class VideoSender:
    """Sends one camera to one page until the page goes away: as JPEGs, or as H.264 to a page that decodes it."""

    def __init__(self, socket: WebSocket, station: Station, feed: CameraFeed, counts: PageCounts) -> None:
        self._socket = socket
        self._station = station
        self._feed = feed
        self._event_feed = station.event_feed
        self._counts = counts
        self._wake = asyncio.Event()
        self._stream: PageStream | None = None  # for a page that decodes H.264
        self._as_jpeg = False  # JPEGs are subscribed to
        self._number = 0  # of the last message
        self._sent = 0  # serial of the last JPEG sent; not the frame, which would keep its memory from the proxy
        self._sent_ns = 0  # capture of the picture sent last
        self._waiting = 0  # number of the JPEG whose acknowledgement is waited for
        self._drawn: dict[str, int] = {}  # capture of the newest drawing sent, by source; what was sent last is last

    async def run(self) -> None:
        """Send until the page is gone."""
        self._event_feed.subscribe(self._wake.set)
        receiver = asyncio.create_task(self._receive())
        receiver.add_done_callback(lambda _: self._wake.set())
        try:
            while not receiver.done():
                self._choose()
                with suppress(TimeoutError):
                    # Without pictures, too, it must be seen that none come, or that the page takes none.
                    await asyncio.wait_for(self._wake.wait(), None if self._stream is None else _LOOK_S)
                self._wake.clear()
                await self._send_pictures()
                await self._send_frame()
                await self._send_drawings()
            if not receiver.result():
                await self._socket.close(_BAD_MESSAGE, 'expected {"ack": number of a frame}')
        except WebSocketDisconnect:
            pass  # while sending: the page went away
        finally:
            if self._as_jpeg:
                self._feed.unsubscribe(self._wake.set)
            if self._stream is not None:
                self._stream.close()
            self._event_feed.unsubscribe(self._wake.set)
            receiver.cancel()
            await asyncio.gather(receiver, return_exceptions=True)

    def _choose(self) -> None:
        """Subscribe to JPEGs while the page is shown nothing else."""
        as_jpeg = self._stream is None or not self._stream.shows
        if as_jpeg != self._as_jpeg:
            self._as_jpeg = as_jpeg
            self._waiting = 0
            (self._feed.subscribe if as_jpeg else self._feed.unsubscribe)(self._wake.set)
            self._wake.set()

    async def _receive(self) -> bool:
        """Receive acknowledgements until the page is gone (True) or sends something else (False)."""
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return True
            said = _said(message.get("text") or "")
            if said is None:
                return False
            if said.h264 is not None:
                self._take_form(said.h264, said.width)
            if said.ack is not None:
                self._acknowledged(said.ack)
            if said.key and self._stream is not None:
                self._stream.restart()
            self._wake.set()

    def _take_form(self, h264: bool, width: int) -> None:
        if not h264:
            if self._stream is not None:
                self._stream.close()
            self._stream = None
        elif self._stream is not None:
            self._stream.resize(width)
        else:
            info = next(
                (one for one in self._station.drone.capabilities.cameras if one.name == self._feed.camera), None
            )
            if info is not None:
                self._stream = PageStream(self._station, info, width, None, self._wake.set)

    def _acknowledged(self, number: int) -> None:
        if self._waiting and number == self._waiting:
            self._waiting = 0
            self._counts.frames_acknowledged += 1
        elif self._stream is not None and number <= self._number:
            self._counts.frames_acknowledged += self._stream.acknowledged(number)

    async def _send_pictures(self) -> None:
        stream = self._stream
        if stream is None:
            return
        before = stream.skipped
        for one in stream.take():
            picture = one.picture
            self._number += 1
            stream.sent(self._number, one)
            self._sent_ns = picture.captured_ns
            values = picture_values(picture, one.age_s, picture.width, picture.height)
            await self._socket.send_bytes(pack(self._head(values) | {"h264": encoding_values(one)}, picture.data))
            self._counts.frames_sent += 1
        self._counts.frames_skipped += stream.skipped - before

    def _head(self, values: dict[str, Any]) -> dict[str, Any]:
        return {"ack": self._number, "camera": self._feed.camera, **values, "now_s": seconds(monotonic_ns())}

    async def _send_frame(self) -> None:
        picture = self._feed.newest
        if self._stream is not None and self._stream.shows:
            return
        if self._waiting or picture is None or picture.serial == self._sent:
            return
        skipped = picture.serial - self._sent - 1 if self._sent else 0
        jpeg = await self._feed.jpeg(picture)
        frame = picture.picture
        self._number += 1
        head = self._head(picture_values(frame, frame.age_s, frame.shape[1], frame.shape[0]))
        self._waiting, self._sent, self._sent_ns = self._number, picture.serial, frame.captured_ns
        await self._socket.send_bytes(pack(head, jpeg))
        self._counts.frames_sent += 1
        self._counts.frames_skipped += skipped

    async def _send_drawings(self) -> None:
        """Send drawings of the frame sent last, or older ones, so that there are never more of them than of frames.

        At most :data:`DRAWN_BYTES` are sent for each frame, in pieces, first those that were sent longest ago: what
        many sources draw keeps neither this page's pictures nor anybody else waiting.
        """
        newest = self._event_feed.drawings.items()
        drawings = {source: one for (camera, source), one in newest if camera == self._feed.camera}
        self._drawn = {source: captured for source, captured in self._drawn.items() if source in drawings}
        fresh = [source for source in drawings if source not in self._drawn]
        left = DRAWN_BYTES
        for source in [*fresh, *self._drawn]:
            captured = drawings[source].annotation.captured_ns
            if captured > self._sent_ns or self._drawn.get(source) == captured:
                continue
            text = drawings[source].text
            left -= len(text)
            if left < 0 and left + len(text) < DRAWN_BYTES:
                break  # with the next frame; one that is larger than all that is sent alone
            self._drawn.pop(source, None)
            self._drawn[source] = captured
            if len(self._counts.sources) < MAX_COUNTED:
                self._counts.sources.add(source)
            await self._socket.send_text(text)
            await asyncio.sleep(0)


class BroadcastSender:
    """Sends the messages of a broadcast to one page until the page goes away."""

    def __init__(self, socket: WebSocket, broadcast: PeriodicBroadcast) -> None:
        self._socket = socket
        self._broadcast = broadcast
        self._wake = asyncio.Event()

    async def run(self) -> None:
        """Send until the page is gone."""
        gone = asyncio.create_task(self._until_gone())
        gone.add_done_callback(lambda _: self._wake.set())
        wake = self._wake.set  # the same object to subscribe and to unsubscribe with
        self._broadcast.subscribe(wake)
        try:
            while not gone.done() and not self._broadcast.closed:
                await self._wake.wait()
                self._wake.clear()
                if not gone.done() and not self._broadcast.closed:
                    await self._send()
            if not gone.done():
                await self._socket.close(UNKNOWN, "it is not here any more")
            elif gone.result() != "websocket.disconnect":
                await self._socket.close(_BAD_MESSAGE, "nothing is expected here")
        except WebSocketDisconnect:
            pass  # while sending: the page went away
        finally:
            self._broadcast.unsubscribe(wake)
            gone.cancel()
            await asyncio.gather(gone, return_exceptions=True)

    async def _send(self) -> None:
        await self._socket.send_text(self._broadcast.message.decode())

    async def _until_gone(self) -> str:
        """Return the type of whatever comes: nothing is expected from the page here."""
        return str((await self._socket.receive())["type"])


class TelemetrySender(BroadcastSender):
    """Sends a drone's state and events; before them the vehicle, whenever it is another one."""

    def __init__(self, socket: WebSocket, station: Station) -> None:
        super().__init__(socket, station.broadcast)
        self._station = station
        self._vehicle: dict[str, Any] | None = None
        self._last_event = 0  # number of the last event

    async def _send(self) -> None:
        view = self._station.view
        vehicle = view.vehicle()
        if vehicle != self._vehicle:
            self._vehicle = vehicle
            await self._socket.send_text(encode_json(vehicle).decode())
        fresh = self._station.event_feed.events_after(self._last_event)
        self._last_event = fresh[-1][0] if fresh else self._last_event
        events = encode_json(view.events(fresh))
        await self._socket.send_text((self._broadcast.message + b',"events":' + events + b"}").decode())


class PageSocket:
    """Sends messages to one page, and passes on the commands that it sends. On the event loop."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._outbox: asyncio.Queue[dict[str, Any]] = asyncio.Queue(MAX_WAITING)

    def send(self, message: dict[str, Any]) -> None:
        """Queue a message; it is dropped if the page has not read the :data:`MAX_WAITING` before."""
        with suppress(asyncio.QueueFull):
            self._outbox.put_nowait(message)

    async def serve(self, handle: Callable[[Sequence[str | bytes]], None]) -> None:
        """Call ``handle`` with what the page has sent since the last call, oldest first, until the page is gone.

        More than one message where this process got to none for a while: the newest is known before the oldest acts.
        """
        came: list[str | bytes] = []
        some = asyncio.Event()

        async def read() -> None:
            with suppress(WebSocketDisconnect):
                while (message := await self._socket.receive())["type"] != "websocket.disconnect":
                    came.append(message.get("text") or message.get("bytes") or "")
                    some.set()  # what has come already is received without a turn of the loop

        reading, writing = asyncio.create_task(read()), asyncio.create_task(self._write())
        reading.add_done_callback(lambda _: some.set())
        try:
            while not reading.done() or came:
                await some.wait()
                some.clear()
                messages, came[:] = tuple(came), ()
                handle(messages)
            reading.result()
        finally:
            reading.cancel()
            writing.cancel()

    async def _write(self) -> None:
        with suppress(WebSocketDisconnect):  # the receiving side detects it too
            while True:
                await self._socket.send_text(encode_json(await self._outbox.get()).decode())


class _FromPage(msgspec.Struct):
    """What a page sends: what it has drawn, which pictures it takes, or that it can't decode what comes."""

    ack: int | None = None
    h264: bool | None = None
    width: int = 0
    key: bool = False


def _said(text: str) -> _FromPage | None:
    """Return what a page says; None if it is something else."""
    try:
        said = msgspec.json.decode(text, type=_FromPage)
    except msgspec.DecodeError:
        return None
    return said if said.ack is not None or said.h264 is not None or said.key else None


class Captured(Protocol):
    """A picture, by as much of it as pages are told."""

    @property
    def seq(self) -> int: ...
    @property
    def captured_ns(self) -> int: ...


def picture_values(picture: Captured, age_s: float, width: int, height: int) -> dict[str, Any]:
    """Return what a page is told of a picture, as JSON values."""
    captured = str(picture.captured_ns)  # too large for JavaScript's numbers
    return {"seq": picture.seq, "captured_ns": captured, "age_s": age_s, "width": width, "height": height}


def encoding_values(one: Sent) -> dict[str, Any]:
    """Return how a picture is encoded as JSON values for a page."""
    values = {"key": one.picture.key, "kind": one.form.kind, "kbit_s": one.form.kbit_s}
    return values | {"late": True} if one.form.subscriber and one.late_here else values
