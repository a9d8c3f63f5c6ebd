"""Send data to pages, with one object per open socket. A page that can't keep up gets less data, but never older data.

Video: only one JPEG is in flight at a time; the page gets the newest after it has drawn and acknowledged the previous.
Several H.264 pictures may be in flight, because they depend on each other; after a gap, a page needs a key frame.
Telemetry: the newest state 18 times a second, or as fast as the socket accepts it, created once for all pages.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.encoded_feed import CameraFeed, EncodedFeed, FeedFormat, Numbered, SmallFrame, form_for, pack
from skyloop.cockpit.feeds import PeriodicBroadcast, Wake
from skyloop.cockpit.station import Station
from skyloop.cockpit.telemetry import encode_json
from skyloop.errors import SkyloopError
from skyloop.messages import CameraInfo, EncodedFrame

if TYPE_CHECKING:
    from skyloop.client import Frame


# One camera as H.264 on one page: the choice of its stream, and its pictures -----------------------------------------
#
# Pages that keep up share a stream. A page whose acknowledgements arrive late gets its own stream, whose rate and size
# are adapted to the path to that page, until nothing has been late for a while.


LATE_S: Final = 0.25  #: a picture counts as late if it is acknowledged after more than this time
FALLS_BEHIND_S: Final = 1.0  #: a page gets its own stream if all of its pictures were late for this long
QUIET_S: Final = 10.0  #: time without late pictures before a page shares a stream again; doubled after each relapse
MOST_QUIET_S: Final = 160.0  #: maximum of this time
SILENT_S: Final = 3.0  #: give up on a stream after this long without a picture
RETRY_S: Final = 10.0  #: first pause before the stream is tried again; doubled each time
MOST_RETRY_S: Final = 300.0  #: longest pause; a proxy that refuses the stream reports each attempt
MOST_UNDER_WAY: Final = 8  #: maximum number of pictures that are sent but not acknowledged yet
MOST_BYTES: Final = 1_000_000  #: maximum total size of these pictures [bytes]; a single picture may be larger


class PagePath:
    """Decides from a page's acknowledgements whether the page keeps up. Takes the time as an argument."""

    def __init__(self) -> None:
        self.behind = False  #: whether the page needs a lower rate than other pages get
        self.late_here = False  #: whether pictures were already late when they reached the cockpit
        self._under_way: deque[tuple[int, int, int]] = deque()  # number, size in bytes and sending time
        self._trip_s = 0.0  # round-trip time of the newest acknowledged picture
        self._changed_ns: int | None = None  # time of the last change of ``_was_late``
        self._was_late = False
        self._quiet_s = QUIET_S
        self._back_ns: int | None = None  # time at which the page last caught up

    @property
    def free(self) -> bool:
        """Whether another picture may be sent now."""
        waiting = self._under_way
        return len(waiting) < MOST_UNDER_WAY and (not waiting or sum(size for _, size, _ in waiting) < MOST_BYTES)

    @property
    def waiting(self) -> int:
        """The number of pictures in flight."""
        return len(self._under_way)

    def sent(self, number: int, size: int, now_ns: int) -> None:
        """Record that a picture was sent, with its size in bytes."""
        self._under_way.append((number, size, now_ns))

    def acknowledged(self, number: int, now_ns: int) -> int:
        """Record that the page has received a picture and all earlier ones; return how many of these are new."""
        count = 0
        while self._under_way and self._under_way[0][0] <= number:
            self._trip_s = seconds(now_ns - self._under_way.popleft()[2])
            count += 1
        return count

    def update(self, now_ns: int, extra_s: float = 0.0) -> bool:
        """Return whether the page is behind now. ``extra_s``: time it takes pictures to reach the cockpit [s]."""
        oldest_s = seconds(now_ns - self._under_way[0][2]) if self._under_way else 0.0
        late = max(oldest_s, self._trip_s, extra_s) > LATE_S
        if self._changed_ns is None or late != self._was_late:
            self._changed_ns, self._was_late = now_ns, late
        if late:
            self.late_here = extra_s > LATE_S
        lasts_s = seconds(now_ns - self._changed_ns)
        if late and not self.behind and lasts_s >= FALLS_BEHIND_S:
            relapse = self._back_ns is not None and seconds(now_ns - self._back_ns) < 2.0 * self._quiet_s
            self._quiet_s = min(2.0 * self._quiet_s, MOST_QUIET_S) if relapse else QUIET_S
            self.behind, self._changed_ns = True, now_ns
        elif self.behind and not late and lasts_s >= self._quiet_s:
            self.behind, self._back_ns, self._changed_ns = False, now_ns, now_ns
        return self.behind


