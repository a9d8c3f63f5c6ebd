"""Requests to the flight controller, its state in SI units and our axes, and its motion. Pure.

After identifying the flight controller, we request its state as fast as it replies. Apart from GPS, the only
velocity that MSP provides is the barometric climb rate, so external poses are differentiated.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.base import ExternalPose
from skyloop.messages import Feedback, FlightState, Value
from skyloop.messages.feedback import EarthOrigin
from skyloop.messages.geometry import wrap_angle
from skyloop.vehicles.msp.wire.frames import Direction, MspFrame
from skyloop.vehicles.msp.wire.messages import (
    Altitude,
    Battery,
    CellVoltages,
    Function,
    Gps,
    MspAttitude,
    MspStatus,
    multiple,
)

PATIENCE_NS: Final = nanoseconds(0.5)  #: time after which a missing reply counts as lost
TRIES: Final = 3  #: maximum number of attempts per request

#: Called with the reply's payload; None if the function is unknown or there was no reply.
Handler = Callable[[bytes | None], None]


class Questions:
    """Asks one question at a time, and repeats it until it is answered, at most :data:`TRIES` times in total."""

    def __init__(self) -> None:
        self._queue: deque[tuple[MspFrame, Handler]] = deque()
        self._sent_ns: int | None = None
        self._tries = 0

    @property
    def idle(self) -> bool:
        return not self._queue

    def ask(self, function: int, handler: Handler, payload: bytes = b"") -> None:
        self._queue.append((MspFrame(function, payload), handler))

    def clear(self) -> None:
        self._queue.clear()
        self._sent_ns = None

    def due(self, now_ns: int) -> MspFrame | None:
        """Return the request to send now."""
        if not self._queue or (self._sent_ns is not None and now_ns - self._sent_ns < PATIENCE_NS):
            return None
        if self._sent_ns is not None and self._tries >= TRIES:
            self._answer(None)
            return self.due(now_ns)
        self._sent_ns = now_ns
        self._tries += 1
        return self._queue[0][0]

    def on_frame(self, frame: MspFrame) -> bool:
        """Handle a frame; return whether the frame is the reply to the current question."""
        if not self._queue or self._sent_ns is None or frame.function != self._queue[0][0].function:
            return False
        self._answer(None if frame.direction is Direction.ERROR else frame.payload)
        return True

    def _answer(self, payload: bytes | None) -> None:
        _, handler = self._queue.popleft()
        self._sent_ns, self._tries = None, 0
        handler(payload)


@dataclass(slots=True)
class Stream:
    """States that are requested repeatedly in one frame."""

    functions: tuple[int, ...]
    period_ns: int
    due_ns: int = 0

    @property
    def frame(self) -> MspFrame:
        if len(self.functions) > 1:
            return MspFrame(Function.MULTIPLE, bytes(self.functions))
        return MspFrame(self.functions[0])


class MspTelemetry:
    """Requests states at their rates in hertz, a few at a time.

    A flight controller answers a few dozen requests per second, however fast the line is. Further requests would wait
    in its buffers and delay the sticks behind them, so at most ``most`` requests may be unanswered. A reply to
    ``MULTIPLE``, which newer firmware supports, does not identify its contents. There is therefore only one ``bundle``,
    requested at the rate of its first function, so that no reply can be mistaken for a lost one.
    """

    def __init__(self, streams: dict[int, float], bundle: tuple[int, ...] = (), *, most: int = 2) -> None:
        rates: dict[tuple[int, ...], float] = {
            (function,): rate for function, rate in streams.items() if function not in bundle
        }
        if bundle:
            rates = {bundle: streams[bundle[0]], **rates}
        self._streams = [Stream(functions, nanoseconds(1 / rate)) for functions, rate in rates.items()]
        self._bundle = bundle
        self._most = most
        self._asked: deque[tuple[int, int]] = deque()  # function and sending time of each pending request
        self.unanswered = 0

    def drop(self, function: int) -> None:
        """Stop requesting a state that the firmware does not support."""
        self._streams = [stream for stream in self._streams if stream.functions != (function,)]

    def forget(self) -> None:
        """Stop waiting for pending replies, which were lost with the connection."""
        self._asked.clear()

    def due_ns(self) -> int | None:
        """Return when the next request is due; None if no request will ever be due."""
        return min((stream.due_ns for stream in self._streams), default=None)

    def requests(self, now_ns: int) -> list[MspFrame]:
        """Return the requests to send now, the most overdue first."""
        while self._asked and now_ns - self._asked[0][1] >= PATIENCE_NS:
            self._asked.popleft()
            self.unanswered += 1
        made: list[MspFrame] = []
        for stream in sorted(self._streams, key=lambda each: each.due_ns):
            if stream.due_ns > now_ns or len(self._asked) >= self._most:
                break
            stream.due_ns = max(stream.due_ns + stream.period_ns, now_ns)
            frame = stream.frame
            self._asked.append((frame.function, now_ns))
            made.append(frame)
        return made

    def on_frame(self, frame: MspFrame) -> list[tuple[int, bytes | None]]:
        """Handle a frame; return the states that it contains, using None for any that the firmware does not support."""
        for number, (function, _) in enumerate(self._asked):
            if frame.function != function:
                continue
            for _ in range(number + 1):
                self._asked.popleft()
            self.unanswered += number
            if frame.function == Function.MULTIPLE:
                return [] if frame.direction is Direction.ERROR else list(multiple(frame.payload, self._bundle))
            return [(frame.function, None if frame.direction is Direction.ERROR else frame.payload)]
        return []


Vector = tuple[float, float, float]

POSE_NS: Final = nanoseconds(0.25)  #: poses older than this are ignored
ALTITUDE_NS: Final = nanoseconds(0.5)  #: barometer altitudes older than this are ignored
GPS_NS: Final = nanoseconds(1.0)  #: GPS fixes older than this are ignored
GAP_NS: Final = nanoseconds(0.4)  #: gap between poses above which the velocity filter restarts
SMOOTH_S: Final = 0.05  #: time constant of the velocity computed from poses
LEAST_SATELLITES: Final = 5  #: fixes with fewer satellites than this are ignored
GROUND_SAMPLES: Final = 10  #: approximate number of samples over which the ground's height is averaged
EARTH_RADIUS_M: Final = 6_371_000.0  #: mean radius, for a flat map around the first fix


class VelocityFilter:
    """A critically damped g-h filter for velocity (E. Brookner, "Tracking and Kalman Filtering", 1998)."""

    def __init__(self) -> None:
        self.velocity: Vector | None = None  #: None until the second position
        self._place: Vector = (0.0, 0.0, 0.0)
        self._at_ns: int | None = None

    def update(self, place: Vector, at_ns: int) -> None:
        """Add a position [m] measured at a time [ns]; ignore a position that is not newer than the last one."""
        gap_ns = None if self._at_ns is None else at_ns - self._at_ns
        if gap_ns is not None and gap_ns <= 0:
            return
        if gap_ns is None or gap_ns > GAP_NS:
            self.velocity = None
        elif self.velocity is None:
            self.velocity = _scaled(_minus(place, self._place), 1 / seconds(gap_ns))
        else:
            step_s = seconds(gap_ns)
            kept = math.exp(-step_s / SMOOTH_S)
            residual = _minus(_minus(place, self._place), _scaled(self.velocity, step_s))
            self.velocity = _plus(self.velocity, _scaled(residual, (1 - kept) ** 2 / step_s))
            place = _minus(place, _scaled(residual, kept**2))
        self._place, self._at_ns = place, at_ns


@dataclass(frozen=True, slots=True)
class MspMotion:
    """The present motion, with None for unknown values. World axes are east, north, up."""

    climb_m_s: float | None = None
    height_m: float | None = None  #: height above the place where the vehicle was last on the ground
    velocity_m_s: Vector | None = None  #: velocity in world axes
    position_m: Vector | None = None
    yaw_rad: float | None = None
    precise: bool = False  #: whether height and climb come from poses rather than a barometer


class MotionEstimate:
    """Stores the newest value from each source. External poses take precedence over GPS and barometer."""

    def __init__(self) -> None:
        self._pose: ExternalPose | None = None
        self._filter = VelocityFilter()
        self._altitude: tuple[Altitude, int] | None = None
        self._gps: tuple[Gps, int] | None = None
        self._origin: Gps | None = None
        self._heading_rad: float | None = None  # heading as a yaw angle, counter-clockwise from east
        self._turned_rad: float | None = None  # difference between the poses' yaw and this heading
        self._ground: dict[str, float] = {}  # height reported by each source where the vehicle was last on the ground
        self._stood = 0  # number of samples of the ground's height
        self.satellites: int | None = None

    @property
    def origin(self) -> EarthOrigin | None:
        """The position on Earth of the world axes' origin; None without GPS, or if poses define the axes."""
        if self._origin is None or self._pose is not None:
            return None
        first = self._origin
        return EarthOrigin(first.latitude_deg, first.longitude_deg, first.altitude_m, EARTH_RADIUS_M)

    def on_pose(self, pose: ExternalPose) -> None:
        self._filter.update(pose.position_m, pose.captured_ns)
        if self._pose is None or pose.captured_ns > self._pose.captured_ns:
            self._pose = pose
            if self._heading_rad is not None:
                self._turned_rad = wrap_angle(_yaw(pose) - self._heading_rad)

    def on_attitude(self, attitude: MspAttitude) -> None:
        self._heading_rad = wrap_angle(math.pi / 2 - math.radians(attitude.heading_deg))

    def on_altitude(self, altitude: Altitude, now_ns: int) -> None:
        self._altitude = altitude, now_ns

    def on_gps(self, gps: Gps, now_ns: int) -> None:
        """Handle a GPS report, with or without a fix."""
        self.satellites = gps.satellites
        if gps.fix and gps.satellites >= LEAST_SATELLITES:
            self._gps = gps, now_ns
            if self._origin is None:
                self._origin = gps

    def lost(self) -> None:
        """Discard the flight controller's reports because the link is lost."""
        self._altitude = self._gps = None

    def stands(self, *, does: bool) -> None:
        """Learn the ground's height while at rest; the error of a single sample may exceed the height of a lift-off."""
        self._stood = min(GROUND_SAMPLES, self._stood + 1) if does else 0
        if does and self._pose is not None:
            self._learn("pose", self._pose.position_m[2])
        if does and self._altitude is not None:
            self._learn("altitude", self._altitude[0].height_m)

    def _learn(self, source: str, height_m: float) -> None:
        before_m = self._ground.get(source, height_m)
        self._ground[source] = before_m + (height_m - before_m) / self._stood

    def at(self, now_ns: int) -> MspMotion:
        yaw = self._heading_rad
        if yaw is not None and self._turned_rad is not None:
            yaw = wrap_angle(yaw + self._turned_rad)
        pose = self._pose
        velocity = self._filter.velocity
        if pose is not None and velocity is not None and now_ns - pose.captured_ns <= POSE_NS:
            return MspMotion(
                climb_m_s=velocity[2],
                height_m=pose.position_m[2] - self._ground.get("pose", 0.0),
                velocity_m_s=velocity,
                position_m=pose.position_m,
                yaw_rad=_yaw(pose),
                precise=True,
            )
        return self._by_itself(now_ns, yaw)

    def _by_itself(self, now_ns: int, yaw: float | None) -> MspMotion:
        climb = height = None
        if self._altitude is not None and now_ns - self._altitude[1] <= ALTITUDE_NS:
            climb = self._altitude[0].climb_m_s
            height = self._altitude[0].height_m - self._ground.get("altitude", 0.0)
        velocity = position = None
        origin = self.origin
        if self._gps is not None and origin is not None and now_ns - self._gps[1] <= GPS_NS:
            gps = self._gps[0]
            course = math.radians(gps.course_deg)
            velocity = gps.speed_m_s * math.sin(course), gps.speed_m_s * math.cos(course), climb or 0.0
            east, north, up = origin.position_of(gps.latitude_deg, gps.longitude_deg, gps.altitude_m)
            position = east, north, up if height is None else height
        return MspMotion(climb, height, velocity, position, yaw)


