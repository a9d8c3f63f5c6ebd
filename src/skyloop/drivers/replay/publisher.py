"""Publishes recorded samples: the vehicle's as they were, those of the recorded proxy as messages about the past."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from skyloop.clock import Clock, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.replay.source import TimedSample, Timeline
from skyloop.errors import SkyloopError
from skyloop.logfile.pictures import Picture
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

#: Events of the vehicle itself. All others were the recorded proxy's or an application's: a client must not take them
#: for events about its own authority or commands.
_VEHICLES_OWN: Final = frozenset({EventKind.COLLISION, EventKind.VEHICLE_MESSAGE, EventKind.DRIVER_ERROR})
#: Events that the proxy of the replay emits itself.
_PROXYS_OWN: Final = frozenset({EventKind.STATE_CHANGED, EventKind.VEHICLE_LINK})
_LINKS: Final = frozenset({LinkState.UP, LinkState.DEGRADED, LinkState.LOST})
PREFIX: Final = "recorded."  #: of the names of recorded parameters


def _nothing() -> None:
    """Publish nothing: nobody wants this camera's frames."""


class ReplayPublisher:
    """Publishes samples to a sink, stamped on the replay's clock.

    Args:
        sink: The proxy's.
        clock: The replay's.
    """

    def __init__(self, sink: Sink, clock: Clock) -> None:
        self.frames = 0  #: published so far, those that nobody wanted included
        self.damaged = 0
        self.loops = 0
        self.parameters: dict[str, Parameter] = {}
        self._sink = sink
        self._clock = clock
        self._link = LinkState.CONNECTING
        self._newest_ns: dict[str, int] = {}  # capture times never go backwards, from one pass to the next either
        self._command: dict[str, Value] = {}

    def link(self, state: LinkState, reason: str = "") -> None:
        """Publish the state of the vehicle link, if it changed."""
        if state is not self._link:
            self._link = state
            self._sink.link(state, reason)

    def prepare(self, sample: TimedSample, timeline: Timeline, begin_ns: int) -> Callable[[], None]:
        """Do the slow part now and return a function that publishes the sample once it is due.

        Args:
            sample: What to publish.
            timeline: Maps its time to the replay's clock.
            begin_ns: Where the replay began, on the recording's clock.
        """
        value = sample.value
        if isinstance(value, Feedback):
            return lambda: self.feedback(value, timeline, seconds(sample.at_ns - begin_ns))
        if isinstance(value, Picture):
            return self._picture(value, timeline)
        if isinstance(value, Event):
            return lambda: self._event(value)
        if isinstance(value, Applied):
            return lambda: self._command.update(described(value))
        return lambda: self.parameter(value)

    def parameter(self, parameter: Parameter) -> None:
        """Set the value that :attr:`parameters` gives from now on."""
        name = PREFIX + parameter.name
        self.parameters[name] = msgspec.structs.replace(parameter, name=name, read_only=True)

    def feedback(self, feedback: Feedback, timeline: Timeline, position_s: float) -> None:
        """Publish the vehicle's block as it was; the recorded proxy's becomes native telemetry."""
        if feedback.vehicle_link in _LINKS:
            self.link(feedback.vehicle_link, "as recorded")
        native: dict[str, Value] = {
            **(feedback.native or {}),
            "replay.position_s": position_s,
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

    def _picture(self, picture: Picture, timeline: Timeline) -> Callable[[], None]:
        self.frames += 1
        if not self._sink.wants(picture.camera):
            return _nothing
        try:
            pixels, encoding = picture.as_recorded()
        except SkyloopError as error:
            self.damaged += 1
            text = str(error)
            return lambda: self._sink.event(EventKind.DRIVER_ERROR, text, Severity.WARNING, where="frame")
        height, width = pixels.shape[:2]
        return lambda: self._sink.frame(
            picture.camera,
            pixels,
            self._captured(picture.camera, picture.header.captured_ns, timeline),
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
    """Return an action's numbers in the order of its fields."""
    return tuple(float(getattr(action, name)) for name in action.__struct_fields__)