@dataclass(frozen=True, slots=True)
class Sent:
    """A picture for a page."""

    picture: EncodedFrame
    form: FeedFormat
    age_s: float
    late_here: bool = False  #: whether the page has its own stream because the pictures already reach the cockpit late


class PageStream:
    """One camera's H.264 stream to one page.

    ``width``: width of the pane [device pixels], or 0 for full size. ``max_fps``: maximum frame rate, or None for no
    limit. ``wake``: called on the event loop for each picture, or None if the page polls.
    """

    def __init__(
        self,
        station: Station,
        camera: CameraInfo,
        width: int,
        max_fps: float | None,
        wake: Wake | None,
        clock: Clock = monotonic_ns,
    ) -> None:
        self.path = PagePath()
        self.skipped = 0  #: number of pictures not sent because the page could not have decoded them
        self._station = station
        self._camera = camera
        self._width = width
        self._max_fps = max_fps
        self._wake = wake
        self._clock = clock
        self._name = ""  # name of the page's own stream, if it has one
        self._feed: EncodedFeed | None = None
        self._next: EncodedFeed | None = None  # the stream that will replace the current one at its first key frame
        self._serial = 0  # number of the last picture sent
        self._follows = True  # whether the page can decode the next picture
        self._numbers: deque[tuple[int, EncodedFeed, int]] = deque()  # message number, feed and picture number
        self._late_s = 0.0  # delay of the newest picture on its arrival in the cockpit
        self._missed = 0  # number of pictures skipped before those that are ready
        self._refused_ns: int | None = None  # time at which a stream was last given up
        self._retry_s = RETRY_S

    @property
    def shows(self) -> bool:
        """Whether the page receives this stream; until it does, it needs JPEGs."""
        return self._feed is not None

    def resize(self, width: int) -> None:
        """Set the pane's new width [device pixels]."""
        self._width = width

    def take(self) -> list[Sent]:
        """Return the pictures to send now, in order, and mark them as sent; the caller must call :meth:`sent`."""
        self._choose()
        if self._next is not None and self._ready(self._next, 0):
            self._release(self._feed)
            self._feed, self._next, self._serial = self._next, None, 0
            self._refused_ns, self._retry_s = None, RETRY_S
        feed = self._feed
        if feed is None or not self.path.free:
            return []
        pictures, skipped = self._ready(feed, self._serial), self._missed
        pictures = pictures[: MOST_UNDER_WAY - self.path.waiting]
        if not pictures:
            return []
        if self._serial:
            self.skipped += skipped
        self._serial, self._follows = pictures[-1].serial, True
        now_ns = self._clock() + self._station.drone.clock_offset_ns
        self._late_s = seconds(now_ns - pictures[-1].picture.published_ns)
        form, late = feed.form, self.path.late_here
        return [Sent(one.picture, form, seconds(now_ns - one.picture.captured_ns), late) for one in pictures]

    def sent(self, number: int, one: Sent) -> None:
        """Record the number of the message that contains a picture from :meth:`take`."""
        if self._feed is not None:
            self._numbers.append((number, self._feed, one.picture.seq))
            self.path.sent(number, len(one.picture.data), self._clock())

    def acknowledged(self, number: int) -> int:
        """Handle the page's report that it has received this message and all earlier ones; return how many are new."""
        newest = None
        while self._numbers and self._numbers[0][0] <= number:
            newest = self._numbers.popleft()
        if newest is not None:
            newest[1].acknowledge(newest[2])
        return self.path.acknowledged(number, self._clock())

    def restart(self) -> None:
        """Resume at a key frame, because the page can't decode the next picture."""
        self._follows = False

    def close(self) -> None:
        """Release the streams. Idempotent."""
        for feed in (self._feed, self._next):
            self._release(feed)
        self._feed = self._next = None
        self._numbers.clear()
        if self._name:
            self._station.free_name(self._name)
            self._name = ""

    def _ready(self, feed: EncodedFeed, serial: int) -> list[Numbered[EncodedFrame]]:
        """Return the pictures after ``serial`` that the page can decode; if there are none, request a key frame."""
        pictures, self._missed = feed.after(serial, follows=self._follows)
        if not pictures and self._missed:
            feed.ask_for_key()
        return pictures

    def _choose(self) -> None:
        """Subscribe to the stream that now suits the page; the current one remains in use until a key frame arrives."""
        form = form_for(self._camera, self._width, self._max_fps)
        if self.path.update(self._clock(), self._late_s):
            self._name = self._name or self._station.own_name()
            form = FeedFormat(None, form.scale, self._max_fps, self._name)
        for feed in filter(None, (self._next, self._feed)):
            if feed.silent_s > SILENT_S:
                self._refuse(feed)
                return
        present = self._next or self._feed
        refused = self._refused_ns is not None and self._clock() - self._refused_ns < nanoseconds(self._retry_s)
        if refused or (present is not None and present.form == form):
            return
        self._release(self._next)
        self._next = None
        if self._feed is not None and self._feed.form == form:
            return  # the page returned to the current stream before the other one arrived
        feed = self._station.encoded(self._camera.name, form)
        with suppress(SkyloopError):  # the drone is being closed
            feed.subscribe(self, self._wake)
            self._next = feed

    def _refuse(self, feed: EncodedFeed) -> None:
        if self._refused_ns is not None:
            self._retry_s = min(2.0 * self._retry_s, MOST_RETRY_S)
        self._refused_ns = self._clock()
        self._release(feed)
        if feed is self._next:
            self._next = None
        else:
            self._feed = None

    def _release(self, feed: EncodedFeed | None) -> None:
        if feed is not None:
            feed.unsubscribe(self)
            if not feed.wanted:
                self._station.forget(feed)


