"""What a drone tells: feedback, frames, waiting for a state, listeners and processors."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, Protocol, TypedDict, TypeVar, Unpack

import msgspec
import numpy as np

from skyloop.client.delivery import Listener, Processor, Topic
from skyloop.client.frame import Arrival, Frame
from skyloop.client.handle import Handle
from skyloop.client.inbox import Inbox
from skyloop.client.reception import LinkStatus, VideoChannel
from skyloop.client.results import ResultSlot, checked_age, checked_name
from skyloop.client.slots import Buffer
from skyloop.errors import ClosedError, NoAnswerError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages import Annotation, Applied, Event, EventKind, Feedback, FlightState, LogEntry, Severity, encode
from skyloop.messages.annotation import Shape
from skyloop.messages.video import DEFAULT_QUALITY, VideoEncoding, VideoRequest

T = TypeVar("T")
#: What :meth:`Reading.wait` waits for: a flight state (or its name), one of several, or a predicate on feedback.
Wanted = FlightState | str | Iterable[FlightState | str] | Callable[[Feedback], bool]


class _Closable(Protocol):
    def close(self) -> None: ...


class VideoOptions(TypedDict, total=False):
    """How frames are to come; see :meth:`Reading.frames`."""

    encoding: VideoEncoding
    quality: int
    max_fps: float
    scale: float
    part: tuple[int, int]


EVENT_DEPTH: Final = 256  #: events, and other things of which none should be missed, that wait for a slow listener


class Reading(Handle):
    """What a drone tells. Reads are named by what they promise: the newest, the next unread one, or all that come."""

    def __init__(self) -> None:
        super().__init__()
        self._listeners: list[Listener[Any]] = []
        self._buffers: list[_Closable] = []  # at which somebody may wait
        self._read: Feedback | None = None  # what next_feedback() gave last

    # Reading ---------------------------------------------------------------------------------------------------

    def feedback(self, *, max_age_s: float | None = None) -> Feedback:
        """The newest feedback. Raises :class:`NoAnswerError` if it was captured longer ago than ``max_age_s``."""
        self._check_open()
        newest = self._reception.newest
        if newest is None:
            raise NoAnswerError("no feedback has come yet")
        if max_age_s is not None:
            age_s = self.age_s(newest)
            if age_s > max_age_s:
                raise NoAnswerError(f"the newest feedback is {age_s:.3f} s old, {max_age_s:g} s were allowed")
        self._read = newest
        return newest

    def age_s(self, sample: Feedback | Frame) -> float:
        """Time since the sample's capture [s], true to ``clock_uncertainty_ns`` on whichever host it was taken."""
        return (self._now_ns() - sample.captured_ns) / 1e9

    def next_feedback(self, timeout_s: float = 1.0) -> Feedback:
        """The newest feedback that was not read before, waited for. Raises :class:`NoAnswerError`."""
        self._check_open()
        self._check_may_wait()
        reception = self._reception
        if not reception.bell.wait_for(lambda: reception.newest is not self._read or self._closed, timeout_s):
            raise NoAnswerError(f"no feedback came within {timeout_s:g} s: the link is {self._link.state.value}")
        return self.feedback()

    def frame(self, camera: str | None = None, *, max_age_s: float | None = None) -> Frame | None:
        """The newest frame, None until one came or if it is older than ``max_age_s``. The first call subscribes."""
        channel = self.channel(camera)
        channel.keep_newest()
        arrival = channel.newest
        if arrival is None or (max_age_s is not None and arrival.age_s > max_age_s):
            return None
        return channel.picture(arrival)

    def next_frame(self, camera: str | None = None, *, timeout_s: float = 1.0) -> Frame:
        """The newest frame that this did not give before, waited for. Raises :class:`NoAnswerError`."""
        channel = self.channel(camera)
        channel.keep_newest()
        self._check_may_wait()
        deadline = time.monotonic() + timeout_s
        while channel.bell.wait_for(lambda: channel.unread or self._closed, deadline - time.monotonic()):
            self._check_open()
            frame = channel.read()
            if frame is not None:
                return frame
        raise NoAnswerError(f"no frame of {channel.camera.name} came within {timeout_s:g} s")

    def frames(
        self,
        camera: str | None = None,
        *,
        timeout_s: float = 5.0,
        **how: Unpack[VideoOptions],
    ) -> Iterator[Frame]:
        """Each newest frame, until the drone is closed; slow loops skip frames. Raises :class:`NoAnswerError`.

        ``max_fps``: at most so many a second; ``scale``: width and height times this, up to 1; ``part``: (k, n), only
        every n-th frame, for n workers with k from 0 that share them. ``encoding``: how they travel over a network,
        ``"jpeg"`` (of ``quality`` 1 to 100, default 80) or ``"raw"``; on one host all travel raw. Raises
        :class:`UsageError` for values that make no sense.
        """
        channel = self.channel(camera, **how)
        buffer: Buffer[Arrival] = Buffer(bell=self._reception.pace.bell())
        sink = buffer.put
        self._buffers.append(buffer)
        channel.topic.add(sink, lambda: buffer.dropped)
        try:
            while not self._closed:
                arrival = buffer.wait(timeout_s)
                if arrival is not None:
                    frame = channel.picture(arrival)
                    if frame is not None:
                        yield frame
                elif not buffer.closed:
                    raise NoAnswerError(f"no frame of {channel.camera.name} came within {timeout_s:g} s")
        finally:
            channel.topic.remove(sink)
            self._buffers.remove(buffer)

    def wait(self, state: Wanted, timeout_s: float = 10.0) -> Feedback:
        """Wait for a flight state, one of several, or a predicate on feedback, and return the feedback that met it.

        Raises :class:`NoAnswerError` with the state that it is in, :class:`ClosedError`.
        """
        self._check_open()
        self._check_may_wait()
        wanted, what = as_predicate(state)
        met: list[Feedback] = []

        def look() -> bool:
            newest = self._reception.newest
            if newest is not None and wanted(newest):
                met.append(newest)
            return bool(met) or self._closed

        if not self._reception.bell.wait_for(look, timeout_s):
            newest = self._reception.newest
            now = "nothing is known of it" if newest is None else f"it is {newest.state.value}"
            raise NoAnswerError(f"the vehicle was not {what} within {timeout_s:g} s: {now}")
        if not met:
            raise ClosedError("this drone was closed")
        return met[0]

    # Listening -------------------------------------------------------------------------------------------------

    def on_feedback(self, function: Callable[[Feedback], object], *, inline: bool = False) -> Listener[Feedback]:
        """Call with each newest feedback, on a thread of its own, or ``inline`` on the receiving thread."""
        return self._listen(self._reception.on_feedback, function, "feedback", inline=inline)

    # What follows is called on a thread of its own, or ``inline`` on the receiving thread.

    def on_event(self, function: Callable[[Event], object], *, inline: bool = False) -> Listener[Event]:
        """Call with each event, the client's own (number 0) included; 256 may wait.

        Inline, the client's own come on whichever thread has made them.
        """
        return self._listen(self._reception.on_event, function, "event", depth=EVENT_DEPTH, inline=inline)

    def on_link(self, function: Callable[[LinkStatus], object]) -> Listener[LinkStatus]:
        """Call whenever one of the two hops changes its state. On a thread of its own."""
        return self._listen(self._reception.on_link, function, "link", depth=EVENT_DEPTH)

    def on_command(self, function: Callable[[Applied], object], *, inline: bool = False) -> Listener[Applied]:
        """Call with what the proxy made of each command, anybody's; 256 may wait."""
        return self._listen(self._reception.on_command, function, "command", depth=EVENT_DEPTH, inline=inline)

    def on_annotation(self, function: Callable[[Annotation], object], *, inline: bool = False) -> Listener[Annotation]:
        """Call with what anybody drew on a frame; 256 may wait."""
        return self._listen(self._reception.on_annotation, function, "annotation", depth=EVENT_DEPTH, inline=inline)

    def on_log(self, function: Callable[[LogEntry], object], *, inline: bool = False) -> Listener[LogEntry]:
        """Call with what any application logs, this one included (see ``drone.log``); 256 may wait."""
        return self._listen(self._reception.on_log, function, "log", depth=EVENT_DEPTH, inline=inline)

    def add_processor(
        self,
        function: Callable[[Frame], object],
        camera: str | None = None,
        *,
        name: str | None = None,
        depth: int = 1,
        inline: bool = False,
        **how: Unpack[VideoOptions],
    ) -> Processor[Arrival]:
        """Call with frames, on a thread of its own that takes the newest ``depth``, or inline on the receiving one.

        ``how``: as for :meth:`frames`.
        """
        if depth < 1:
            raise UsageError(f"depth is {depth!r} and must be at least 1 frame")
        channel = self.channel(camera, **how)

        def process(arrival: Arrival) -> None:
            frame = channel.picture(arrival)
            if frame is not None:
                function(frame)

        label = name or getattr(function, "__name__", "processor")
        return self._listen(channel.topic, process, f"processor {label}", depth=depth, inline=inline)

    def inbox(
        self,
        *,
        feedback: bool = True,
        frames: bool = True,
        camera: str | None = None,
        results: bool = False,
        processors: Iterable[str] | None = None,
        max_age_s: float | None = None,
    ) -> Inbox:
        """Newest feedback, frames and results for one thread to wait for together; what controllers run on.

        ``processors``: whose results, None: everybody's; ``max_age_s``: how old they may be.
        """
        channels = self._reception.results
        named = None if processors is None else [checked_name(one) for one in processors]
        topics = [channels.everything] if named is None else [channels.channel(one).topic for one in named]
        return Inbox(
            self._reception,
            feedback=feedback,
            channel=self.channel(camera) if frames else None,
            results=topics if results else [],
            slot=ResultSlot(checked_age(max_age_s), self._reception.pace.bell()),
        )

    def annotate(self, frame: Frame, shapes: Iterable[Shape], source: str | None = None) -> bool:
        """Publish what was seen in a frame, in its pixels, for the cockpit and recorders; False if it was not sent.

        Coordinates may be NumPy's. ``source`` names what drew it (default: this application), and its newest drawing
        in each camera counts. Raises :class:`UsageError` for what is no shape, or too many of them.
        """
        height, width = frame.shape[:2]
        fields = (source or self._app, frame.camera, frame.captured_ns, width, height, tuple(shapes))
        try:
            annotation = msgspec.convert(msgspec.to_builtins(fields, enc_hook=_from_numpy), Annotation)
            packet = encode(annotation)
        except (msgspec.ValidationError, TypeError, ValueError) as error:
            raise UsageError(f"this can't be drawn on a frame: {error}") from None
        return self._link.transmit(packet)

    def tell(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: str) -> None:
        """Make an event of this application's own (number 0): it goes to its own listeners and nowhere else."""
        self._reception.tell(kind, text, severity, **data)

    # Inside ----------------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        """Now, on the proxy's clock."""
        return self._reception.pace.clock() + self._link.offset_ns

    def channel(
        self,
        camera: str | None = None,
        *,
        encoding: VideoEncoding | None = None,
        quality: int | None = None,
        max_fps: float | None = None,
        scale: float = 1.0,
        part: tuple[int, int] | None = None,
    ) -> VideoChannel:
        """The channel of a camera (None: the first), of its frames as they are asked for; see :meth:`frames`.

        Raises :class:`UnknownNameError`, or :class:`UnsupportedError` for a vehicle that has none.
        """
        self._check_open()
        channels = self._reception.channels
        if not channels:
            raise UnsupportedError("no camera: this vehicle gives no pictures")
        channel = next(iter(channels.values())) if camera is None else channels.get(camera)
        if channel is None:
            raise UnknownNameError("camera", str(camera), channels)
        if encoding == "raw" and quality is not None:
            raise UsageError(f'quality={quality!r} is of encoding="jpeg", and the encoding is "raw"')
        request = VideoRequest(
            channel.camera.name,
            encoding="jpeg" if encoding is None else encoding,
            quality=DEFAULT_QUALITY if quality is None else quality,
            max_fps=max_fps,
            scale=scale,
            part=part,
        )
        return channel if request == channel.request else self._reception.asked(channel.camera, request)

    def _listen(
        self,
        topic: Topic[T],
        function: Callable[[T], object],
        name: str,
        *,
        depth: int = 1,
        inline: bool = False,
    ) -> Listener[T]:
        self._check_listener(function)
        inline = inline or self._reception.pace.in_step
        listener = Listener(
            function, topic, self._report, name=name, depth=depth, inline=inline, on_cancel=self._cancelled
        )
        self._listeners.append(listener)
        return listener

    def _check_listener(self, function: Callable[[Any], object]) -> None:
        self._check_open()
        if not callable(function):
            raise UsageError(f"{function!r:.80} can't be called: a function with one argument is needed")

    def _cancelled(self, listener: Listener[Any]) -> None:
        if listener in self._listeners:
            self._listeners.remove(listener)

    def _report(self, where: str, error: Exception) -> None:
        text = f"{where} raised {type(error).__name__}: {error}"
        self._reception.tell(EventKind.CALLBACK_ERROR, text, Severity.ERROR, where=where)


def _from_numpy(value: Any) -> Any:
    """NumPy's numbers and arrays as plain ones."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is neither a shape nor a number")


def as_predicate(wanted: Wanted) -> tuple[Callable[[Feedback], bool], str]:
    """The test and its name for people."""
    if callable(wanted):
        name = getattr(wanted, "__name__", "<lambda>")
        return wanted, "as wanted" if name == "<lambda>" else name
    names = [wanted] if isinstance(wanted, str) else list(wanted)
    known = {state.value for state in FlightState}
    for name in names:
        if name not in known:
            raise UnknownNameError("flight state", str(name), known)
    states = frozenset(FlightState(name) for name in names)
    return lambda feedback: feedback.state in states, " or ".join(str(name) for name in names)
