"""Deliver samples from the receiving thread to an application's callbacks, each on a thread of its own."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from types import TracebackType
from typing import Any, Final, Generic, Protocol, Self, TypedDict, TypeVar

from skyloop.client.connection import ProxyConnection, Scheduler
from skyloop.client.feedback_history import FeedbackHistory
from skyloop.client.frame import Arrival, Frame, SmallArrival
from skyloop.client.link_monitor import StallWatch
from skyloop.client.mailbox import Holder, Mailbox
from skyloop.client.statistics import ChannelCounter, ChannelStats
from skyloop.errors import ClosedError, DecodeError, SkyloopError
from skyloop.messages import CameraInfo, EventKind, FrameHeader, Severity, VideoRequest
from skyloop.messages.subscription import FrameFilter, VideoEncoding
from skyloop.transport.base import Pixels, video

T = TypeVar("T")
C = TypeVar("C", bound="Channel[Any]")

#: Called with the name of a listener and the exception that its function raised.
Report = Callable[[str, Exception | SystemExit], None]


class Emit(Protocol):
    """Emits an event of the client's own; ``data`` are its details."""

    def __call__(self, kind: EventKind, text: str, severity: Severity = Severity.WARNING, **data: str) -> None: ...


JOIN_S: Final = 2.0  #: how long cancelling waits for a call that is under way
_REPORT_EVERY_S: Final = 1.0
_log = logging.getLogger("skyloop")


class Channel(Generic[T]):
    """One kind of sample, delivered to every consumer on the thread on which it arrives."""

    def __init__(self, subscribe: Callable[[bool], None] | None = None) -> None:
        """Make a channel without consumers.

        Args:
            subscribe: Called with True when the first consumer comes or the channel is kept, and with False when the
                last consumer goes, under the channel's lock.
        """
        self.subscribed = False  #: whether samples are wanted now: there is a consumer, or it is kept
        self.kept = False  #: subscribed for good, by :meth:`keep`
        self._consumers: tuple[Callable[[T], None], ...] = ()
        self._drops: dict[Callable[[T], None], Callable[[], int]] = {}
        self._dropped_before = 0  # by consumers that were removed
        self._lock = threading.Lock()
        self._subscribe = subscribe

    def add(self, consumer: Callable[[T], None], dropped: Callable[[], int]) -> None:
        """Deliver to ``consumer`` too, on the publishing thread.

        Args:
            consumer: Called with each sample; must be quick.
            dropped: Returns how many samples it has missed.
        """
        with self._lock:
            self._drops[consumer] = dropped
            self._consumers = (*self._consumers, consumer)
            self._update()

    def remove(self, consumer: Callable[[T], None]) -> None:
        """Stop delivering to ``consumer``. Does nothing if it is not there."""
        with self._lock:
            if consumer not in self._drops:
                return
            self._dropped_before += self._drops.pop(consumer)()
            self._consumers = tuple(known for known in self._consumers if known != consumer)
            self._update()

    @contextmanager
    def into(self, mailbox: Holder[T]) -> Iterator[None]:
        """Deliver into ``mailbox`` within the block."""
        put = mailbox.put
        self.add(put, lambda: mailbox.dropped)
        try:
            yield
        finally:
            self.remove(put)

    def keep(self) -> None:
        """Stay subscribed whether or not there is a consumer."""
        if not self.kept:
            with self._lock:
                self.kept = True
                self._update()

    @property
    def consumed(self) -> bool:
        """Whether there is a consumer."""
        return bool(self._consumers)

    @property
    def dropped(self) -> int:
        """Samples that consumers have missed, including consumers that were removed."""
        with self._lock:
            return self._dropped_before + sum(dropped() for dropped in self._drops.values())

    def publish(self, sample: T) -> None:
        """Deliver ``sample`` to every consumer on this thread. No lock is held meanwhile."""
        for consumer in self._consumers:
            consumer(sample)

    def _update(self) -> None:
        """Subscribe or unsubscribe if that has changed. The lock is held."""
        wanted = self.kept or bool(self._consumers)
        if wanted is not self.subscribed:
            self.subscribed = wanted
            if self._subscribe is not None:
                self._subscribe(wanted)


