"""Define the samples that a proxy reports: time-stamped vehicle state, events, and an overview of many vehicles.

Unknown values are ``None``, never zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import msgspec

from skyloop.messages.command import Outcome
from skyloop.messages.fields import (
    Count,
    EventKind,
    Failsafe,
    Finite,
    FlightState,
    LinkState,
    ReturnPhase,
    Severity,
    TimeNs,
    Value,
    Vector,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_LINK_TEXT = 300  #: maximum length of a text about the vehicle link [characters]
LinkText = Annotated[str, msgspec.Meta(max_length=MAX_LINK_TEXT)]

#: Prefix of ``link_reason`` while the vehicle is starting up: it can't take off yet, even if its link is already up.
WAKING_UP = "still waking up"

NO_POSITION = "the vehicle does not report its position"
#: Ways to provide a position, as advice to users whose vehicle has none.
POSITION_SOURCES = (
    "make it available: a simulated drone reports it unless started with position=none, a MAVLink vehicle with "
    "GPS, optical flow or motion capture (docs/motion-capture.md)"
)


class Feedback(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """The newest known state of a vehicle.

    The driver fills in the first block of fields, and the proxy the second block. The world axes are x east, y north, z
    up; for a vehicle without a compass, "east" is its heading at the start. Roll is positive with the right side down,
    pitch with the nose down, and yaw counter-clockwise from x (ROS REP 103).
    """

    captured_ns: TimeNs  #: time at which the vehicle was in this state, on the proxy's clock
    state: FlightState = FlightState.UNKNOWN
    battery: Finite | None = None  #: remaining charge, 0 to 1
    battery_v: Finite | None = None  #: battery voltage [V]
    roll_rad: Finite | None = None  #: roll [rad]
    pitch_rad: Finite | None = None  #: pitch [rad]
    yaw_rad: Finite | None = None  #: yaw [rad]
    altitude_m: Finite | None = None  #: height above the ground below the vehicle [m]
    velocity_m_s: Vector | None = None  #: velocity in the levelled body axes: forward, left, up [m/s]
    angular_velocity_rad_s: Vector | None = None  #: angular velocity about the body axes [rad/s]
    acceleration_m_s2: Vector | None = None  #: specific force along the body axes, including gravity [m/s²]
    position_m: Vector | None = None  #: position in world axes [m]; None if the vehicle does not know it
    native: dict[str, Value] | None = None  #: the vehicle's own telemetry, with its own names and units

    seq: Count = 0  #: increases by one with each sample while the proxy runs
    published_ns: TimeNs = 0  #: time at which the proxy published the sample
    vehicle_link: LinkState = LinkState.CONNECTING  #: state of the link from the proxy to the vehicle
    owner: str | None = None  #: name of the application that holds the authority
    owner_id: Count = 0  #: number of that application in this run of the proxy; 0 if no application holds the authority
    owner_priority: Annotated[int, msgspec.Meta(ge=0, le=31)] | None = None  #: 0 is the highest
    lease: Count = 0  #: number of the current lease; 0 if there is none
    failsafe: Failsafe = Failsafe.NONE
    link_reason: LinkText = ""  #: why the vehicle link is in this state; while it is up, see :attr:`waking_up`
    link_remedy: LinkText = ""  #: what the user can do about it
    others: LinkText | None = None  #: why the proxy leaves the vehicle alone: someone else is flying it
    start_position_m: Vector | None = None  #: position of the last take-off in world axes [m]; None: unknown
    return_phase: ReturnPhase = ReturnPhase.NONE  #: progress of the flight back to the start
    skipped: Count = 0  #: number of samples that the proxy skipped before this one, for a subscriber with a lower rate
    outcome: Outcome | None = None  #: outcome of the newest intent; None: the proxy does not report it
    next_owner: str | None = None  #: name of the first application in the queue for the authority; None: empty queue

    @property
    def waking_up(self) -> bool:
        """Whether the vehicle has just started and can't take off yet; ``link_reason`` tells what it is waiting for."""
        return self.link_reason.startswith(WAKING_UP)

    @property
    def origin(self) -> EarthOrigin | None:
        """Geographic position of the origin of the world axes; None if the vehicle does not know it."""
        return EarthOrigin.of(self.native)

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation from body axes to world axes, shape (3, 3), float64: Rz(yaw) · Ry(pitch) · Rx(roll).

        Raises ``ValueError`` while the attitude is unknown.
        """
        from skyloop.messages.geometry import rotation_from_euler

        if self.roll_rad is None or self.pitch_rad is None or self.yaw_rad is None:
            raise ValueError("the vehicle has not reported its attitude yet")
        return rotation_from_euler(self.roll_rad, self.pitch_rad, self.yaw_rad)


_KEYS: Final = ("origin.latitude_deg", "origin.longitude_deg", "origin.altitude_amsl_m", "origin.radius_m")


class EarthOrigin(NamedTuple):
    """Geographic position of the origin of ``Feedback.position_m``, whose axes are x east and y north.

    Autopilots project the earth onto their axes as a sphere. Conversions here use the same sphere as the vehicle; with
    a different sphere, positions would be off by up to 0.6 % of their distance from the origin.
    """

    latitude_deg: float  #: latitude [°], north positive
    longitude_deg: float  #: longitude [°], east positive
    altitude_m: float  #: altitude above mean sea level [m]
    radius_m: float  #: radius of the sphere that the vehicle uses for the earth [m]

    @classmethod
    def of(cls, native: Mapping[str, object] | None) -> EarthOrigin | None:
        """Return the origin from a driver's ``Feedback.native``; None if it is missing or its values are invalid."""
        found = [native.get(key) if native else None for key in _KEYS]
        numbers = [float(one) for one in found if isinstance(one, int | float) and math.isfinite(one)]
        if len(numbers) < len(_KEYS) or not (is_on_earth(*numbers[:2]) and numbers[3] > 0.0):
            return None
        return cls(*numbers)

    def native(self) -> dict[str, float]:
        """Return the entries that a driver adds to ``Feedback.native`` to report the origin."""
        return dict(zip(_KEYS, self, strict=True))

    def position_of(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[float, float, float]:
        """Convert a geographic position to world axes: x east, y north, z up [m].

        Latitude [°] is positive north, longitude [°] is positive east, and the altitude [m] is above mean sea level.
        Longitudes take the shorter way around the earth.
        """
        east_rad = math.radians(math.remainder(longitude_deg - self.longitude_deg, 360.0))
        middle_rad = math.radians((latitude_deg + self.latitude_deg) / 2.0)
        north_m = math.radians(latitude_deg - self.latitude_deg) * self.radius_m
        return east_rad * math.cos(middle_rad) * self.radius_m, north_m, altitude_m - self.altitude_m

    def place_of(self, position: tuple[float, float, float]) -> tuple[float, float, float]:
        """Convert a position in world axes [m] to latitude [°], longitude [°] and altitude above mean sea level [m]."""
        x, y, z = position
        latitude_deg = self.latitude_deg + math.degrees(y / self.radius_m)
        middle_rad = math.radians((latitude_deg + self.latitude_deg) / 2.0)
        longitude_deg = self.longitude_deg + math.degrees(x / (self.radius_m * math.cos(middle_rad)))
        return latitude_deg, math.remainder(longitude_deg, 360.0), self.altitude_m + z


def is_on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Return whether the position exists and is not within 0.1° of a pole, where east is undefined; False for NaN."""
    return abs(latitude_deg) < 89.9 and abs(longitude_deg) <= 180.0


class Event(msgspec.Struct, frozen=True, array_like=True):
    """Something that happened, and why. ``text`` is for people; ``kind`` and ``data`` are for programs."""

    kind: EventKind
    text: str
    at_ns: TimeNs  #: time of the event, on the proxy's clock
    severity: Severity = Severity.INFO
    seq: Count = 0  #: increases by one with each event while the proxy runs; 0 for events created by the client
    app: str | None = None  #: name of the application that the event concerns
    data: dict[str, Value] = msgspec.field(default_factory=dict)


MAX_ADDRESS: Final = 200  #: maximum length of a vehicle's address [characters]
MAX_EVENT_TEXT: Final = 200  #: maximum length of the last event's text [characters]


class VehicleOverview(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """Summary of one vehicle. Unknown values are ``None``, as in :class:`Feedback`."""

    name: Annotated[str, msgspec.Meta(max_length=64)]  #: name of the vehicle's proxy
    uri: Annotated[str, msgspec.Meta(max_length=MAX_ADDRESS)] = ""  #: address of the vehicle, truncated if too long
    vehicle: Annotated[str, msgspec.Meta(max_length=64)] = ""  #: family of the vehicle
    can_fly: bool = False  #: whether the vehicle accepts commands at all
    captured_ns: TimeNs = 0  #: capture time of the vehicle's newest feedback, on the proxy's clock; 0 if none
    state: FlightState = FlightState.UNKNOWN
    battery: Finite | None = None  #: remaining charge, 0 to 1
    position_m: Vector | None = None  #: position in world axes [m]
    altitude_m: Finite | None = None  #: height above the ground below [m]
    yaw_rad: Finite | None = None  #: yaw, counter-clockwise from x [rad]
    vehicle_link: LinkState = LinkState.CONNECTING  #: state of the hop from proxy to vehicle
    link_reason: LinkText = ""  #: reason for the link's state; while the link is up, why the vehicle can't take off yet
    link_remedy: LinkText = ""  #: what a person can do about it
    owner: str | None = None  #: name of the application that holds the authority
    owner_priority: Annotated[int, msgspec.Meta(ge=0, le=31)] | None = None  #: 0 is the highest
    failsafe: Failsafe = Failsafe.NONE
    others: LinkText | None = None  #: why the proxy leaves the vehicle alone: someone else is flying it
    return_phase: ReturnPhase = ReturnPhase.NONE
    applications: Count = 0  #: number of connected applications
    event: Event | None = None  #: last event, without its data; excludes connections and disconnections of applications


class Overview(msgspec.Struct, frozen=True, array_like=True, kw_only=True):
    """All vehicles of one process or of one proxy, by name, split into pages if they exceed one packet.

    All pages of one overview have the same ``seq``.
    """

    at_ns: TimeNs  #: time of the overview, on the proxy's clock
    seq: Count  #: increases by one with each overview
    first: Count = 0  #: index of the first row on this page
    total: Count = 0  #: number of rows on all pages
    vehicles: tuple[VehicleOverview, ...] = ()


class OverviewPages:
    """Assembles overviews from pages that arrive in order."""

    def __init__(self) -> None:
        self._seq: int | None = None
        self._rows: list[VehicleOverview] = []

    def add(self, page: Overview) -> Overview | None:
        """Add a page; return the overview if this page completes it.

        An incomplete overview is dropped, because the next one follows within a second.
        """
        if page.first == 0:
            self._seq, self._rows = page.seq, []
        elif page.seq != self._seq or page.first != len(self._rows):
            self._seq = None
            return None
        self._rows.extend(page.vehicles)
        if len(self._rows) < page.total:
            return None
        self._seq = None
        return msgspec.structs.replace(page, first=0, vehicles=tuple(self._rows))


def typical_feedback(captured_ns: int, state: FlightState = FlightState.FLYING) -> Feedback:
    """Return feedback that contains as many values as a real vehicle sends, for benchmarks."""
    return Feedback(
        captured_ns=captured_ns,
        state=state,
        battery=0.8,
        battery_v=11.4,
        roll_rad=0.01,
        pitch_rad=-0.02,
        yaw_rad=0.5,
        altitude_m=1.2,
        velocity_m_s=(0.1, 0.0, 0.0),
        angular_velocity_rad_s=(0.0, 0.01, 0.0),
        acceleration_m_s2=(0.0, 0.1, 9.8),
        position_m=(0.5, 0.25, 1.2),
    )
