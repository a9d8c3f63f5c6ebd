"""Hold the position by the optical flow of the ground, by attitude: for a vehicle without position and velocity."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import AirframeLaw, Part, not_ahead
from skyloop.control.behaviour import Behaviour
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.control.limiting import GRAVITY_M_S2, clamped, shortened
from skyloop.control.pid import Gains, VectorPi
from skyloop.errors import UsageError
from skyloop.extend import let_go
from skyloop.messages import Attitude, Points, Text, Velocity
from skyloop.messages.geometry import wrap_angle
from skyloop.messages.relayed import Colour, Shape
from skyloop.vision.flow import GroundTracker

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

Array = NDArray[np.float64]
_SEEN: Colour = (64, 220, 100)
_LOST: Colour = (255, 180, 60)


class FlowPhase(StrEnum):
    """What :class:`FlowLaw` is doing."""

    WAITING = "waiting for the first pictures of the ground"
    HOLDING = "holding the place by the ground's picture"
    LOST = "lost the ground: hovering"


@dataclass(frozen=True, slots=True)
class FlowSettings:
    """Gains and limits of :class:`FlowLaw`.

    Raises:
        UsageError: A number is negative or not finite.
    """

    gain: float = 2.5  #: acceleration by distance [1/s²]
    damping: float = 2.6  #: acceleration by velocity [1/s]
    integral: float = 0.6  #: acceleration by distance and time, for the wind [1/s³]
    tilt_rad: float = 0.2
    height_gain: float = 1.0  #: [1/s]
    yaw_gain: float = 1.5  #: [1/s]
    lead_s: float = 0.12  #: from a set-point's decision until it takes effect
    fresh_s: float = 0.3  #: greatest age of the last sighting of the ground that is still flown by

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise UsageError(f"{name} is {value!r} and must be a finite number, 0 or more")


@dataclass(slots=True)
class _Kept:
    """What to hold: yaw [rad], altitude [m], and position (2,) [m] in the tracker's axes."""

    yaw: float
    altitude: float
    place: Array = field(default_factory=lambda: np.zeros(2))


class FlowLaw(AirframeLaw):
    """Computes attitudes from horizontal positions. Pure: times are on the proxy's clock [ns].

    A PID of each axis: acceleration by position, velocity and the integral of the position. The velocity comes from a
    constant-velocity filter of the positions, not from the vehicle.

    Attributes:
        phase: As of the last step.
        off_m: Estimated distance from the position to hold; None while it is not known.
    """

    def __init__(self, settings: FlowSettings | None = None) -> None:
        """Initialise the law."""
        super().__init__(Part.ATTITUDE, Part.HEIGHT)
        self.settings = s = settings or FlowSettings()
        self.phase = FlowPhase.WAITING
        self.off_m: float | None = None  #: estimated distance from the position to hold; None while it is not known
        self._loop = VectorPi(Gains(p=s.gain, i=s.integral), 2, most=0.5 * s.tilt_rad * GRAVITY_M_S2)
        self._filter = ConstantVelocityFilter(2, intensity_m2_s3=0.5, speed_m_s=0.5, gate=math.inf)
        self._kept: _Kept | None = None
        self._seen_ns: int | None = None

    def pause(self) -> None:
        """Restart without an integral."""
        super().pause()
        self._loop.reset()

    def see(self, place: Array, captured_ns: int) -> None:
        """Update with a position; the first one, and the first after a second without, becomes the one to hold.

        Args:
            place: Where the vehicle was at the capture, (2,) [m], along yaw 0 and to its left.
            captured_ns: Capture of the frame.
        """
        newest, altitude = self.airframe.feedback, self.airframe.altitude_m(captured_ns)
        if newest is None or newest.yaw_rad is None or altitude is None or not np.isfinite(place).all():
            return
        if self._seen_ns is None or seconds(captured_ns - self._seen_ns) > 1.0:
            self._filter.start(place, 0.02, captured_ns)
            self._kept = _Kept(newest.yaw_rad, altitude, np.asarray(place, np.float64))
        else:
            self._filter.update(place, 0.02, captured_ns)
        self._seen_ns = captured_ns

    def step(self, now_ns: int) -> Attitude:
        """Compute the set-point for now: level, which brakes nothing, while the position is not known."""
        s, ready, newest = self.settings, self._ready(now_ns), self.airframe.feedback
        if self._seen_ns is not None and not_ahead(self._seen_ns, now_ns) is None:
            self._seen_ns, self.phase, self.off_m = None, FlowPhase.LOST, None
        if self._seen_ns is None or self._kept is None:
            return Attitude()
        altitude, yaw = self._altitude, None if newest is None else newest.yaw_rad
        if not ready or altitude is None or yaw is None or seconds(now_ns - self._seen_ns) > s.fresh_s:
            self.phase, self.off_m, self._last_ns = FlowPhase.LOST, None, None
            return Attitude()
        self.phase = FlowPhase.HOLDING
        ahead = self._filter.at(now_ns + nanoseconds(s.lead_s))
        off = self._kept.place - ahead.position
        self.off_m = float(np.linalg.norm(self._kept.place - self._filter.at(now_ns).position))
        asked = self._loop.step(off, min(0.2, self._since_s(now_ns))) - s.damping * ahead.velocity
        wanted = shortened(asked, s.tilt_rad * GRAVITY_M_S2)
        self._loop.applied(asked, wanted)
        c, si = math.cos(yaw), math.sin(yaw)
        forward, left = c * wanted[0] + si * wanted[1], c * wanted[1] - si * wanted[0]
        return Attitude(
            roll=-math.atan2(left, GRAVITY_M_S2),
            pitch=math.atan2(forward, GRAVITY_M_S2),
            climb=clamped(s.height_gain * (self._kept.altitude - altitude), 0.5),
            yaw_rate=clamped(s.yaw_gain * wrap_angle(self._kept.yaw - yaw), 1.0),
        )


