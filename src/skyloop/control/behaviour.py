"""The base of ready behaviours: a law that is told feedback and what was seen, and steers by velocity or attitude."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

from skyloop.clock import nanoseconds
from skyloop.control.controller import Controller
from skyloop.errors import UnknownNameError
from skyloop.messages import Attitude, CameraInfo, EventKind, Feedback, Severity, Velocity
from skyloop.messages.annotation import Shape

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

BLIND_S = 0.5  #: with no picture for so long, it holds its place rather than turn or fly on


class Law(Protocol):
    """What a behaviour is around. Pure; times are on the proxy's clock [ns]."""

    def feedback(self, feedback: Feedback) -> None:
        """Take the vehicle's newest state."""

    def step(self, now_ns: int) -> Velocity | Attitude:
        """What to ask the vehicle for now."""


class Behaviour(Controller):
    """Sees, decides, steers, draws; says by events what it is doing. The vehicle must be airborne when :meth:`run` is
    called. When pictures stop coming it hovers.

    To be written: :meth:`look`, :attr:`phase`, and which phases are :attr:`losses`.
    """

    name = "behaviour"  #: its annotations' source, and how its events begin
    losses: frozenset[StrEnum] = frozenset()  #: phases in which it does not see what it flies by

    def __init__(self, drone: Drone, law: Law, camera: str | None = None) -> None:
        """``camera``: the vehicle's first if not given. Raises :class:`UnknownNameError` for one that it has not."""
        super().__init__(drone)
        self.camera = camera
        self.done = False  #: it came to its end
        self.blind = False  #: no pictures come, and it hovers
        self._law = law
        self._mounting = camera_info(drone, camera)
        self._frame_ns: int | None = None  # capture of the newest frame
        self._told: StrEnum | None = None

    @property
    def phase(self) -> StrEnum:
        """What it is doing."""
        raise NotImplementedError

    def look(self, frame: Frame) -> list[Shape]:
        """Tell the law what is in a picture; returns what to draw on it."""
        raise NotImplementedError

    def on_feedback(self, feedback: Feedback) -> None:
        """Keep track of the vehicle's own motion; hold the place when pictures stop coming."""
        self._law.feedback(feedback)
        if self._frame_ns is None or self.done:
            return
        if feedback.captured_ns - self._frame_ns > nanoseconds(BLIND_S):
            if not self.blind:
                self.blind = True
                self.tell("no pictures come: hovering", Severity.WARNING)
            self.drone.hover()

    def on_frame(self, frame: Frame) -> None:
        """Look, decide, command, and draw what was seen."""
        if self.done:
            return
        self._frame_ns = frame.captured_ns
        if self.blind:
            self.blind = False
            self.tell("pictures come again")
        shapes = self.look(frame)
        wanted = self._law.step(frame.captured_ns + nanoseconds(frame.age_s))
        self._tell_phase()
        if not self.done:
            self.steer(wanted)
        self.drone.annotate(frame, shapes, source=self.name)

    def steer(self, wanted: Velocity | Attitude) -> None:
        """Ask the vehicle for this."""
        if isinstance(wanted, Attitude):
            self.drone.command(wanted)
        else:
            self.drone.velocity(forward=wanted.forward, left=wanted.left, up=wanted.up, yaw_rate=wanted.yaw_rate)

    def finish(self, text: str) -> None:
        """It is over: the vehicle hovers, and :meth:`run` returns."""
        self.done = True
        self.tell(text)
        self.drone.hover()
        self.stop()

    def tell(self, text: str, severity: Severity = Severity.INFO) -> None:
        """Say something to this application's listeners of events."""
        self.drone.tell(EventKind.VEHICLE_MESSAGE, f"{self.name}: {text}", severity)

    def _tell_phase(self) -> None:
        phase = self.phase
        if phase is not self._told:
            lost = phase in self.losses and self._told is not None
            self._told = phase
            self.tell(phase.value, Severity.WARNING if lost else Severity.INFO)


def camera_info(drone: Drone, camera: str | None) -> CameraInfo:
    """How a camera is mounted, the vehicle's first for None. Raises :class:`UnknownNameError`."""
    cameras = {info.name: info for info in drone.capabilities.cameras}
    if camera is None and cameras:
        return next(iter(cameras.values()))
    if camera not in cameras:
        raise UnknownNameError("camera", camera or "", cameras)
    return cameras[camera]
