"""Publishes recorded samples: the vehicle's as they were, those of the recorded proxy as messages about the past."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import msgspec

from skyloop.clock import Clock, seconds
from skyloop.drivers.base import Sink
from skyloop.errors import SkyloopError
from skyloop.messages import (
    AnyAction,
    Applied,
    Event,
    EventKind,
    Feedback,
    LinkState,
    Parameter,
    Severity,
    Value,
)
from skyloop.recording.pictures import Picture
from skyloop.vehicles.replay.playback import PAUSED, POSITION, SPEED, Playback
from skyloop.vehicles.replay.source import Moment, TimedSample, Timeline

#: Events of the vehicle itself. All others were the recorded proxy's or an application's: a client must not take them
#: for events about its own authority or commands.
_VEHICLES_OWN: Final = frozenset({EventKind.COLLISION, EventKind.VEHICLE_MESSAGE, EventKind.DRIVER_ERROR})
#: Events that the proxy of the replay emits itself.
_PROXYS_OWN: Final = frozenset({EventKind.STATE_CHANGED, EventKind.VEHICLE_LINK})
_LINKS: Final = frozenset({LinkState.UP, LinkState.DEGRADED, LinkState.LOST})
PREFIX: Final = "recorded."  #: of the names of recorded parameters


def _nothing(_: int) -> None:
    """Publish nothing: nobody wants this camera's frames."""


