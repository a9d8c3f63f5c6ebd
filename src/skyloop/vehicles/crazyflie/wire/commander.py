"""Set-points, flights of the high-level commander, external poses, and what stops or arms the motors, both ways. Pure.

Positions are in metres in the world axes of the vehicle's estimate (x forward at the start, y left, z up). Numbers stay
in the protocol's units, whose names end in their fields: angles and rates of set-points in degrees, those of the
high-level commander in radians. **Yaw rates are counter-clockwise in all messages here**: before protocol 9 the vehicle
counts them the other way round, and :meth:`Message.encode` and :func:`decode_message` turn them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace
from enum import IntEnum
from typing import ClassVar, Final

from skyloop.errors import DecodeError
from skyloop.vehicles.crazyflie.wire.crtp import (
    COMMAND,
    GENERIC,
    INFO,
    META,
    NEWEST_PROTOCOL,
    PLATFORM_COMMAND,
    POSITION,
    SET,
    VERSION,
    CrtpPacket,
    CrtpPort,
)


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a message goes, its number on that channel (None: no number), and its fields."""

    port: CrtpPort
    channel: int
    number: int | None
    form: str
    since: int = 0  #: first protocol version with this layout
    clockwise: bool = False  #: whether yaw rates are clockwise in this layout
    without: tuple[str, ...] = ()  #: names of fields that this layout lacks


@dataclass(frozen=True, slots=True)
class Message:
    """Base of all messages to the vehicle."""

    LAYOUTS: ClassVar[tuple[Layout, ...]]  #: the newest first

    def encode(self, protocol: int = NEWEST_PROTOCOL) -> CrtpPacket:
        """Return the packet in the newest layout that a vehicle of this protocol version reads."""
        layout = next(known for known in self.LAYOUTS if known.since <= protocol)
        message = _turned(self) if layout.clockwise else self
        names = [field.name for field in fields(message) if field.name not in layout.without]
        head = b"" if layout.number is None else bytes((layout.number,))
        data = struct.pack("<" + layout.form, *(getattr(message, name) for name in names))
        return CrtpPacket(layout.port, layout.channel, head + data)


def _turned(message: Message) -> Message:
    return replace(message, yaw_rate_deg_s=-getattr(message, "yaw_rate_deg_s"))  # type: ignore[call-arg]  # noqa: B009


# Low-level set-points: the vehicle levels 0.5 s after the last one, and cuts its motors 2 s after it -----------------


def _set(number: int, form: str, since: int = 0, *, clockwise: bool = False) -> Layout:
    return Layout(CrtpPort.SETPOINT, SET, number, form, since, clockwise)


@dataclass(frozen=True, slots=True)
class RollPitchThrust(Message):
    """The oldest set-point. Pitch is positive with the nose up, thrust from 0 to 65535."""

    roll_deg: float
    pitch_deg: float
    yaw_rate_deg_s: float
    thrust: int
    LAYOUTS = (Layout(CrtpPort.COMMANDER, 0, None, "fffH", clockwise=True),)


@dataclass(frozen=True, slots=True)
class StopSetpoint(Message):
    """Motors off, until another set-point: the vehicle falls."""

    LAYOUTS = (_set(0, ""),)


@dataclass(frozen=True, slots=True)
class VelocityWorldSetpoint(Message):
    vx_m_s: float
    vy_m_s: float
    vz_m_s: float
    yaw_rate_deg_s: float
    LAYOUTS = (_set(8, "4f", since=9), _set(1, "4f", clockwise=True))


@dataclass(frozen=True, slots=True)
class ZDistanceSetpoint(Message):
    """An attitude and a height."""

    roll_deg: float
    pitch_deg: float
    yaw_rate_deg_s: float
    z_m: float
    LAYOUTS = (_set(9, "4f", since=9), _set(2, "4f", clockwise=True))


@dataclass(frozen=True, slots=True)
class AltitudeHoldSetpoint(Message):
    """An attitude and a climb rate."""

    roll_deg: float
    pitch_deg: float
    yaw_rate_deg_s: float
    climb_m_s: float
    LAYOUTS = (_set(4, "4f", clockwise=True),)


@dataclass(frozen=True, slots=True)
class HoverSetpoint(Message):
    """A velocity along the levelled body axes forward and left, and a height."""

    vx_m_s: float
    vy_m_s: float
    yaw_rate_deg_s: float
    z_m: float
    LAYOUTS = (_set(10, "4f", since=9), _set(5, "4f", clockwise=True))