class FollowingChannel(Channel[T], Generic[T, C]):
    """The channel that is found now, and another one once the proxy was started again with other cameras.

    Who asked for no camera by name follows the vehicle's first. Consumers are added to the channel that is found, which
    delivers to them as to any others.
    """

    def __init__(self, find: Callable[[], C], changes: Channel[Any]) -> None:
        """Begin with the present channel.

        Args:
            find: Returns the channel; it may raise what keeps the one before.
            changes: Published to when there may be another channel.
        """
        super().__init__()
        self.current = find()
        self._find = find
        self._changes = changes
        self._looks = self._look

    def add(self, consumer: Callable[[T], None], dropped: Callable[[], int]) -> None:
        """Deliver to ``consumer`` too; see :meth:`Channel.add`."""
        with self._lock:
            if not self._drops:
                self._changes.add(self._looks, _none)
            self._drops[consumer] = dropped
            self.current.add(consumer, dropped)

    def remove(self, consumer: Callable[[T], None]) -> None:
        """Stop delivering to ``consumer``. Does nothing if it is not there."""
        with self._lock:
            if self._drops.pop(consumer, None) is not None:
                self.current.remove(consumer)
                if not self._drops:
                    self._changes.remove(self._looks)

    def _look(self, _: object) -> None:
        with self._lock, suppress(SkyloopError):  # there is no camera, or the drone was closed
            before, self.current = self.current, self._find()
            for consumer, dropped in self._drops.items() if self.current is not before else ():
                before.remove(consumer)
                self.current.add(consumer, partial(_since, dropped, dropped()))


def _none() -> int:
    return 0


def _since(dropped: Callable[[], int], before: int) -> int:
    return dropped() - before


class VideoChannel(Channel[Arrival]):
    """Frames of one camera, as one request wants them."""

    def __init__(
        self,
        camera: CameraInfo,
        connection: ProxyConnection,
        scheduler: Scheduler,
        history: FeedbackHistory,
        request: VideoRequest | None = None,
    ) -> None:
        """Make a channel without consumers.

        Args:
            camera: The camera.
            connection: Where its topics are subscribed to.
            scheduler: Source of the time and of waiting.
            history: Looked up for the state at a frame's capture.
            request: How frames are wanted; None: see :func:`usual`.
        """
        self.camera = camera
        self.request = request or usual(camera.name)
        super().__init__(lambda on: connection.subscribe(self.request.topic, on))
        #: Names its statistics: the camera's plain topic for the usual request, else the request's own.
        self.name = video(camera.name) if self.request == usual(camera.name) else self.request.topic
        self.newest: Arrival | None = None
        self.notifier = scheduler.notifier()  #: notified with each frame
        self.counter = ChannelCounter()
        self.undecodable = 0
        self.too_old = 0  #: frames that a consumer got and, by its ``max_age_s``, did not want
        self.watch = StallWatch(max(1.0, 5.0 * self._period_s(camera.fps)), scheduler.clock())
        self.filter = FrameFilter(self.request)  #: chooses the plain frames that this request asks for
        self._read: Arrival | None = None  # what next_frame() gave last
        self._connection = connection
        self._history = history
        self._clock = scheduler.clock

    @property
    def unread(self) -> bool:
        """Whether there is a frame that :meth:`read` has not returned yet."""
        return self.newest is not self._read

    def read(self) -> Frame | None:
        """Return the newest frame and mark it as read; None if there is none or it can't be decoded."""
        self._read = arrival = self.newest
        return None if arrival is None else self.picture(arrival)

    def picture(self, arrival: Arrival, max_age_s: float | None = None) -> Frame | None:
        """Decode the frame; None, and counted, if its pixels can't be decoded, or it is too old.

        Args:
            arrival: The frame.
            max_age_s: Oldest age since the capture that is accepted [s]; None: any.
        """
        if max_age_s is not None and arrival.age_s > max_age_s:
            self.too_old += 1
            return None
        try:
            return arrival.frame()
        except DecodeError:
            self.undecodable += 1
            return None

    def receive(self, header: FrameHeader, pixels: Pixels, now_ns: int, *, as_asked: bool) -> None:
        """Publish a frame that came; ignores one that is repeated or was overtaken.

        Args:
            header: Describes the pixels.
            pixels: Bytes of the frame, shape (size,), uint8.
            now_ns: When it came, on this process's clock.
            as_asked: Whether the proxy made it for this request; if False it is scaled here where needed.
        """
        counter = self.counter
        last = counter.last_seq
        if last is not None and header.seq <= last:
            return  # repeated or overtaken
        offset_ns, scale = self._connection.offset_ns, self.request.scale
        if as_asked or scale == 1.0:
            arrival = Arrival(header, pixels, now_ns, offset_ns, self._history, self._clock)
        else:
            arrival = SmallArrival(header, pixels, now_ns, offset_ns, self._history, self._clock, scale)
        # Consumers first, then the statistics. The previous frame is released last: giving its memory back to the proxy
        # takes longer than all of this.
        before, self.newest = self.newest, arrival
        self.publish(arrival)
        self.notifier.notify()
        del before
        counter.follow(header.seq)
        counter.add(now_ns + offset_ns - header.published_ns, header.captured_ns - offset_ns, now_ns)
        self.watch.received_ns = now_ns

    def restart(self, now_ns: int) -> None:
        """Reset the frame number: a proxy was connected, which may count its frames from 0."""
        self.counter.last_seq = None
        self.watch.received_ns = now_ns

    def stats(self, now_ns: int) -> ChannelStats:
        """Return the statistics at ``now_ns``."""
        return self.counter.stats(now_ns, dropped=self.dropped + self.too_old, malformed=self.undecodable)

    def _period_s(self, fps: float) -> float:
        """Expected time between two frames of this request [s]; 0 if unknown."""
        most = self.request.max_fps
        rate = min(fps, most) if fps > 0.0 and most is not None else fps or most or 0.0
        parts = 1 if self.request.part is None else self.request.part[1]
        return parts / rate if rate > 0.0 else 0.0


