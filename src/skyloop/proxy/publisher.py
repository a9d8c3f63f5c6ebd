"""Publish the driver's reports (feedback, frames, streams, link state, events) on the driver's thread."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection
from math import isfinite
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S, Clock
from skyloop.errors import SkyloopError, shortened
from skyloop.messages import (
    CameraInfo,
    Capabilities,
    EncodedFrame,
    Encoding,
    Event,
    EventKind,
    Fate,
    Feedback,
    FlightState,
    FrameHeader,
    Intrinsics,
    LinkState,
    Refusal,
    Severity,
    Value,
    VehicleOverview,
    VideoRequest,
    encode,
)
from skyloop.messages.feedback import MAX_ADDRESS, MAX_EVENT_TEXT, MAX_LINK_TEXT
from skyloop.messages.frame import H264, MAX_ENCODED
from skyloop.proxy.core.command_checks import NO_INTENT, Intent
from skyloop.proxy.events import Counters, EventDraft, EventPublisher
from skyloop.proxy.streams import Streams
from skyloop.proxy.topics import PREFIX, STREAM_TOPIC, FeedbackVariants, topic_problem
from skyloop.transport.base import FEEDBACK, TransportServer, stream, video

#: While the vehicle is silent, the proxy publishes its own state (authority, links) at this interval, 4 Hz.
KEEP_ALIVE_NS: Final = NS_PER_S // 4

_CHANNELS: Final = {Encoding.BGR8: 3, Encoding.RGB8: 3, Encoding.MONO8: 1}
_LINK_UP: Final = frozenset({LinkState.UP, LinkState.DEGRADED})
_replace = msgspec.structs.replace
_NUMBERS: Final = ("battery", "battery_v", "roll_rad", "pitch_rad", "yaw_rad", "altitude_m")
_VECTORS: Final = ("velocity_m_s", "angular_velocity_rad_s", "acceleration_m_s2", "position_m")


class VehiclePublisher:
    """The driver's :class:`skyloop.drivers.base.Sink`, and the newest known state of the vehicle.

    It never acquires a lock that is held while the driver is called, so a driver may call it on any thread, even from
    inside such a call.

    ``state_of`` returns the flight state, given the driver's state, because the software autopilot may know better.
    ``on_link_up`` is called on the driver's thread when the vehicle's link has come up. ``scrub`` removes the secrets
    in the vehicle's address from text.
    """

    def __init__(
        self,
        *,
        server: TransportServer,
        events: EventPublisher,
        counters: Counters,
        clock: Clock,
        capabilities: Capabilities,
        state_of: Callable[[FlightState], FlightState],
        on_link_up: Callable[[], None],
        scrub: Callable[[str], str] = str,
    ) -> None:
        self.feedback_now: Feedback | None = None  #: the newest sample, as it was published
        self.reported_state = FlightState.UNKNOWN  #: the state reported by the driver, without the software autopilot
        self.link_state = LinkState.CONNECTING
        self.link_reason = ""  #: what the link is waiting for, and its last failure
        self.link_remedy = ""  #: what a person can do about the problem
        self.link_up = False
        self.link_breaks = 0  #: number of times that the link went down or came back
        self.state_of = state_of
        self.variants = FeedbackVariants(server, counters, clock)
        self.streams = Streams(server, counters, clock, lambda why: self._fail("stream", why))
        self._on_link_up = on_link_up
        self._scrub = scrub
        self._owner: dict[str, Any] = {}
        self._newest: tuple[Intent, int, str] = NO_INTENT, 0, ""
        self._shown_outcome: tuple[Fate, Refusal | None] = Fate.UNDER_WAY, None  # the same as in the newest sample
        self._capabilities = capabilities
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
        """Publish the vehicle's newest state."""
        feedback = self._finite(feedback)
        with self._publishing:
            self._raw = feedback
            before, after = self._send(feedback, self._clock())
        if before is not after:
            self._publish_state(before, after)

    def _finite(self, raw: Feedback) -> Feedback:
        """Return feedback with NaN and infinite numbers replaced by None, so that readers need not handle them."""
        vectors = (raw.velocity_m_s, raw.angular_velocity_rad_s, raw.acceleration_m_s2, raw.position_m)
        # NaN and infinity survive addition, so the usual case needs only one test.
        total = (raw.battery or 0.0) + (raw.battery_v or 0.0) + (raw.altitude_m or 0.0)
        total += (raw.roll_rad or 0.0) + (raw.pitch_rad or 0.0) + (raw.yaw_rad or 0.0)
        for vector in vectors:
            if vector is not None:
                total += vector[0] + vector[1] + vector[2]
        if isfinite(total):
            return raw
        wrong = [name for name in _NUMBERS if not isfinite(getattr(raw, name) or 0.0)]
        wrong += [name for name in _VECTORS if not all(map(isfinite, getattr(raw, name) or ()))]
        if wrong:
            self._fail("feedback", f"the vehicle's {', '.join(wrong)} were NaN or infinite and count as unknown")
        return _replace(raw, **dict.fromkeys(wrong))

    def stamp(self, owner: dict[str, Any]) -> None:
        """Set the proxy's own fields in feedback. The next tick publishes them."""
        self._owner = owner
        self._published_ns = -KEEP_ALIVE_NS

    def set_outcome(self, intent: Intent, app_id: int, name: str) -> None:
        """Set the outcome of an intent in feedback. If the intent has ended, the next tick publishes the outcome."""
        self._newest = intent, app_id, name
        if intent.fate is not Fate.UNDER_WAY and (intent.fate, intent.reason) != self._shown_outcome:
            self._published_ns = -KEEP_ALIVE_NS

    @property
    def is_shown(self) -> bool:
        """Whether feedback contains the current state of the proxy and the link."""
        return self._published_ns >= 0

    def keep_alive(self, now_ns: int) -> None:
        """Publish the proxy's own state if the vehicle has been silent. Call several times a second."""
        if now_ns - self._published_ns < KEEP_ALIVE_NS:
            return
        with self._publishing:
            before, after = self._send(self._raw or Feedback(captured_ns=now_ns), now_ns)
        if before is not after:
            self._publish_state(before, after)

    def wait_for(self, wanted: Callable[[FlightState], bool], timeout_s: float) -> bool:
        """Block until the flight state meets a condition; return False after the time-out. Not for drivers' threads."""
        with self._publishing:
            return self._publishing.wait_for(lambda: wanted(self._state), timeout_s)

    def _send(self, raw: Feedback, now_ns: int) -> tuple[FlightState, FlightState]:
        self._seq += 1
        self.reported_state = raw.state
        state = self.state_of(raw.state)
        intent, app_id, name = self._newest
        outcome = intent.outcome(app_id, name, state)
        self._shown_outcome = outcome.fate, outcome.reason
        sample = _replace(
            raw,
            state=state,
            seq=self._seq,
            published_ns=now_ns,
            vehicle_link=self.link_state,
            link_reason=self.link_reason,
            link_remedy=self.link_remedy,
            outcome=outcome,
            **self._owner,
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
        if self.variants.known:
            self.variants.publish(sample, now_ns)
        before = self._state
        if state is not before:
            self._state = state
            self._publishing.notify_all()
        return before, state

    def _publish_state(self, before: FlightState, after: FlightState) -> None:
        severity = Severity.ERROR if after is FlightState.EMERGENCY else Severity.INFO
        text = f"flight state: {before.value} → {after.value}"
        self._events.publish(
            EventKind.STATE_CHANGED, text, severity, data={"before": before.value, "after": after.value}
        )

    def overview(self, name: str, uri: str, event: Event | None, *, applications: int) -> VehicleOverview:
        """Return the vehicle's row in the overview. ``event``: the newest event."""
        known = self.feedback_now or Feedback(captured_ns=0)
        return VehicleOverview(
            name=name,
            uri=uri[:MAX_ADDRESS],
            vehicle=self._capabilities.vehicle[:64],
            can_fly=bool(self._capabilities.actions),
            captured_ns=known.captured_ns,
            state=known.state,
            battery=known.battery,
            position_m=known.position_m,
            altitude_m=known.altitude_m,
            yaw_rad=known.yaw_rad,
            vehicle_link=self.link_state,
            link_reason=self.link_reason,
            link_remedy=self.link_remedy,
            owner=known.owner,
            owner_priority=known.owner_priority,
            failsafe=known.failsafe,
            others=known.others,
            return_phase=known.return_phase,
            applications=applications,
            event=None if event is None else _replace(event, text=event.text[:MAX_EVENT_TEXT], data={}),
        )

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
        """Publish a whole frame."""
        with self._frame_lock:
            seq = self._frame_seq[camera] = self._frame_seq.get(camera, 0) + 1
        channels = _CHANNELS.get(encoding)
        if channels is not None and pixels.nbytes != width * height * channels:
            expected = f"{width} × {height} {encoding.value} is {width * height * channels} bytes"
            self._fail("frame", f"frame of camera {camera} has {pixels.nbytes} bytes, and {expected}")
        elif self.wanted_fps(camera) > 0.0:
            if intrinsics is None:
                intrinsics = self._nominal_intrinsics(camera, width, height)
            header = FrameHeader(
                camera, seq, captured_ns, self._clock(), width, height, encoding, pixels.nbytes, intrinsics
            )
            try:
                missed = self._publish_frame(header, pixels)
            except (ValueError, TypeError) as error:
                self._fail("frame", f"frame of camera {camera} cannot be published: {error}")
            else:
                self._counts[f"frames.{camera}.published"] += 1
                if missed:
                    self._counts[f"frames.{camera}.missed"] += missed
                if self.streams.known:
                    self.streams.frame(header, pixels)
        self._counts[f"frames.{camera}.received"] += 1

    def cameras(self) -> Collection[str]:
        """Return the names of the vehicle's cameras, including undeclared ones that sent frames. Thread-safe."""
        return {*self._cameras, *self._frame_seq.copy()}

    def topic_problem(self, topic: str) -> str:
        """Return why a topic can't be subscribed to, or an empty string if it can be. Thread-safe."""
        if topic.startswith(PREFIX):
            return self.variants.problem(topic)
        problem = topic_problem(topic, self.cameras)
        if problem or not topic.startswith(STREAM_TOPIC) or "?" not in topic:
            return problem
        request = VideoRequest.parse(topic)
        info = self._cameras.get(request.camera) or CameraInfo(request.camera, 640, 480, 0.0)
        return self.streams.problem(topic, request, info)

    def wants(self, camera: str) -> bool:
        """Return whether this camera's frames are currently in use."""
        return self.wanted_fps(camera) > 0.0

    def wanted_fps(self, camera: str) -> float:
        """Return how many of this camera's frames are used per second; infinity means all of them, 0 none."""
        topic = self._topics.get(camera)
        if topic is None:
            topic = self._topics[camera] = video(camera)
        if self._subscribers(topic) > 0:
            return math.inf
        return self.streams.wanted_fps(camera) if self.streams.known else 0.0

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
        """Publish a frame as the vehicle encoded it."""
        with self._frame_lock:
            seq = self._stream_seq[camera] = self._stream_seq.get(camera, 0) + 1
        self._counts[f"streams.{camera}.received"] += 1
        if len(data) > MAX_ENCODED:
            self._counts[f"streams.{camera}.too_large"] += 1
            why = f"an encoded frame of {camera} has {len(data)} bytes, at most {MAX_ENCODED} are relayed"
            self._fail("stream", f"{why}: the stream resumes with the next smaller key frame")
            return
        if intrinsics is None:
            intrinsics = self._nominal_intrinsics(camera, width, height)
        sample = EncodedFrame(camera, seq, captured_ns, self._clock(), width, height, H264, key, data, intrinsics)
        try:
            self.streams.own(sample)
        except (ValueError, TypeError, OverflowError) as error:
            self._fail("stream", f"an encoded frame of {camera} can't be published: {error}")

    def wants_stream(self, camera: str) -> bool:
        """Return whether anyone receives this camera's encoded frames."""
        return self._subscribers(stream(camera)) > 0 or self.streams.wants_own(camera)

    def _nominal_intrinsics(self, camera: str, width: int, height: int) -> Intrinsics | None:
        info = self._cameras.get(camera)
        if info is not None and (info.width, info.height) == (width, height):
            return info.intrinsics
        return None

    # Link and events -------------------------------------------------------------------------------------------

    def link(self, state: LinkState, reason: str = "", remedy: str = "") -> None:
        """Publish a change of the vehicle link immediately. The flight reacts at its next step."""
        reason, remedy = (shortened(self._scrub(text), MAX_LINK_TEXT) for text in (reason, remedy))
        with self._publishing:
            same = (state, reason, remedy) == (self.link_state, self.link_reason, self.link_remedy)
            before, self.link_state = self.link_state, state
            self.link_reason, self.link_remedy = reason, remedy
            was_up, self.link_up = self.link_up, state in _LINK_UP
            if was_up != self.link_up and (was_up or self.link_breaks):  # not counting the first time that it comes up
                self.link_breaks += 1
            self._published_ns = -KEEP_ALIVE_NS  # to be published in feedback at the next tick
        if same:
            return
        change = state.value if before is state else f"{before.value} → {state.value}"
        text = f"link to the vehicle: {change}" + (f" ({reason})" if reason else "") + (f": {remedy}" if remedy else "")
        severity = Severity.INFO if state is LinkState.UP else Severity.WARNING
        data: dict[str, Value] = {"state": state.value, "reason": reason, "remedy": remedy}
        self._events.publish(EventKind.VEHICLE_LINK, text, severity, data=data)
        if before is state:
            return
        if self.link_up and (not was_up or state is LinkState.UP):  # everything may be known by now, so read it again
            self._on_link_up()

    def event(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: Value) -> None:
        """Publish an event from the driver. Repeated driver errors are published once a second."""
        if kind is EventKind.DRIVER_ERROR:
            self._events.publish_repeated(("driver", text), lambda: EventDraft(kind, text, severity, data=dict(data)))
        else:
            self._events.publish(kind, text, severity, data=data)

    def driver_failed(self, where: str, error: BaseException) -> str:
        """Report that a driver call failed; return the text for the requester."""
        self._counts["driver.errors"] += 1
        self._fail(where, f"driver failed in {where}: {error!r}")
        return self._scrub(f"the driver failed: {error!r}")

    def driver_refused(self, where: str, error: BaseException) -> str:
        """Return the text for the sender of a command that made the driver raise. Publish unexpected errors, too."""
        if isinstance(error, SkyloopError):  # the reason that the vehicle gave
            self._counts["driver.errors"] += 1
            return self._scrub(str(error))
        return self.driver_failed(where, error)

    def _fail(self, where: str, text: str) -> None:
        self._events.publish_repeated(
            ("driver", where), lambda: EventDraft(EventKind.DRIVER_ERROR, text, Severity.ERROR, data={"where": where})
        )