@dataclass(frozen=True, slots=True)
class FullStateSetpoint(Message):
    """Position [mm], velocity [mm/s], acceleration [mm/s²], compressed quaternion, body rates [mrad/s]."""

    x_mm: int
    y_mm: int
    z_mm: int
    vx_mm_s: int
    vy_mm_s: int
    vz_mm_s: int
    ax_mm_s2: int
    ay_mm_s2: int
    az_mm_s2: int
    quaternion: int  #: see :func:`compressed`
    roll_rate_mrad_s: int
    pitch_rate_mrad_s: int
    yaw_rate_mrad_s: int
    LAYOUTS = (_set(6, "9hI3h"),)


@dataclass(frozen=True, slots=True)
class PositionSetpoint(Message):
    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    LAYOUTS = (_set(7, "4f"),)


@dataclass(frozen=True, slots=True)
class NotifySetpointsStop(Message):
    """No more low-level set-points follow: the high-level commander, which they disable, may fly again."""

    remain_valid_ms: int = 0
    LAYOUTS = (Layout(CrtpPort.SETPOINT, META, 0, "I"),)


# The high-level commander, which flies on without its client ---------------------------------------------------------


def _fly(number: int, form: str, since: int = 0, without: tuple[str, ...] = ()) -> Layout:
    return Layout(CrtpPort.HIGH_LEVEL, 0, number, form, since, without=without)


@dataclass(frozen=True, slots=True)
class SetGroupMask(Message):
    mask: int
    LAYOUTS = (_fly(0, "B"),)


@dataclass(frozen=True, slots=True)
class HighLevelStop(Message):
    """Motors off: the vehicle falls. ``groups`` is 0 for all vehicles, here and below."""

    groups: int = 0
    LAYOUTS = (_fly(3, "B"),)


@dataclass(frozen=True, slots=True)
class HighLevelTakeoff(Message):
    groups: int
    z_m: float
    yaw_rad: float
    keep_yaw: bool
    duration_s: float
    LAYOUTS = (_fly(7, "Bff?f"),)


@dataclass(frozen=True, slots=True)
class HighLevelLand(Message):
    groups: int
    z_m: float
    yaw_rad: float
    keep_yaw: bool
    duration_s: float
    LAYOUTS = (_fly(8, "Bff?f"),)


@dataclass(frozen=True, slots=True)
class GoTo(Message):
    """Fly to a place within a time, and hover there; ``linear`` since protocol 8, otherwise along a smooth curve."""

    groups: int
    relative: bool
    linear: bool
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    duration_s: float
    LAYOUTS = (_fly(12, "B??5f", since=8), _fly(4, "B?5f", without=("linear",)))


@dataclass(frozen=True, slots=True)
class Spiral(Message):
    """Since protocol 8."""

    groups: int
    sideways: bool
    clockwise: bool
    angle_rad: float
    start_radius_m: float
    end_radius_m: float
    ascent_m: float
    duration_s: float
    LAYOUTS = (_fly(11, "B??5f"),)


@dataclass(frozen=True, slots=True)
class StartTrajectory(Message):
    """Fly an uploaded trajectory; ``relative_yaw`` since protocol 10."""

    groups: int
    relative: bool
    relative_yaw: bool
    reversed: bool
    trajectory: int
    time_scale: float
    LAYOUTS = (_fly(13, "B???Bf", since=10), _fly(5, "B??Bf", without=("relative_yaw",)))


@dataclass(frozen=True, slots=True)
class DefineTrajectory(Message):
    """Where in the memory for trajectories the pieces of one are; ``kind`` 0: polynomials, 1: compressed."""

    trajectory: int
    location: int  #: 1: the memory for trajectories
    kind: int
    offset: int
    pieces: int
    LAYOUTS = (_fly(6, "BBBIB"),)


# Positions from outside ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ExternalPosition(Message):
    x_m: float
    y_m: float
    z_m: float
    LAYOUTS = (Layout(CrtpPort.LOCALISATION, POSITION, None, "3f"),)


@dataclass(frozen=True, slots=True)
class ExternalPoseMessage(Message):
    x_m: float
    y_m: float
    z_m: float
    qx: float
    qy: float
    qz: float
    qw: float
    LAYOUTS = (Layout(CrtpPort.LOCALISATION, GENERIC, 8, "7f"),)


_PACKED_POSES: Final = 9
_PACKED_FORM: Final = struct.Struct("<B3hI")
MOST_PACKED: Final = 2  #: poses in one packet


