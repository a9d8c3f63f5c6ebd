"""A law that keeps a vehicle on a path, from positions to velocities. Pure: no clock, no thread.

The path's velocity is fed forward, ahead of time by the vehicle's response time, and a PI loop on the position removes
the remaining error. The integral counteracts wind and a wrongly measured velocity (Åström and Hägglund, "Advanced PID
Control", ISA 2006, chapter 5). A measured position is compared with the path at the time of the measurement, so its
delay causes no error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import seconds
from skyloop.control.limiting import SetpointLimiter, SetpointLimits, lowered, within
from skyloop.control.path import Path
from skyloop.control.pid import Gains, VectorPi
from skyloop.control.waypoint import Fix
from skyloop.errors import UsageError
from skyloop.messages import Value, Velocity
from skyloop.messages.geometry import turned, wrap_angle

Array = NDArray[np.float64]
_LONGEST_STEP_S = 0.5  # maximum time by which the path advances between two fixes
_MAY_BE_ZERO = ("velocity_gain", "yaw_gain", "lead_s")
_SHARE = 0.6  # limit of the integral as a fraction of the maximum speed
_ALONG_M_S = 0.05  # minimum speed with a direction worth turning to
_NEAR_M = 0.3  # minimum horizontal distance to a point for a reliable bearing
_AHEAD_S = 0.1  # interval over which the rate of the wanted yaw is computed


class YawMode(Protocol):
    """Chooses the yaw from the path's position and velocity, both (3,) in world axes.

    Returns the yaw [rad], or None to keep the current one.
    """

    def __call__(self, position: Array, velocity: Array) -> float | None: ...


@dataclass(frozen=True, slots=True)
class FixedYaw:
    """A fixed yaw [rad].

    Raises:
        UsageError: The yaw is not finite.
    """

    yaw: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.yaw):
            raise UsageError(f"yaw is {self.yaw} and must be finite")

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw."""
        return self.yaw


@dataclass(frozen=True, slots=True)
class AlongPath:
    """Yaw along the direction of flight plus ``offset`` [rad], unchanged while the vehicle hovers or only climbs."""

    offset: float = 0.0

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw, or None while the horizontal speed is less than 0.05 m/s."""
        if math.hypot(velocity[0], velocity[1]) < _ALONG_M_S:
            return None
        return math.atan2(velocity[1], velocity[0]) + self.offset


@dataclass(frozen=True, slots=True)
class LookAt:
    """Yaw towards a point, x and y in world axes [m], unchanged while the vehicle is above or below it."""

    x: float
    y: float

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw, or None if the horizontal distance to the point is less than 0.3 m."""
        east, north = self.x - position[0], self.y - position[1]
        return math.atan2(north, east) if math.hypot(east, north) >= _NEAR_M else None


@dataclass(frozen=True, slots=True)
class PathSettings:
    """Gains, limits and acceptance radii of :class:`PathLaw`. The defaults suit a small indoor vehicle.

    Raises:
        UsageError: A number is out of its range.
    """

    #: Gains of the position error [1/s, 1/s²]; ``velocity_gain`` replaces the derivative.
    gains: Gains = field(default_factory=lambda: Gains(p=1.6, i=0.15))
    #: Fraction of the velocity error (if the velocity is known) that is added to the set-point: a vehicle with a soft
    #: velocity loop responds sooner, and gusts push it less far.
    velocity_gain: float = 1.0
    yaw_gain: float = 1.5  #: [1/s]
    lead_s: float = 0.25  #: response time to a set-point; the velocity is fed forward this far ahead
    limits: SetpointLimits = field(
        default_factory=lambda: SetpointLimits(
            speed_m_s=1.5, climb_m_s=0.6, turn_rad_s=1.2, acceleration_m_s2=3.0, climb_acceleration_m_s2=2.0
        )
    )
    leash_m: float = 0.5  #: distance from the target beyond which the path slows down; beyond twice this it waits
    near_m: float = 0.15  #: acceptance radius
    near_rad: float = 0.15  #: maximum acceptable yaw error

    def __post_init__(self) -> None:
        for name in ("velocity_gain", "yaw_gain", "lead_s", "leash_m", "near_m", "near_rad"):
            value = getattr(self, name)
            allowed = "a finite number, 0 or more" if name in _MAY_BE_ZERO else "a finite number above 0"
            if not 0.0 <= value < math.inf or (value == 0.0 and name not in _MAY_BE_ZERO):
                raise UsageError(f"{name} is {value!r} and must be {allowed}")
        if self.gains.d > 0.0:
            raise UsageError(f"gains.d is {self.gains.d!r} and must be 0: velocity_gain damps")

    def within(self, limits: Mapping[str, Value]) -> PathSettings:
        """Return these settings clamped to a drone's limits: higher speeds would wind up the integral.

        Args:
            limits: ``limits.speed``, ``limits.climb`` and ``limits.yaw_rate``, as in ``drone.config``; a missing one
                sets no limit.
        """
        own = self.limits
        return replace(
            self,
            limits=replace(
                own,
                speed_m_s=lowered(own.speed_m_s, limits, "limits.speed"),
                climb_m_s=lowered(own.climb_m_s, limits, "limits.climb"),
                turn_rad_s=lowered(own.turn_rad_s, limits, "limits.yaw_rate"),
            ),
        )