def _yaw(pose: ExternalPose) -> float:
    x, y, z, w = pose.quaternion
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _plus(one: Vector, other: Vector) -> Vector:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _minus(one: Vector, other: Vector) -> Vector:
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


def _scaled(vector: Vector, by: float) -> Vector:
    return vector[0] * by, vector[1] * by, vector[2] * by


@dataclass(slots=True)
class Reported:
    """The newest reply of each kind; None if not received yet."""

    attitude: MspAttitude | None = None
    altitude: Altitude | None = None
    status: MspStatus | None = None
    battery: Battery | None = None
    cells: CellVoltages = field(default_factory=CellVoltages)


def charge_left(battery: Battery, cells: CellVoltages) -> float | None:
    """Return the remaining charge, 0 to 1, as reported or estimated from the cell voltage; None if unknown."""
    if battery.left is not None:
        return battery.left
    if battery.cells <= 0 or battery.voltage_v <= 0 or cells.full_v <= cells.empty_v:
        return None
    share = (battery.voltage_v / battery.cells - cells.empty_v) / (cells.full_v - cells.empty_v)
    return max(0.0, min(1.0, share))


def feedback_of(
    reported: Reported, motion: MspMotion, flight: FlightState, captured_ns: int, native: dict[str, Value]
) -> Feedback:
    """Return the vehicle's state as feedback. Unknown values are None."""
    attitude, battery = reported.attitude, reported.battery
    velocity = None
    if motion.velocity_m_s is not None and motion.yaw_rad is not None:
        east, north, up = motion.velocity_m_s
        cos, sin = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
        velocity = cos * east + sin * north, cos * north - sin * east, up
    return Feedback(
        captured_ns=captured_ns,
        state=flight,
        battery=None if battery is None else charge_left(battery, reported.cells),
        battery_v=None if battery is None or battery.voltage_v <= 0 else battery.voltage_v,
        roll_rad=None if attitude is None else math.radians(attitude.roll_deg),
        pitch_rad=None if attitude is None else math.radians(attitude.pitch_deg),
        yaw_rad=motion.yaw_rad,
        altitude_m=motion.height_m,
        velocity_m_s=velocity,
        position_m=motion.position_m,
        native=native,
    )