# Sockets ---------------------------------------------------------------------------------------------------------


DRAWN_BYTES = 65_536  #: maximum size of the drawings sent to a page with one frame: about the size of the frame itself
MAX_WAITING: Final = 256  #: number of responses queued for a page that does not read; further responses are dropped
MAX_COUNTED = 256  #: maximum number of sources of drawings listed in the counts

_BAD_MESSAGE = 1008  # close code: policy violation (RFC 6455)
_POLL_S: Final = 0.2  # longest time between checks that an H.264 stream still delivers pictures
UNKNOWN = 4404  #: close code: there is no such drone or camera


@dataclass(slots=True)
class PageCounts:
    """Counts across all pages since startup."""

    pages: int = 0  #: number of pages currently open
    frames_sent: int = 0
    frames_acknowledged: int = 0
    frames_skipped: int = 0  #: not sent because the page was still drawing the previous one
    sources: set[str] = field(default_factory=set)  #: sources of the drawings that were sent


class VideoSender:
    """Sends a camera's video to one page until it disconnects: H.264 if the page can decode it, otherwise JPEGs."""

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
        self._sent = 0  # number of the last JPEG sent; a reference to the frame would occupy the proxy's memory
        self._sent_ns = 0  # capture time of the last picture sent
        self._waiting = 0  # number of the JPEG that has not been acknowledged yet
        self._drawn: dict[str, int] = {}  # capture times of the drawings sent last, by source in the order of sending

    async def run(self) -> None:
        self._event_feed.subscribe(self._wake.set)
        receiver = asyncio.create_task(self._receive())
        receiver.add_done_callback(lambda _: self._wake.set())
        try:
            while not receiver.done():
                self._choose()
                with suppress(TimeoutError):
                    # Wake up regularly, to detect that no pictures are arriving or that the page is not accepting any.
                    await asyncio.wait_for(self._wake.wait(), None if self._stream is None else _POLL_S)
                self._wake.clear()
                await self._send_pictures()
                await self._send_frame()
                await self._send_drawings()
            if not receiver.result():
                await self._socket.close(_BAD_MESSAGE, 'expected {"ack": number of a frame}')
        except WebSocketDisconnect:
            pass  # the page disconnected during a send
        finally:
            if self._as_jpeg:
                self._feed.unsubscribe(self._wake.set)
            if self._stream is not None:
                self._stream.close()
            self._event_feed.unsubscribe(self._wake.set)
            receiver.cancel()
            await asyncio.gather(receiver, return_exceptions=True)

    def _choose(self) -> None:
        """Subscribe to JPEGs as long as the page gets no other stream."""
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
            decoded = _decode(message.get("text") or "")
            if decoded is None:
                return False
            if decoded.h264 is not None:
                self._set_encoding(decoded.h264, decoded.width)
            if decoded.ack is not None:
                self._acknowledged(decoded.ack)
            if decoded.key and self._stream is not None:
                self._stream.restart()
            self._wake.set()

    def _set_encoding(self, h264: bool, width: int) -> None:
        if not h264:
            if self._stream is not None:
                self._stream.close()
            self._stream = None
        elif self._stream is not None:
            self._stream.resize(width)
        else:
            info = self._station.camera_info(self._feed.camera)
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
        """Send drawings for the last frame sent or for earlier ones, so that there are never more drawings than frames.

        At most :data:`DRAWN_BYTES` are sent with each frame, in pieces. The sources sent longest ago come first, so
        many sources delay neither this page's pictures nor other pages.
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
    """Sends the messages of a broadcast to one page until the page disconnects."""

    def __init__(self, socket: WebSocket, broadcast: PeriodicBroadcast) -> None:
        self._socket = socket
        self._broadcast = broadcast
        self._wake = asyncio.Event()

    async def run(self) -> None:
        gone = asyncio.create_task(self._until_gone())
        gone.add_done_callback(lambda _: self._wake.set())
        self._broadcast.subscribe(self._wake.set)
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
            pass  # the page disconnected during a send
        finally:
            self._broadcast.unsubscribe(self._wake.set)
            gone.cancel()
            await asyncio.gather(gone, return_exceptions=True)

    async def _send(self) -> None:
        await self._socket.send_text(self._broadcast.message.decode())

    async def _until_gone(self) -> str:
        """Return the type of the next message; the page should only disconnect."""
        return str((await self._socket.receive())["type"])


class TelemetrySender(BroadcastSender):
    """Sends a drone's state and events, preceded by a description of the vehicle whenever that description changes."""

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
    """Sends messages to one page and forwards the page's commands. Used on the event loop."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._outbox: asyncio.Queue[dict[str, Any]] = asyncio.Queue(MAX_WAITING)

    def send(self, message: dict[str, Any]) -> None:
        """Queue a message; drop it if :data:`MAX_WAITING` messages are already queued."""
        with suppress(asyncio.QueueFull):
            self._outbox.put_nowait(message)

    async def serve(self, handle: Callable[[Sequence[str | bytes]], None]) -> None:
        """Call ``handle`` with the messages received since the previous call, oldest first, until the page disconnects.

        There may be several if this process was suspended; ``handle`` then sees the newest before acting on the oldest.
        """
        came: list[str | bytes] = []
        some = asyncio.Event()

        async def read() -> None:
            with suppress(WebSocketDisconnect):
                while (message := await self._socket.receive())["type"] != "websocket.disconnect":
                    came.append(message.get("text") or message.get("bytes") or "")
                    some.set()  # messages that have already arrived are read before ``handle`` is called

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
        with suppress(WebSocketDisconnect):  # the receiving side notices this, too
            while True:
                await self._socket.send_text(encode_json(await self._outbox.get()).decode())


class _FromPage(msgspec.Struct):
    ack: int | None = None  #: number of the newest picture that the page has drawn
    h264: bool | None = None  #: whether the page decodes H.264
    width: int = 0  #: with ``h264``: width of the pane [device pixels]; 0 for full size
    key: bool = False  #: whether the page can't decode any picture until the next key frame


def _decode(text: str) -> _FromPage | None:
    """Decode a page's message; return None if it is invalid."""
    try:
        message = msgspec.json.decode(text, type=_FromPage)
    except msgspec.DecodeError:
        return None
    return message if message.ack is not None or message.h264 is not None or message.key else None


def picture_values(picture: Frame | SmallFrame | EncodedFrame, age_s: float, width: int, height: int) -> dict[str, Any]:
    captured = str(picture.captured_ns)  # too large for a JavaScript number
    return {"seq": picture.seq, "captured_ns": captured, "age_s": age_s, "width": width, "height": height}


def encoding_values(one: Sent) -> dict[str, Any]:
    values = {"key": one.picture.key, "kind": one.form.kind, "kbit_s": one.form.kbit_s}
    return values | {"late": True} if one.form.subscriber and one.late_here else values