def packed_poses(poses: Sequence[tuple[int, Sequence[float], Sequence[float]]]) -> CrtpPacket:
    """Return a broadcast with up to :data:`MOST_PACKED` poses: the vehicle's number, position [m], quaternion x…w.

    The number is the last byte of the vehicle's radio address. Positions are limited to ±32.767 m.
    """
    data = bytes((_PACKED_POSES,))
    for number, position, quaternion in poses[:MOST_PACKED]:
        mm = (max(-32767, min(32767, round(1000 * part))) for part in position)
        data += _PACKED_FORM.pack(number, *mm, compressed(quaternion))
    return CrtpPacket(CrtpPort.LOCALISATION, GENERIC, data)


def decode_packed_poses(packet: CrtpPacket) -> list[tuple[int, tuple[float, ...], tuple[float, ...]]]:
    """Return the poses of a broadcast; none if the packet is something else. Raises :class:`DecodeError`."""
    if (packet.port, packet.channel) != (CrtpPort.LOCALISATION, GENERIC) or packet.data[:1] != bytes((_PACKED_POSES,)):
        return []
    try:
        rows = list(_PACKED_FORM.iter_unpack(packet.data[1:]))
    except struct.error:
        raise DecodeError("a packet of poses is damaged") from None
    return [(number, (x / 1000, y / 1000, z / 1000), decompressed(packed)) for number, x, y, z, packed in rows]


_SMALLEST: Final = (1 << 9) - 1  # greatest number for a component, which is at most √½


def compressed(quaternion: Sequence[float]) -> int:
    """Return a unit quaternion x, y, z, w in 32 bits: the index of its greatest component, and the three others.

    Each of these is a sign and 9 bits. The greatest one is made positive, and follows from the others.
    """
    greatest = max(range(4), key=lambda i: abs(quaternion[i]))
    negative = quaternion[greatest] < 0
    packed = greatest
    for i in range(4):
        if i != greatest:
            size = min(_SMALLEST, int(_SMALLEST * abs(quaternion[i]) * math.sqrt(2) + 0.5))
            packed = packed << 10 | ((quaternion[i] < 0) != negative) << 9 | size
    return packed


def decompressed(packed: int) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of :func:`compressed`."""
    greatest = packed >> 30 & 3
    parts = [0.0] * 4
    for i in reversed([i for i in range(4) if i != greatest]):
        size = (packed & _SMALLEST) / _SMALLEST / math.sqrt(2)
        parts[i] = -size if packed >> 9 & 1 else size
        packed >>= 10
    parts[greatest] = math.sqrt(max(0.0, 1.0 - sum(part * part for part in parts)))
    return parts[0], parts[1], parts[2], parts[3]


# Motors and supervisor -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EmergencyStopMessage(Message):
    """Motors off, until the vehicle is restarted."""

    LAYOUTS = (
        Layout(CrtpPort.SUPERVISOR, COMMAND, 3, "", since=12),
        Layout(CrtpPort.LOCALISATION, GENERIC, 3, ""),
    )


@dataclass(frozen=True, slots=True)
class EmergencyWatchdog(Message):
    """From the first of these on, the vehicle stops its motors when none arrives for a second."""

    LAYOUTS = (
        Layout(CrtpPort.SUPERVISOR, COMMAND, 4, "", since=12),
        Layout(CrtpPort.LOCALISATION, GENERIC, 4, ""),
    )


@dataclass(frozen=True, slots=True)
class Arm(Message):
    arm: bool
    LAYOUTS = (
        Layout(CrtpPort.SUPERVISOR, COMMAND, 1, "?", since=12),
        Layout(CrtpPort.PLATFORM, PLATFORM_COMMAND, 1, "?"),
    )


@dataclass(frozen=True, slots=True)
class Recover(Message):
    """Leave the state "crashed", with the vehicle level on the ground."""

    LAYOUTS = (
        Layout(CrtpPort.SUPERVISOR, COMMAND, 2, "", since=12),
        Layout(CrtpPort.PLATFORM, PLATFORM_COMMAND, 2, ""),
    )


class Supervisor(IntEnum):
    """Bits of the log variable ``supervisor.info`` and of the supervisor's answer."""

    CAN_BE_ARMED = 0x001
    IS_ARMED = 0x002
    IS_AUTO_ARMED = 0x004
    CAN_FLY = 0x008
    IS_FLYING = 0x010
    IS_TUMBLED = 0x020
    IS_LOCKED = 0x040
    IS_CRASHED = 0x080
    HIGH_LEVEL_ACTIVE = 0x100
    TRAJECTORY_FINISHED = 0x200
    HIGH_LEVEL_DISABLED = 0x400


GET_BITFIELD: Final = 0x0C  #: request for all bits, on SUPERVISOR's channel INFO
_ANSWER: Final = 0x80


