"""Feedback: the vehicle's state, time-stamped. What is not known is ``None``, never zero."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import msgspec

from skyloop.messages.earth import EarthOrigin
from skyloop.messages.fields import Failsafe, FlightState, LinkState, ReturnPhase
from skyloop.messages.intent import Outcome
from skyloop.messages.numbers import Count, Finite, TimeNs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Three finite numbers, along x, y and z.
Vector = tuple[Finite, Finite, Finite]

MAX_LINK_TEXT = 300  #: characters of a text about the link to the vehicle
LinkText = Annotated[str, msgspec.Meta(max_length=MAX_LINK_TEXT)]

#: How the reason of a link begins whose vehicle still wakes up: it is connecting or up, and can't take off yet.
WAKING_UP = "still waking up"

NO_POSITION = "the vehicle does not report its position"
#: What lets a vehicle know its position, for people who read the line above.
POSITION_SOURCES = (
    "let it know its position: a simulated drone reports it unless started with position=none, a MAVLink vehicle with "
    "GPS, optical flow or motion capture (docs/motion-capture.md)"
)

#: A value of a vehicle's native telemetry, of a parameter or of an event's particulars.
Value = bool | int | float | str | tuple[float, ...]


class Feedback(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """The newest known state of a vehicle.

    A driver fills the first block and leaves the second to the proxy. World axes are x east, y north, z up; a
    vehicle without a compass takes its heading at start for east. Roll is positive right side down, pitch nose down,
    yaw counter-clockwise from x (ROS REP 103).
    """

    captured_ns: TimeNs  #: when the vehicle was in this state, on the proxy's clock
    state: FlightState = FlightState.UNKNOWN
    battery: Finite | None = None  #: charge left, 0 to 1
    battery_v: Finite | None = None  #: voltage [V]
    roll_rad: Finite | None = None  #: [rad]
    pitch_rad: Finite | None = None  #: [rad]
    yaw_rad: Finite | None = None  #: [rad]
    altitude_m: Finite | None = None  #: height above the ground below [m]
    velocity_m_s: Vector | None = None  #: body's levelled axes: forward, left, up [m/s]
    angular_velocity_rad_s: Vector | None = None  #: about the body's axes [rad/s]
    acceleration_m_s2: Vector | None = None  #: specific force along the body's axes, gravity included [m/s²]
    position_m: Vector | None = None  #: in world axes [m], if the vehicle knows it
    native: dict[str, Value] | None = None  #: the vehicle's own telemetry, by its own names and in its own units

    seq: Count = 0  #: grows by one with each sample of a proxy's run
    published_ns: TimeNs = 0  #: when the proxy published it
    vehicle_link: LinkState = LinkState.CONNECTING  #: the hop proxy–vehicle
    owner: str | None = None  #: name of the application that holds the authority
    owner_id: Count = 0  #: its number in this run of the proxy; 0 for nobody
    owner_priority: Annotated[int, msgspec.Meta(ge=0, le=31)] | None = None  #: 0 is the highest
    lease: Count = 0  #: number of the lease in force; 0 for none
    failsafe: Failsafe = Failsafe.NONE
    link_reason: LinkText = ""  #: why the hop proxy–vehicle is as it is; while it is up: see :attr:`waking_up`
    link_remedy: LinkText = ""  #: what a person can do about it
    others: LinkText | None = None  #: why the proxy leaves the vehicle alone: another controller flies it
    start_position_m: Vector | None = None  #: where it took off last, in world axes [m]; None: that is not known
    return_phase: ReturnPhase = ReturnPhase.NONE  #: how far it is on its way back there
    skipped: Count = 0  #: samples before this one that the proxy left out, as the subscriber asked for fewer
    outcome: Outcome | None = None  #: what became of the newest intent; None: a proxy that does not tell

    @property
    def waking_up(self) -> bool:
        """Whether the vehicle was started just now and can't take off yet; ``link_reason`` says what it waits for."""
        return self.link_reason.startswith(WAKING_UP)

    @property
    def origin(self) -> EarthOrigin | None:
        """Where the world axes begin on the earth; None where the vehicle does not know its place on it."""
        return EarthOrigin.of(self.native)

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation from body to world axes, shape (3, 3), float64: Rz(yaw) · Ry(pitch) · Rx(roll).

        Reading it raises ``ValueError`` while the attitude is not known.
        """
        from skyloop.messages.geometry import rotation_from_euler

        if self.roll_rad is None or self.pitch_rad is None or self.yaw_rad is None:
            raise ValueError("the vehicle has not reported its attitude yet")
        return rotation_from_euler(self.roll_rad, self.pitch_rad, self.yaw_rad)
