"""What a robot's messages say, in Skyloop's units and axes, and on this host's clock. Pure."""

from __future__ import annotations

import math
from typing import Any, Final

from skyloop.clock import LiveClock, seconds
from skyloop.vehicles.ros2.wire.conversions import euler_of, levelled_velocity

PLAUSIBLE_AGE_NS: Final = 2_000_000_000  #: a stamp that is older, or in the future, is of another clock


class CaptureClock:
    """Maps the stamps of one topic to this host's monotonic clock.

    A stamp that is a little older than the system's clock is of that clock. Others are of another: a simulation's, or
    one that is not set; then the smallest delay that was seen lately is taken for none. Times never run backwards.
    """

    def __init__(self) -> None:
        self._live = LiveClock()
        self._newest_ns = 0

    def captured_ns(self, stamp_ns: int, arrived_ns: int, system_ns: int) -> int:
        """Return when a message was captured.

        Args:
            stamp_ns: Its stamp; 0: it has none.
            arrived_ns: When it came, on the monotonic clock.
            system_ns: The same on the system's clock.
        """
        age_ns = system_ns - stamp_ns
        if stamp_ns == 0:
            captured_ns = arrived_ns
        elif 0 <= age_ns <= PLAUSIBLE_AGE_NS:
            captured_ns = arrived_ns - age_ns
        else:
            captured_ns = min(arrived_ns, self._live.captured_ns(seconds(stamp_ns), arrived_ns))
        self._newest_ns = max(self._newest_ns, captured_ns)
        return self._newest_ns


def state_of(odometry: Any, *, ground: bool) -> dict[str, Any]:
    """Return the fields of a feedback that a ``nav_msgs/Odometry`` holds; what is not finite is left out.

    Args:
        odometry: Its pose is in world axes, its twist in those of the body.
        ground: Whether the robot stays on the ground: then its height is none.
    """
    found: dict[str, Any] = {}
    turn, place = odometry.pose.pose.orientation, odometry.pose.pose.position
    angles = euler_of((turn.x, turn.y, turn.z, turn.w))
    position = (float(place.x), float(place.y), float(place.z))
    if all(map(math.isfinite, position)):
        found["position_m"] = position
        if not ground:
            found["altitude_m"] = position[2]
    if angles is None:
        return found
    found["roll_rad"], found["pitch_rad"], found["yaw_rad"] = angles
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    moved, turned = (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z)
    if all(map(math.isfinite, moved)):
        found["velocity_m_s"] = levelled_velocity(moved, angles[0], angles[1])
    if all(map(math.isfinite, turned)):
        found["angular_velocity_rad_s"] = tuple(map(float, turned))
    return found


def battery_of(message: Any) -> dict[str, float | None]:
    """Return the fields of a feedback that a ``sensor_msgs/BatteryState`` holds."""
    charge, voltage = _finite(message.percentage), _finite(message.voltage)
    if charge is not None and not 0.0 <= charge <= 1.0:
        charge = charge / 100.0 if 1.0 < charge <= 100.0 else None  # some tell percent
    return {"battery": charge, "battery_v": voltage}


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
