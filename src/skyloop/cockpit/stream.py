"""Send data to pages, with one object per open socket. A page that does not keep up gets less data, never older data.

Video: only one JPEG is in flight at a time; the page gets the newest one after it has drawn and acknowledged the last.
Several H.264 pictures are in flight, because they depend on one another; a page that skips one resumes at a key one.
Telemetry: the newest state about 20 times a second, or as fast as the socket accepts it, created once for all pages.
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

DRAWN_BYTES = 65_536  #: maximum size of drawings sent to a page with one frame: about the size of the frame itself
MAX_WAITING: Final = 256  #: answers queued for a page that does not read; further ones are dropped
MAX_COUNTED = 256  #: maximum number of sources of drawings listed in the counts

_BAD_MESSAGE = 1008
_LOOK_S: Final = 0.2
UNKNOWN = 4404  #: close code: there is no such drone or camera


@dataclass(slots=True)
class PageCounts:
    """Counts for all pages since the start."""

    pages: int = 0  #: number of pages currently open
    frames_sent: int = 0
    frames_acknowledged: int = 0
    frames_skipped: int = 0  #: not sent because the page was still drawing the previous one
    sources: set[str] = field(default_factory=set)  #: sources of the drawings sent


class VideoSender:
    """Sends one camera to one page until it disconnects, as H.264 if the page can decode that, otherwise as JPEGs."""

    def __init__(self, socket: WebSocket, station: Station, feed: CameraFeed, counts: PageCounts) -> None:
        self._socket = socket
        self._station = station
        self._feed = feed
        self._event_feed = station.event_feed
        self._counts = counts
        self._wake = asyncio.Event()
        self._stream: PageStream | None = None  # set if the page decodes H.264
        self._as_jpeg = False  # whether JPEGs are subscribed to
        self._number = 0  # number of the last message
        self._sent = 0  # number of the last JPEG sent; not the frame, which would keep its memory from the proxy
        self._sent_ns = 0  # capture time of the last picture sent
        self._waiting = 0  # number of the JPEG not yet acknowledged
        self._drawn: dict[str, int] = {}  # capture time of the newest drawing sent, by source; latest last

    async def run(self) -> None:
        """Send until the page disconnects."""
        self._event_feed.subscribe(self._wake.set)
        receiver = asyncio.create_task(self._receive())
        receiver.add_done_callback(lambda _: self._wake.set())
        try:
            while not receiver.done():
                self._choose()
                with suppress(TimeoutError):
                    # Even without pictures this must notice that none arrive, or that the page accepts none.
                    await asyncio.wait_for(self._wake.wait(), None if self._stream is None else _LOOK_S)
                self._wake.clear()
                await self._send_pictures()
                await self._send_frame()
                await self._send_drawings()
            if not receiver.result():
                await self._socket.close(_BAD_MESSAGE, 'expected {"ack": number of a frame}')
        except WebSocketDisconnect:
            pass  # the page disconnected while sending
        finally:
            if self._as_jpeg:
                self._feed.unsubscribe(self._wake.set)
            if self._stream is not None:
                self._stream.close()
            self._event_feed.unsubscribe(self._wake.set)
            receiver.cancel()
            await asyncio.gather(receiver, return_exceptions=True)

    def _choose(self) -> None:
        """Subscribe to JPEGs while nothing else is shown to the page."""
        as_jpeg = self._stream is None or not self._stream.shows
        if as_jpeg != self._as_jpeg:
            self._as_jpeg = as_jpeg
            self._waiting = 0
            (self._feed.subscribe if as_jpeg else self._feed.unsubscribe)(self._wake.set)
            self._wake.set()

    async def _receive(self) -> bool:
        """Receive acknowledgements until the page disconnects (True) or sends anything else (False)."""
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
        """Send drawings for the last frame sent or earlier ones, so that there are never more drawings than frames.

        At most :data:`DRAWN_BYTES` are sent with each frame, in pieces, starting with the sources sent longest ago, so
        that many sources delay neither this page's pictures nor other pages.
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
                break  # the rest is sent with the next frame; a drawing that exceeds the limit is sent alone
            self._drawn.pop(source, None)
            self._drawn[source] = captured
            if len(self._counts.sources) < MAX_COUNTED:
                self._counts.sources.add(source)
            await self._socket.send_text(text)
            await asyncio.sleep(0)