class VideoOptions(TypedDict, total=False):
    """How frames are requested; see :meth:`skyloop.Drone.frames`."""

    encoding: VideoEncoding
    quality: int
    max_fps: float
    scale: float
    part: tuple[int, int]
    kbit_s: int
    max_age_s: float


def usual(camera: str) -> VideoRequest:
    """Return the request of a consumer that asks for nothing in particular: JPEG where frames travel over a network."""
    return VideoRequest(camera, encoding="jpeg")


class Listener(Generic[T]):
    """A callback of an application, called with samples until :meth:`cancel` or the end of its block.

    The function has a thread of its own and a mailbox of the newest ``depth`` samples: however slow it is, it gets new
    samples and delays nobody else. With ``inline=True`` it is called on the receiving thread, before the next sample is
    received, which is fastest; it must be quick and must not wait. An exception that it raises is counted and, at most
    once a second, logged and emitted as an event; the function is called again with the next sample.
    """

    def __init__(
        self,
        function: Callable[[T], object],
        channel: Channel[T],
        report: Report,
        *,
        name: str,
        depth: int = 1,
        inline: bool = False,
        on_cancel: Callable[[Listener[T]], None] | None = None,
    ) -> None:
        """Start calling ``function``.

        Args:
            function: Called with each sample.
            channel: Where the samples come from.
            report: Called with this listener's name and an exception that ``function`` raised.
            name: For the thread and for error messages.
            depth: How many samples may wait.
            inline: Call on the publishing thread instead of an own one.
            on_cancel: Called with this listener when it is cancelled.
        """
        self.name = name
        self.errors = 0  #: calls that raised
        self._function = function
        self._channel = channel
        self._report = report
        self._on_cancel = on_cancel
        self._calls = 0
        self._next_report_s = 0.0
        self._mailbox: Mailbox[T] = Mailbox(depth)
        self._consumer = self._call if inline else self._mailbox.put
        self._thread = None if inline else threading.Thread(target=self._run, name=f"skyloop-{name}", daemon=True)
        if self._thread is not None:
            self._thread.start()
        channel.add(self._consumer, lambda: self.dropped)

    @property
    def delivered(self) -> int:
        """How often the function was called."""
        return self._calls

    @property
    def dropped(self) -> int:
        """Samples that newer ones pushed out before the function was ready for them."""
        return self._mailbox.dropped

    def cancel(self, *, wait: bool = True) -> None:
        """Stop calling the function. Idempotent.

        Args:
            wait: Wait for a call that is under way, at most 2 s; not if called from the function itself.
        """
        self._channel.remove(self._consumer)
        self._mailbox.close()
        if self._on_cancel is not None:
            self._on_cancel(self)
        if wait:
            self.join(JOIN_S)

    def join(self, within_s: float) -> None:
        """Wait for a call that is under way; not if called from the function itself."""
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(within_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.cancel()

    def _run(self) -> None:
        mailbox = self._mailbox
        while not mailbox.closed:
            sample = mailbox.wait()
            if sample is not None:
                self._call(sample)

    def _call(self, sample: T) -> None:
        self._calls += 1
        try:
            self._function(sample)
        except ClosedError:  # its drone was closed, or the flight is at its end: nothing is wrong with the function
            self.errors += 1
        except SystemExit as error:  # would end this thread, and nobody else would hear of it
            self._report(self.name, error)
        except Exception as error:  # noqa: BLE001  (an application's function may raise anything)
            self.errors += 1
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        now_s = time.monotonic()
        if now_s < self._next_report_s:
            return  # report at most once a second; ``errors`` counts all
        self._next_report_s = now_s + _REPORT_EVERY_S
        _log.error("%s raised %r (%d times so far)", self.name, error, self.errors, exc_info=error)
        self._report(self.name, error)