def ask_supervisor(command: int = GET_BITFIELD) -> CrtpPacket:
    """Return the request for all bits, or for bit ``command`` - 1 alone. Since protocol 12."""
    return CrtpPacket(CrtpPort.SUPERVISOR, INFO, bytes((command,)))


def answer_supervisor(command: int, bits: int) -> CrtpPacket:
    """Return the answer to :func:`ask_supervisor` from all bits."""
    value = struct.pack("<H", bits) if command == GET_BITFIELD else bytes((bits >> (command - 1) & 1,))
    return CrtpPacket(CrtpPort.SUPERVISOR, INFO, bytes((command | _ANSWER,)) + value)


def decode_supervisor_answer(packet: CrtpPacket) -> int | None:
    """Return all bits; None if the answer has only one. Raises :class:`DecodeError`."""
    if packet.data[:1] != bytes((GET_BITFIELD | _ANSWER,)):
        return None
    if len(packet.data) < 3:
        raise DecodeError("the supervisor's answer is too short")
    return int.from_bytes(packet.data[1:3], "little")


def answer_arm(request: CrtpPacket, *, success: bool, armed: bool) -> CrtpPacket:
    """Return the answer to :class:`Arm` or :class:`Recover`: whether it was done, and whether it is so now."""
    command = request.data[0] | (_ANSWER if request.port == CrtpPort.SUPERVISOR else 0)
    return CrtpPacket(request.port, request.channel, bytes((command, success, armed)))


# Versions -----------------------------------------------------------------------------------------------------------


class VersionQuery(IntEnum):
    """Requests on PLATFORM's channel VERSION."""

    PROTOCOL = 0
    FIRMWARE = 1
    DEVICE = 2


def ask_version(query: VersionQuery) -> CrtpPacket:
    return CrtpPacket(CrtpPort.PLATFORM, VERSION, bytes((query,)))


def answer_version(query: VersionQuery, value: int | str) -> CrtpPacket:
    content = bytes((value,)) if isinstance(value, int) else value.encode("ascii") + b"\0"
    return CrtpPacket(CrtpPort.PLATFORM, VERSION, bytes((query,)) + content)


def decode_version_answer(packet: CrtpPacket) -> tuple[VersionQuery, int, str]:
    """Return the query, the number (for PROTOCOL) and the text (for the others). Raises :class:`DecodeError`."""
    try:
        query = VersionQuery(packet.data[0])
        if query is VersionQuery.PROTOCOL:
            return query, packet.data[1], ""
    except (IndexError, ValueError):
        raise DecodeError("a version is damaged") from None
    return query, 0, packet.data[1:].split(b"\0")[0].decode("ascii", "replace")


# Reading messages, for the emulated firmware -------------------------------------------------------------------------

_MESSAGES: Final[tuple[type[Message], ...]] = (
    RollPitchThrust,
    StopSetpoint,
    VelocityWorldSetpoint,
    ZDistanceSetpoint,
    AltitudeHoldSetpoint,
    HoverSetpoint,
    FullStateSetpoint,
    PositionSetpoint,
    NotifySetpointsStop,
    SetGroupMask,
    HighLevelStop,
    HighLevelTakeoff,
    HighLevelLand,
    GoTo,
    Spiral,
    StartTrajectory,
    DefineTrajectory,
    ExternalPosition,
    ExternalPoseMessage,
    EmergencyStopMessage,
    EmergencyWatchdog,
    Arm,
    Recover,
)
_BY_NUMBER: Final[dict[tuple[int, int, int | None], tuple[type[Message], Layout]]] = {
    (layout.port, layout.channel, layout.number): (kind, layout) for kind in _MESSAGES for layout in kind.LAYOUTS
}


def decode_message(packet: CrtpPacket) -> Message | None:
    """Read a message in any of its layouts; None if the packet is none. Raises :class:`DecodeError` if it is damaged.

    Fields that an old layout lacks are false.
    """
    key = packet.port, packet.channel
    data = packet.data
    known = _BY_NUMBER.get((*key, None))
    if known is None and data:
        known = _BY_NUMBER.get((*key, data[0]))
        data = data[1:]
    if known is None:
        return None
    kind, layout = known
    try:
        values = iter(struct.unpack("<" + layout.form, data))
    except struct.error:
        raise DecodeError(
            f"a {kind.__name__} has {struct.calcsize('<' + layout.form)} bytes, not {len(data)}"
        ) from None
    arguments = [False if field.name in layout.without else next(values) for field in fields(kind)]
    message = kind(*arguments)
    return _turned(message) if layout.clockwise else message


def is_finite(message: Message) -> bool:
    """Whether all numbers of a message are finite in 32 bits: nothing else may reach a vehicle."""
    return all(abs(value) < 1e38 for value in astuple(message))