class FlowHover(Behaviour):
    """Holds the position, height and yaw at which it first saw the ground, by the camera that looks down.

    Needs attitude and height from the vehicle, uses nothing else of its feedback, and flies by attitude. Without sight
    of the ground it hovers as the vehicle itself can, by which some drift, emits a warning, and holds wherever it sees
    the ground again.
    """

    name = "flow hover"
    losses = frozenset({FlowPhase.LOST})

    def __init__(self, drone: Drone, *, camera: str = "bottom", settings: FlowSettings | None = None) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly; it must be airborne when :meth:`run` is called.
            camera: One that looks down.
            settings: Of the law; None are the defaults.

        Raises:
            UnknownNameError: The vehicle has no such camera.
            UsageError: The vehicle does not accept attitude set-points.
            MissingExtraError: OpenCV is not installed.
        """
        if "attitude" not in drone.capabilities.actions:
            raise UsageError("this vehicle does not fly by attitude")
        self._flow_law = FlowLaw(settings)
        super().__init__(drone, self._flow_law, camera)
        self._tracker = GroundTracker(self._mounting)

    @property
    def phase(self) -> FlowPhase:
        """What the behaviour is doing."""
        return self._flow_law.phase

    @property
    def off_m(self) -> float | None:
        """Estimated distance from the position to hold [m]; None while it is not known."""
        return self._flow_law.off_m

    def steer(self, wanted: Velocity | Attitude) -> None:
        """Send the set-point; hover in place of it while the ground is not seen, which the event of the phase says."""
        if self.phase is FlowPhase.HOLDING:
            super().steer(wanted)
        else:
            let_go(self.drone, "the ground is not seen")

    def look(self, frame: Frame) -> list[Shape]:
        """Track the ground."""
        found = None if frame.feedback is None else self._tracker.see(frame, frame.feedback)
        if found is None:
            return [Text(self.phase.value, (8.0, 16.0), _LOST)]
        place, count = found
        self._flow_law.see(place, frame.captured_ns)
        off = "" if self.off_m is None else f", {self.off_m:.2f} m off"
        return [Points(self._tracker.points, _SEEN), Text(f"{count} corners{off}", (8.0, 16.0), _SEEN)]