class ReplayPublisher:
    """Publishes samples to a sink, stamped on the replay's clock.

    Args:
        sink: The proxy's.
        clock: The replay's.
        playback: Gets the position of what is published.
        first_ns: Where the recording begins, on its own clock.
    """

    def __init__(self, sink: Sink, clock: Clock, playback: Playback, first_ns: int) -> None:
        self.frames = 0  #: published so far, those that nobody wanted included
        self.damaged = 0
        self.loops = 0
        self.parameters: dict[str, Parameter] = {}
        self._sink = sink
        self._clock = clock
        self._playback = playback
        self._first_ns = first_ns
        self._link = LinkState.CONNECTING
        self._newest_ns: dict[str, int] = {}  # capture times never go backwards, from one pass to the next either
        self._command: dict[str, Value] = {}

    def link(self, state: LinkState, reason: str = "") -> None:
        """Publish the state of the vehicle link, if it changed."""
        if state is not self._link:
            self._link = state
            self._sink.link(state, reason)

    def prepare(self, sample: TimedSample, timeline: Timeline) -> Callable[[], None]:
        """Do the slow part now and return a function that publishes the sample once it is due.

        Args:
            sample: What to publish.
            timeline: Maps its time to the replay's clock.
        """
        value = sample.value
        if isinstance(value, Feedback):
            return lambda: self.feedback(value, timeline, sample.at_ns)
        if isinstance(value, Picture):
            show = self._decoded(value) if self._sink.wants(value.camera) else _nothing
            return lambda: self._picture(value, show, timeline)
        if isinstance(value, Event):
            return lambda: self._event(value)
        if isinstance(value, Applied):
            return lambda: self._command.update(described(value))
        return lambda: self.parameter(value)

    def parameter(self, parameter: Parameter) -> None:
        """Set the value that :attr:`parameters` gives from now on."""
        name = PREFIX + parameter.name
        self.parameters[name] = msgspec.structs.replace(parameter, name=name, read_only=True)

    def still(self, moment: Moment) -> Callable[[], None]:
        """Return a function that publishes a moment as it is now: its state and its pictures, with one capture time.

        It may be called again and again, while the replay is paused; each picture is decoded once.

        Args:
            moment: What to show. Its command and its parameters are those in force from now on.
        """
        self._command = {} if moment.command is None else described(moment.command)
        for parameter in moment.parameters:
            self.parameter(parameter)
        decoded: dict[str, Callable[[int], None]] = {}

        def publish() -> None:
            now_ns = self._clock()
            if moment.state is not None:
                at_capture = Timeline(1.0, moment.state.captured_ns, now_ns)
                self.feedback(moment.state, at_capture, moment.at_ns)
            for name, picture in moment.pictures.items():
                if self._sink.wants(name):
                    if name not in decoded:
                        decoded[name] = self._decoded(picture)
                    decoded[name](self._captured(name, now_ns, Timeline(1.0, now_ns, now_ns)))

        return publish

    def feedback(self, feedback: Feedback, timeline: Timeline, at_ns: int) -> None:
        """Publish the vehicle's block as it was; the recorded proxy's becomes native telemetry.

        Args:
            feedback: As it was recorded.
            timeline: Maps its time to the replay's clock.
            at_ns: The position in the recording, on its own clock.
        """
        if feedback.vehicle_link in _LINKS:
            self.link(feedback.vehicle_link, "as recorded")
        playback = self._playback
        playback.position_s = seconds(max(0, at_ns - self._first_ns))
        native: dict[str, Value] = {
            **(feedback.native or {}),
            POSITION: playback.position_s,
            "replay.duration_s": playback.duration_s,
            SPEED: playback.speed,
            PAUSED: playback.paused,
            "replay.jumps": playback.jumps,
            "replay.loops": self.loops,
            "replay.owner": feedback.owner or "",
            "replay.failsafe": feedback.failsafe.value,
            **self._command,
        }
        self._sink.feedback(
            Feedback(
                captured_ns=self._captured("", feedback.captured_ns, timeline),
                state=feedback.state,
                battery=feedback.battery,
                battery_v=feedback.battery_v,
                roll_rad=feedback.roll_rad,
                pitch_rad=feedback.pitch_rad,
                yaw_rad=feedback.yaw_rad,
                altitude_m=feedback.altitude_m,
                velocity_m_s=feedback.velocity_m_s,
                angular_velocity_rad_s=feedback.angular_velocity_rad_s,
                acceleration_m_s2=feedback.acceleration_m_s2,
                position_m=feedback.position_m,
                native=native,
            )
        )

    def _picture(self, picture: Picture, show: Callable[[int], None], timeline: Timeline) -> None:
        self.frames += 1
        show(self._captured(picture.camera, picture.header.captured_ns, timeline))

    def _decoded(self, picture: Picture) -> Callable[[int], None]:
        """Decode a picture and return what publishes it with a capture time; a damaged one becomes an event."""
        try:
            pixels, encoding = picture.as_recorded()
        except SkyloopError as error:
            self.damaged += 1
            text = str(error)
            return lambda _: self._sink.event(EventKind.DRIVER_ERROR, text, Severity.WARNING, where="frame")
        height, width = pixels.shape[:2]
        return lambda captured_ns: self._sink.frame(
            picture.camera,
            pixels,
            captured_ns,
            width=width,
            height=height,
            encoding=encoding,
            intrinsics=picture.header.intrinsics,
        )

    def _event(self, event: Event) -> None:
        if event.kind in _PROXYS_OWN:
            return
        if event.kind in _VEHICLES_OWN:
            self._sink.event(event.kind, event.text, event.severity, **event.data)
            return
        data: dict[str, Value] = {"recorded_kind": event.kind.value, "recorded_app": event.app or ""}
        self._sink.event(EventKind.VEHICLE_MESSAGE, f"recorded: {event.text}", event.severity, **data)

    def _captured(self, channel: str, recorded_ns: int, timeline: Timeline) -> int:
        captured_ns = min(timeline.at(recorded_ns), self._clock())
        captured_ns = max(captured_ns, self._newest_ns.get(channel, captured_ns))
        self._newest_ns[channel] = captured_ns
        return captured_ns


def described(applied: Applied) -> dict[str, Value]:
    """Return a recorded command as native telemetry: what was asked for and what was applied."""
    return {
        "replay.asked": applied.asked.name,
        "replay.asked.values": numbers(applied.asked),
        "replay.applied": applied.applied.name,
        "replay.applied.values": numbers(applied.applied),
    }


def numbers(action: AnyAction) -> tuple[float, ...]:
    """Return an action's numbers in the order of its fields; NaN for one that was left out, such as a place's yaw."""
    given = (getattr(action, name) for name in action.__struct_fields__)
    return tuple(math.nan if number is None else float(number) for number in given)