class BroadcastSender:
    """Sends the messages of a broadcast to one page until it disconnects."""

    def __init__(self, socket: WebSocket, broadcast: PeriodicBroadcast) -> None:
        self._socket = socket
        self._broadcast = broadcast
        self._wake = asyncio.Event()

    async def run(self) -> None:
        """Send until the page disconnects."""
        gone = asyncio.create_task(self._until_gone())
        gone.add_done_callback(lambda _: self._wake.set())
        wake = self._wake.set  # unsubscribing needs the same object
        self._broadcast.subscribe(wake)
        try:
            while not gone.done() and not self._broadcast.closed:
                await self._wake.wait()
                self._wake.clear()
                if not gone.done() and not self._broadcast.closed:
                    await self._send()
            if not gone.done():
                await self._socket.close(UNKNOWN, "this drone is gone")
            elif gone.result() != "websocket.disconnect":
                await self._socket.close(_BAD_MESSAGE, "no messages are expected here")
        except WebSocketDisconnect:
            pass  # the page disconnected while sending
        finally:
            self._broadcast.unsubscribe(wake)
            gone.cancel()
            await asyncio.gather(gone, return_exceptions=True)

    async def _send(self) -> None:
        await self._socket.send_text(self._broadcast.message.decode())

    async def _until_gone(self) -> str:
        """Return the type of the next message; here, the page is not expected to send any."""
        return str((await self._socket.receive())["type"])


class TelemetrySender(BroadcastSender):
    """Sends a drone's state and events, preceded by a description of the vehicle whenever that changes."""

    def __init__(self, socket: WebSocket, station: Station) -> None:
        super().__init__(socket, station.broadcast)
        self._station = station
        self._vehicle: dict[str, Any] | None = None
        self._last_event = 0  # number of the last event sent

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
    """Sends messages to one page and passes on its commands. On the event loop."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._outbox: asyncio.Queue[dict[str, Any]] = asyncio.Queue(MAX_WAITING)

    def send(self, message: dict[str, Any]) -> None:
        """Queue a message; drop it if the page has not read the last :data:`MAX_WAITING`."""
        with suppress(asyncio.QueueFull):
            self._outbox.put_nowait(message)

    async def serve(self, handle: Callable[[Sequence[str | bytes]], None]) -> None:
        """Call ``handle`` with the messages received since the last call, oldest first, until the page disconnects.

        If this process was suspended, there may be several: the newest is known before the oldest takes effect.
        """
        came: list[str | bytes] = []
        some = asyncio.Event()

        async def read() -> None:
            with suppress(WebSocketDisconnect):
                while (message := await self._socket.receive())["type"] != "websocket.disconnect":
                    came.append(message.get("text") or message.get("bytes") or "")
                    some.set()  # messages that have already arrived are received without a turn of the loop

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
        with suppress(WebSocketDisconnect):  # the receiving side notices this as well
            while True:
                await self._socket.send_text(encode_json(await self._outbox.get()).decode())


class _FromPage(msgspec.Struct):
    """A message from a page: drawn pictures, accepted kinds of pictures, or a picture it can't decode."""

    ack: int | None = None
    h264: bool | None = None
    width: int = 0
    key: bool = False


def _said(text: str) -> _FromPage | None:
    """Decode a page's message; return None if it is invalid."""
    try:
        said = msgspec.json.decode(text, type=_FromPage)
    except msgspec.DecodeError:
        return None
    return said if said.ack is not None or said.h264 is not None or said.key else None


class Captured(Protocol):
    """The part of a picture that pages are told about."""

    @property
    def seq(self) -> int: ...
    @property
    def captured_ns(self) -> int: ...


def picture_values(picture: Captured, age_s: float, width: int, height: int) -> dict[str, Any]:
    """Return a picture's description for pages, as JSON values."""
    captured = str(picture.captured_ns)  # too large for numbers in JavaScript
    return {"seq": picture.seq, "captured_ns": captured, "age_s": age_s, "width": width, "height": height}


def encoding_values(one: Sent) -> dict[str, Any]:
    """Return how a picture is encoded, as JSON values for a page."""
    values = {"key": one.picture.key, "kind": one.form.kind, "kbit_s": one.form.kbit_s}
    return values | {"late": True} if one.form.subscriber and one.late_here else values