class PathLaw:
    """Computes velocities from fixes. The path's time starts with the first fix.

    Attributes:
        time_s: Current time on the path.
        off_m: Distance from the target on the path at the last fix.
    """

    def __init__(self, path: Path, settings: PathSettings | None = None, yaw: YawMode | None = None) -> None:
        """Initialise the law.

        Args:
            path: The path, in world axes.
            settings: Settings of the law; None for the defaults.
            yaw: Chooses the yaw; None keeps the yaw of the first fix.
        """
        self.settings = settings or PathSettings()
        self.time_s = 0.0  #: current time on the path
        self.off_m = 0.0  #: distance from the target on the path at the last fix
        self._path = path
        self._yaw = yaw
        limits = self.settings.limits
        self._loop = VectorPi(self.settings.gains, 3, most=_SHARE * limits.speed_m_s)
        self._limiter = SetpointLimiter(limits)
        self._last: Fix | None = None
        self._wanted_yaw: float | None = None
        self._turning = 0.0  # rate of the wanted yaw [rad/s]

    @property
    def over(self) -> bool:
        """Whether the path's time has ended."""
        return self.time_s >= self._path.duration_s

    @property
    def target(self) -> tuple[Array, Array]:
        """The vehicle's current target: position (3,) [m] and velocity (3,) [m/s]."""
        return self._path.position(self.time_s), self._path.velocity(self.time_s)

    def follow(self, path: Path, yaw: YawMode | None = None) -> None:
        """Continue with another path from its start while keeping the integrals.

        Args:
            path: The path, in world axes.
            yaw: Chooses the yaw; None keeps the current mode.
        """
        self._path, self.time_s = path, 0.0
        if yaw is not None:
            self._yaw = yaw

    def pause(self) -> None:
        """Restart from rest with zero integral: the vehicle hovers or another client flies it; the path waits."""
        self._limiter.reset(Velocity())
        self._loop.reset()
        self._last = None

    def there(self, fix: Fix) -> bool:
        """Return whether the path is over and the vehicle is at its end with the wanted yaw."""
        s = self.settings
        turned = 0.0 if self._wanted_yaw is None else wrap_angle(self._wanted_yaw - fix.yaw_rad)
        return self.over and self._off(fix) <= s.near_m and abs(turned) <= s.near_rad

    def step(self, fix: Fix) -> Velocity:
        """Compute the set-point for a fix. A fix that is no newer than the last one does not advance the path.

        A fix with non-finite values pauses the flight.
        """
        if not fix.finite:
            self.pause()
            return Velocity()
        dt_s = 0.0 if self._last is None else max(0.0, seconds(fix.at_ns - self._last.at_ns))
        self._last = fix
        self._go_on(min(dt_s, _LONGEST_STEP_S), self._off(fix))
        self.off_m = self._off(fix)
        target, _ = self.target
        ahead = self._path.velocity(self.time_s + self.settings.lead_s)
        wanted = ahead + self._loop.step(target - fix.position_m, min(dt_s, _LONGEST_STEP_S))
        if fix.velocity_m_s is not None:
            wanted += self.settings.velocity_gain * (wanted - fix.velocity_m_s)
        x, y, up = wanted.tolist()
        velocity = self._limiter.step(np.array([*turned(x, y, -fix.yaw_rad), up, self._turn(fix)]), dt_s)
        asked = (*turned(velocity.forward, velocity.left, fix.yaw_rad), velocity.up)
        self._loop.applied(wanted, np.array(asked))
        return velocity

    def _off(self, fix: Fix) -> float:
        return float(np.linalg.norm(self._path.position(self.time_s) - fix.position_m))

    def _go_on(self, dt_s: float, off_m: float) -> None:
        """Advance the path's time: slower beyond the leash, and not at all beyond twice the leash."""
        share = within(2.0 - off_m / self.settings.leash_m, 0.0, 1.0)
        self.time_s = min(self._path.duration_s, self.time_s + share * dt_s)

    def _turn(self, fix: Fix) -> float:
        """Return the wanted yaw rate [rad/s]."""
        position, velocity = self.target
        if self._yaw is not None:
            later = self.time_s + _AHEAD_S
            now, soon = self._yaw(position, velocity), self._yaw(self._path.position(later), self._path.velocity(later))
            self._turning = 0.0 if now is None or soon is None else wrap_angle(soon - now) / _AHEAD_S
            self._wanted_yaw = self._wanted_yaw if now is None else now
        if self._wanted_yaw is None:
            self._wanted_yaw = fix.yaw_rad
        return self._turning + self.settings.yaw_gain * wrap_angle(self._wanted_yaw - fix.yaw_rad)
