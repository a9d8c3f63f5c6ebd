"""What is heard from the vehicle: stamped, remembered and published on the thread that heard it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S, Clock
from skyloop.messages import (
    CameraInfo,
    Capabilities,
    EncodedFrame,
    Encoding,
    EventKind,
    Feedback,
    FlightState,
    FrameHeader,
    Intrinsics,
    LinkState,
    Severity,
    Value,
    encode,
)
from skyloop.messages.encoded import H264, MAX_ENCODED
from skyloop.proxy.events import EventLog, Notice
from skyloop.proxy.statistics import Counters
from skyloop.transport.base import FEEDBACK, ServerEnd, stream, video

#: A vehicle silent for so long: the proxy publishes what it knows itself (authority, links), so at 4 Hz.
KEEP_ALIVE_NS: Final = NS_PER_S // 4

_CHANNELS: Final = {Encoding.BGR8: 3, Encoding.RGB8: 3, Encoding.MONO8: 1}
_LINK_UP: Final = frozenset({LinkState.UP, LinkState.DEGRADED})
_replace = msgspec.structs.replace


def _as_told(state: FlightState) -> FlightState:
    return state


class Vehicle:
    """The driver's :class:`skyloop.drivers.base.Sink`, and the newest that is known of the vehicle.

    It takes no lock that is held while the driver is called, so that a driver may call it from wherever it likes.
    """

    def __init__(
        self, server: ServerEnd, events: EventLog, counters: Counters, clock: Clock, capabilities: Capabilities
    ) -> None:
        self.feedback_now: Feedback | None = None  #: the newest sample as it was published
        self.told_state = FlightState.UNKNOWN  #: as the driver said
        self.link_state = LinkState.CONNECTING
        self.link_up = False
        self.link_breaks = 0  #: how often the link went from up to not, or came back
        self.state_of: Callable[[FlightState], FlightState] = _as_told  #: the software autopilot's word on it
        self.on_link_up: Callable[[], None] = lambda: None
        self._owner: dict[str, Any] = {}
        self._publish = server.publish
        self._publish_frame = server.publish_frame
        self._subscribers = server.subscribers
        self._events = events
        self._counts = counters.counts
        self._clock = clock
        self._publishing = threading.Condition(threading.Lock())
        self._raw: Feedback | None = None
        self._seq = 0
        self._published_ns = -KEEP_ALIVE_NS
        self._state = FlightState.UNKNOWN
        self._frame_lock = threading.Lock()
        self._frame_seq: dict[str, int] = {}
        self._stream_seq: dict[str, int] = {}
        self._cameras: dict[str, CameraInfo] = {camera.name: camera for camera in capabilities.cameras}
        self._topics: dict[str, str] = {camera: video(camera) for camera in self._cameras}

    # Feedback --------------------------------------------------------------------------------------------------

    def feedback(self, feedback: Feedback) -> None:
        """The vehicle's newest state, from the driver."""
        with self._publishing:
            self._raw = feedback
            before, after = self._send(feedback, self._clock())
        if before is not after:
            self._tell_state(before, after)

    def stamp(self, owner: dict[str, Any]) -> None:
        """The proxy's own fields of feedback from now on; shown at the next tick at the latest."""
        self._owner = owner
        self._published_ns = -KEEP_ALIVE_NS

    def keep_alive(self, now_ns: int) -> None:
        """Publish what the proxy knows if the vehicle has been silent. Call some times a second."""
        if now_ns - self._published_ns < KEEP_ALIVE_NS:
            return
        with self._publishing:
            before, after = self._send(self._raw or Feedback(captured_ns=now_ns), now_ns)
        if before is not after:
            self._tell_state(before, after)

    def wait_for(self, wanted: Callable[[FlightState], bool], timeout_s: float) -> bool:
        """Block until the flight state is as wanted; False if the time runs out. Not for the driver's threads."""
        with self._publishing:
            return self._publishing.wait_for(lambda: wanted(self._state), timeout_s)

    def _send(self, raw: Feedback, now_ns: int) -> tuple[FlightState, FlightState]:
        self._seq += 1
        self.told_state = raw.state
        state = self.state_of(raw.state)
        sample = _replace(
            raw, state=state, seq=self._seq, published_ns=now_ns, vehicle_link=self.link_state, **self._owner
        )
        self.feedback_now = sample
        self._published_ns = now_ns
        try:
            packet = encode(sample)
        except (ValueError, TypeError, OverflowError) as error:
            self._fail("feedback", f"feedback cannot be sent with its native telemetry: {error}")
            packet = encode(_replace(sample, native=None))
        missed = self._publish(FEEDBACK, packet)
        self._counts["feedback.published"] += 1
        if missed:
            self._counts["feedback.missed"] += missed
        before = self._state
        if state is not before:
            self._state = state
            self._publishing.notify_all()
        return before, state

    def _tell_state(self, before: FlightState, after: FlightState) -> None:
        severity = Severity.ERROR if after is FlightState.EMERGENCY else Severity.INFO
        text = f"flight state: {before.value} → {after.value}"
        self._events.tell(EventKind.STATE_CHANGED, text, severity, data={"before": before.value, "after": after.value})

    # Frames ----------------------------------------------------------------------------------------------------

    def frame(
        self,
        camera: str,
        pixels: NDArray[np.uint8],
        captured_ns: int,
        *,
        width: int,
        height: int,
        encoding: Encoding = Encoding.BGR8,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        """A whole frame, from the driver."""
        with self._frame_lock:
            seq = self._frame_seq[camera] = self._frame_seq.get(camera, 0) + 1
        channels = _CHANNELS.get(encoding)
        if channels is not None and pixels.nbytes != width * height * channels:
            expected = f"{width} × {height} {encoding.value} is {width * height * channels} bytes"
            self._fail("frame", f"frame of camera {camera} has {pixels.nbytes} bytes, and {expected}")
        elif self.wants(camera):
            if intrinsics is None:
                intrinsics = self._nominal_intrinsics(camera, width, height)
            header = FrameHeader(
                camera, seq, captured_ns, self._clock(), width, height, encoding, pixels.nbytes, intrinsics
            )
            self._hand_on(header, pixels)
        self._counts[f"frames.{camera}.received"] += 1

    def _hand_on(self, header: FrameHeader, pixels: NDArray[np.uint8]) -> None:
        camera = header.camera
        try:
            missed = self._publish_frame(header, pixels)
        except (ValueError, TypeError) as error:
            self._fail("frame", f"frame of camera {camera} cannot be published: {error}")
            return
        self._counts[f"frames.{camera}.published"] += 1
        if missed:
            self._counts[f"frames.{camera}.missed"] += missed

    def wants(self, camera: str) -> bool:
        """Whether anybody looks at this camera now."""
        topic = self._topics.get(camera)
        if topic is None:
            topic = self._topics[camera] = video(camera)
        return self._subscribers(topic) > 0

    def stream(
        self,
        camera: str,
        data: bytes,
        captured_ns: int,
        *,
        width: int,
        height: int,
        key: bool,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        """A picture as the vehicle encoded it, from the driver."""
        with self._frame_lock:
            seq = self._stream_seq[camera] = self._stream_seq.get(camera, 0) + 1
        self._counts[f"streams.{camera}.received"] += 1
        if len(data) > MAX_ENCODED:
            self._counts[f"streams.{camera}.too_large"] += 1
            why = f"a picture of {camera} as it came has {len(data)} bytes, at most {MAX_ENCODED} are handed on"
            self._fail("stream", f"{why}: the stream goes on with the next key picture that is smaller")
            return
        if intrinsics is None:
            intrinsics = self._nominal_intrinsics(camera, width, height)
        now_ns = self._clock()
        sample = EncodedFrame(camera, seq, captured_ns, now_ns, width, height, H264, key, data, intrinsics)
        try:
            packet = encode(sample)
        except (ValueError, TypeError, OverflowError) as error:
            self._fail("stream", f"a picture of {camera} as it came cannot be published: {error}")
            return
        missed = self._publish(stream(camera), packet)
        self._counts[f"streams.{camera}.published"] += 1
        if missed:
            self._counts[f"streams.{camera}.missed"] += missed

    def wants_stream(self, camera: str) -> bool:
        """Whether anybody takes this camera's pictures as they come."""
        return self._subscribers(stream(camera)) > 0

    def _nominal_intrinsics(self, camera: str, width: int, height: int) -> Intrinsics | None:
        info = self._cameras.get(camera)
        if info is not None and (info.width, info.height) == (width, height):
            return info.intrinsics
        return None

    # Link and events -------------------------------------------------------------------------------------------

    def link(self, state: LinkState, reason: str = "") -> None:
        """The hop to the vehicle changed, from the driver. Told at once; the flight acts on it at its next step."""
        with self._publishing:
            before, self.link_state = self.link_state, state
            was_up, self.link_up = self.link_up, state in _LINK_UP
            if was_up != self.link_up and (was_up or self.link_breaks):  # not when it comes up for the first time
                self.link_breaks += 1
            self._published_ns = -KEEP_ALIVE_NS  # shown in feedback at the next tick
        if before is state:
            return
        text = f"link to the vehicle: {before.value} → {state.value}" + (f" ({reason})" if reason else "")
        severity = Severity.INFO if state is LinkState.UP else Severity.WARNING
        self._events.tell(EventKind.VEHICLE_LINK, text, severity, data={"state": state.value, "reason": reason})
        if self.link_up and (not was_up or state is LinkState.UP):  # all of it may be known now: read it again
            self.on_link_up()

    def event(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: Value) -> None:
        """Something happened, from the driver. Driver errors that go on are told once a second."""
        if kind is EventKind.DRIVER_ERROR:
            self._events.repeated(("driver", text), lambda: Notice(kind, text, severity, data=dict(data)))
        else:
            self._events.tell(kind, text, severity, data=data)

    def driver_failed(self, where: str, error: BaseException) -> None:
        """A call of the driver raised."""
        self._counts["driver.errors"] += 1
        self._fail(where, f"driver failed in {where}: {error!r}")

    def _fail(self, where: str, text: str) -> None:
        self._events.repeated(
            ("driver", where), lambda: Notice(EventKind.DRIVER_ERROR, text, Severity.ERROR, data={"where": where})
        )
