"""The base class for ready-made behaviours, which detect something in images and fly by a control law."""

from __future__ import annotations

from contextlib import suppress
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

from skyloop.clock import nanoseconds
from skyloop.control.airframe import AirframeLaw
from skyloop.control.controller import Controller
from skyloop.errors import UnknownNameError, UsageError
from skyloop.extend import let_go
from skyloop.messages import Attitude, CameraInfo, EventKind, Feedback, Severity, Velocity
from skyloop.messages.relayed import Colour, Shape

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

BLIND_S = 0.5  #: time without a frame after which the vehicle hovers

# Colours of the drawings on frames.
SEEN: Colour = (64, 220, 100)  #: target in view
SEARCHING: Colour = (120, 190, 255)  #: target not found yet
LOST: Colour = (255, 180, 60)  #: target out of view
OTHER: Colour = (150, 150, 150)  #: an object that is not the target


class Law(Protocol):
    """The control law of a behaviour, pure logic without clocks or threads; times are on the proxy's clock [ns]."""

    def feedback(self, feedback: Feedback) -> None:
        """Update the control law with the vehicle's newest state."""

    def step(self, now_ns: int) -> Velocity | Attitude:
        """Compute the set-point for the current time."""


class Behaviour(Controller):
    """A controller that flies by what it detects in camera frames.

    For each frame, :meth:`look` searches the image, the law computes a set-point, :meth:`steer` sends it, and the
    detections are drawn as annotations. Changes of :attr:`phase` are published as events. The vehicle must be airborne
    when :meth:`run` is called. If no frames arrive for more than :data:`BLIND_S`, or a part of the vehicle's state that
    the law needs is unknown, the vehicle hovers and an event gives the reason.

    Subclasses define :meth:`look`, :attr:`phase` and, for phases in which the target is out of sight, :attr:`losses`.
    """

    name = "behaviour"  #: source of the annotations and prefix of event texts
    losses: frozenset[StrEnum] = frozenset()  #: phases in which the target is out of sight; reported as warnings

    def __init__(self, drone: Drone, law: Law, camera: str | None = None) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            law: The control law that computes the set-points.
            camera: Camera to use; None for the vehicle's first camera.

        Raises:
            UnknownNameError: The vehicle has no such camera.
        """
        super().__init__(drone)
        self.camera = camera
        self.done = False  #: whether the behaviour has ended
        self.blind = False  #: whether the vehicle is hovering because no frames arrive
        self.problem = ""  #: missing part of the vehicle's state that causes the hovering
        self._law = law
        self._mounting = camera_info(drone, camera)
        self._frame_ns: int | None = None  # capture time of the newest frame
        self._reported: StrEnum | None = None

    @property
    def phase(self) -> StrEnum:
        """The current phase."""
        raise NotImplementedError

    def look(self, frame: Frame) -> list[Shape]:
        """Find the target in a frame and update the control law.

        Returns:
            The shapes to draw on the frame.
        """
        raise NotImplementedError

    def on_feedback(self, feedback: Feedback) -> None:
        """Update the law, and hover if frames stop arriving."""
        self._law.feedback(feedback)
        if self._frame_ns is None or self.done:
            return
        # abs() is needed: a frame with a time in the future would otherwise hide the fact that frames have stopped.
        if abs(feedback.captured_ns - self._frame_ns) > nanoseconds(BLIND_S):
            if not self.blind:
                self.blind = True
                self.emit("no frames arrive: hovering", Severity.WARNING)
            let_go(self.drone, "no frames arrive")

    def on_frame(self, frame: Frame) -> None:
        """Search the frame, send the law's set-point and draw the detections."""
        if self.done:
            return
        self._frame_ns = frame.captured_ns
        if self.blind:
            self.blind = False
            self.emit("frames arrive again")
        shapes = self.look(frame)
        self.fly(frame.captured_ns + nanoseconds(frame.age_s))
        with suppress(UsageError):  # shapes that can't be drawn must not end the flight
            self.drone.annotate(frame, shapes, source=self.name)

    def fly(self, now_ns: int) -> None:
        """Compute the control law's set-point, send it and report any change of phase.

        Args:
            now_ns: The current time on the proxy's clock.
        """
        law = self._law
        known = law.airframe.feedback if isinstance(law, AirframeLaw) else None
        if isinstance(law, AirframeLaw) and known is not None and self._is_overruled(known):
            law.pause()
        wanted = law.step(now_ns)
        self._report_phase()
        if self.done:
            return
        problem = law.problem if isinstance(law, AirframeLaw) and known is not None else ""
        if problem != self.problem:
            self.problem = problem
            text = f"{problem}: hovering" if problem else "the vehicle's motion is known again: continuing"
            self.emit(text, Severity.WARNING if problem else Severity.INFO)
        if problem:
            let_go(self.drone, problem)
        else:
            self.steer(wanted)

    def steer(self, wanted: Velocity | Attitude) -> None:
        """Send a set-point to the vehicle.

        Args:
            wanted: A velocity in the body's levelled axes, or an attitude.
        """
        if isinstance(wanted, Attitude):
            self.drone.command(wanted)
        else:
            self.drone.velocity(forward=wanted.forward, left=wanted.left, up=wanted.up, yaw_rate=wanted.yaw_rate)

    def finish(self, text: str, severity: Severity = Severity.INFO) -> None:
        """End the behaviour permanently: publish an event, hover and make :meth:`run` return.

        Args:
            text: The result, which follows the behaviour's name in the event text.
            severity: Severity of the event.
        """
        self.done = True
        self.emit(text, severity)
        let_go(self.drone, text)
        self._end()

    def emit(self, text: str, severity: Severity = Severity.INFO) -> None:
        """Publish an event to this application's event subscribers.

        Args:
            text: Event text, which follows the behaviour's name and a colon.
            severity: Severity of the event.
        """
        self.drone.emit(EventKind.VEHICLE_MESSAGE, f"{self.name}: {text}", severity)

    def _report_phase(self) -> None:
        phase = self.phase
        if phase is not self._reported:
            lost = phase in self.losses and self._reported is not None
            self._reported = phase
            self.emit(phase.value, Severity.WARNING if lost else Severity.INFO)


def camera_info(drone: Drone, camera: str | None) -> CameraInfo:
    """Return a camera of the vehicle by name, or its first camera; raise UnknownNameError if there is none."""
    cameras = {info.name: info for info in drone.capabilities.cameras}
    if camera is None and cameras:
        return next(iter(cameras.values()))
    if camera not in cameras:
        raise UnknownNameError("camera", camera or "", cameras)
    return cameras[camera]
