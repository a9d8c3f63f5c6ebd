"""Feedback: the vehicle's state, time-stamped. What is not known is ``None``, never zero."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from skyloop.messages.command import Count
from skyloop.messages.kinds import Failsafe, FlightState, LinkState

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Vector = tuple[float, float, float]

#: A value of a vehicle's native telemetry, of a parameter or of an event's particulars.
Value = bool | int | float | str | tuple[float, ...]


class Feedback(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """The newest known state of a vehicle.

    A driver fills the first block and leaves the second to the proxy. World axes are x east, y north, z up; a
    vehicle without a compass takes its heading at start for east. Roll is positive right side down, pitch nose down,
    yaw counter-clockwise from x (ROS REP 103).
    """

    captured_ns: int  #: when the vehicle was in this state, on the proxy's clock
    state: FlightState = FlightState.UNKNOWN
    battery: float | None = None  #: charge left, 0 to 1
    battery_v: float | None = None  #: voltage [V]
    roll: float | None = None  #: [rad]
    pitch: float | None = None  #: [rad]
    yaw: float | None = None  #: [rad]
    altitude: float | None = None  #: height above the ground below [m]
    velocity: Vector | None = None  #: body's levelled axes: forward, left, up [m/s]
    angular_velocity: Vector | None = None  #: about the body's axes [rad/s]
    acceleration: Vector | None = None  #: specific force along the body's axes, gravity included [m/s²]
    position: Vector | None = None  #: in world axes [m], if the vehicle knows it
    native: dict[str, Value] | None = None  #: the vehicle's own telemetry, by its own names and in its own units

    seq: Count = 0  #: grows by one with each sample of a proxy's run
    published_ns: int = 0  #: when the proxy published it
    vehicle_link: LinkState = LinkState.CONNECTING  #: the hop proxy–vehicle
    owner: str | None = None  #: name of the application that holds the authority
    owner_id: Count = 0  #: its number in this run of the proxy; 0 for nobody
    owner_priority: int | None = None  #: 0 is the highest
    lease: Count = 0  #: number of the lease in force; 0 for none
    failsafe: Failsafe = Failsafe.NONE

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation from body to world axes, shape (3, 3), float64: Rz(yaw) · Ry(pitch) · Rx(roll).

        Raises ``ValueError`` while the attitude is not known.
        """
        from skyloop.messages.geometry import rotation_from_euler

        if self.roll is None or self.pitch is None or self.yaw is None:
            raise ValueError("the vehicle has not told its attitude yet")
        return rotation_from_euler(self.roll, self.pitch, self.yaw)
