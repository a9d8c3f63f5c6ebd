"""Payloads of MSP's functions in both directions. Pure.

All numbers are little-endian. A payload longer than expected comes from newer firmware, and the excess is ignored; a
payload that is too short raises :class:`skyloop.errors.DecodeError`. The layouts come from Betaflight's and INAV's
wikis on MSP and were checked with Betaflight 4.6.0.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Self

from skyloop.errors import DecodeError
from skyloop.messages.geometry import in_16_bits


class Function(IntEnum):
    """Numbers of the MSP functions that Skyloop uses."""

    API_VERSION = 1
    FC_VARIANT = 2
    FC_VERSION = 3
    BOARD_INFO = 4
    BATTERY_CONFIG = 32
    MODE_RANGES = 34
    SET_MODE_RANGE = 35
    FEATURE_CONFIG = 36
    RX_CONFIG = 44
    RX_MAP = 64
    FAILSAFE_CONFIG = 75
    RXFAIL_CONFIG = 77
    PID_ADVANCED = 94
    STATUS = 101
    RAW_IMU = 102
    RC = 105
    RAW_GPS = 106
    ATTITUDE = 108
    ALTITUDE = 109
    ANALOG = 110
    RC_TUNING = 111
    BOXNAMES = 116
    BOXIDS = 119
    BATTERY_STATE = 130
    STATUS_EX = 150
    SET_RAW_RC = 200
    MULTIPLE = 230
    COMMON_SETTING = 0x1003
    INAV_STATUS = 0x2000
    INAV_ANALOG = 0x2002


# Layouts of payloads, or of the parts of them that every version has.
_STATUS: Final = struct.Struct("<HHHIBHBB")
_INAV_STATUS: Final = struct.Struct("<HHHHBI")
_ATTITUDE: Final = struct.Struct("<hhh")
_ALTITUDE: Final = struct.Struct("<ih")
_BATTERY: Final = struct.Struct("<BHBHhB")
_ANALOG: Final = struct.Struct("<BHHh")
_INAV_ANALOG: Final = struct.Struct("<BHhIIIIB")
_GPS: Final = struct.Struct("<BBiihHH")
_IMU: Final = struct.Struct("<9h")
_FAILSAFE: Final = struct.Struct("<BBHBHB")
_RX: Final = struct.Struct("<BHHHBHH")


def _unpack(form: struct.Struct, payload: bytes, what: str) -> tuple[int, ...]:
    if len(payload) < form.size:
        raise DecodeError(f"{what} of {len(payload)} bytes: at least {form.size} expected")
    return form.unpack_from(payload)


# Identity ------------------------------------------------------------------------------------------------------------

BETAFLIGHT: Final = "BTFL"
INAV: Final = "INAV"


@dataclass(frozen=True, slots=True)
class MspIdentity:
    """A flight controller's identity."""

    variant: str = ""  #: four letters, such as :data:`BETAFLIGHT`
    version: tuple[int, int, int] = (0, 0, 0)
    api: tuple[int, int] = (0, 0)
    board: str = ""

    def __str__(self) -> str:
        names = {BETAFLIGHT: "Betaflight", INAV: "INAV"}
        major, minor, patch = self.version
        board = f" on {self.board}" if self.board else ""
        return f"{names.get(self.variant, self.variant)} {major}.{minor}.{patch}{board}"


def api_version(payload: bytes) -> tuple[int, int]:
    """Return the API version, major and minor."""
    _, major, minor = _unpack(struct.Struct("<BBB"), payload, "API_VERSION")
    return major, minor


def version(payload: bytes) -> tuple[int, int, int]:
    major, minor, patch = _unpack(struct.Struct("<BBB"), payload, "FC_VERSION")
    return major, minor, patch


def text(payload: bytes, longest: int = 64) -> str:
    """Return the printable ASCII characters, leaving out all others."""
    return "".join(chr(byte) for byte in payload[:longest] if 32 <= byte < 127)


def board(payload: bytes) -> str:
    """Return the board's name: its target's name if it has a target, otherwise its four-letter identifier."""
    if len(payload) < 4:
        raise DecodeError(f"BOARD_INFO of {len(payload)} bytes: at least 4 expected")
    if len(payload) > 9:
        name = text(payload[9 : 9 + payload[8]])
        if name:
            return name
    return text(payload[:4])


# State ---------------------------------------------------------------------------------------------------------------


class Sensor(IntEnum):
    """Bits of :attr:`MspStatus.sensors`."""

    ACCELEROMETER = 0
    BAROMETER = 1
    MAGNETOMETER = 2
    GPS = 3
    RANGEFINDER = 4


@dataclass(frozen=True, slots=True)
class MspStatus:
    """Active sensors and modes, and the flags that prevent arming."""

    sensors: int  #: bits of :class:`Sensor`
    modes: int  #: one bit per active mode, in the order of ``BOXIDS``
    flags: int | None = None  #: one bit per flag that prevents arming; None if the reply does not contain them
    count: int = 0  #: number of flags in this version; 0 if unknown
    cycle_us: int = 0  #: duration of one control loop [µs]
    load: int = 0  #: processor load [%]

    def has(self, sensor: Sensor) -> bool:
        return bool(self.sensors >> sensor & 1)

    @classmethod
    def of_betaflight(cls, payload: bytes) -> Self:
        """Read Betaflight's ``STATUS`` or ``STATUS_EX``, API 1.36 and later. Raises :class:`DecodeError`."""
        cycle, _, sensors, modes, _, load, _, _ = _unpack(_STATUS, payload, "STATUS")
        if len(payload) <= _STATUS.size:
            return cls(sensors, modes, None, 0, cycle, load)
        more = payload[_STATUS.size] & 15
        at = _STATUS.size + 1
        modes |= int.from_bytes(payload[at : at + more], "little") << 32
        at += more
        if len(payload) < at + 5:
            return cls(sensors, modes, None, 0, cycle, load)
        return cls(sensors, modes, int.from_bytes(payload[at + 1 : at + 5], "little"), payload[at], cycle, load)

    @classmethod
    def of_inav(cls, payload: bytes) -> Self:
        """Read ``INAV_STATUS``. Raises :class:`DecodeError`."""
        cycle, _, sensors, load, _, flags = _unpack(_INAV_STATUS, payload, "INAV_STATUS")
        rest = payload[_INAV_STATUS.size : _INAV_STATUS.size + 16]
        if len(rest) % 4 == 1:  # the byte after the modes is the mixer profile
            rest = rest[:-1]
        return cls(sensors, int.from_bytes(rest, "little"), flags, 32, cycle, load)

    def betaflight(self) -> bytes:
        """Return the payload for Betaflight's ``STATUS_EX``."""
        low, more = self.modes & 0xFFFFFFFF, self.modes >> 32
        size = (more.bit_length() + 7) // 8
        made = _STATUS.pack(self.cycle_us, 0, self.sensors, low, 0, self.load, 4, 0)
        made += bytes((size,)) + more.to_bytes(size, "little")
        return made + struct.pack("<BIBHB", self.count, self.flags or 0, 0, 0, 4)


@dataclass(frozen=True, slots=True)
class MspAttitude:
    """Roll (positive right side down), pitch (positive nose down) and heading (clockwise from north) [degrees]."""

    roll_deg: float
    pitch_deg: float
    heading_deg: float

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        roll, pitch, heading = _unpack(_ATTITUDE, payload, "ATTITUDE")
        return cls(roll / 10, pitch / 10, float(heading))

    def encode(self) -> bytes:
        return _ATTITUDE.pack(round(self.roll_deg * 10), round(self.pitch_deg * 10), round(self.heading_deg) % 360)


@dataclass(frozen=True, slots=True)
class Altitude:
    """Height above the place where the vehicle was armed [m], and climb [m/s]."""

    height_m: float
    climb_m_s: float

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        height, climb = _unpack(_ALTITUDE, payload, "ALTITUDE")
        return cls(height / 100, climb / 100)

    def encode(self) -> bytes:
        return _ALTITUDE.pack(round(self.height_m * 100), in_16_bits(self.climb_m_s * 100))


@dataclass(frozen=True, slots=True)
class Battery:
    """The battery's state."""

    voltage_v: float
    current_a: float
    cells: int = 0  #: number of cells; 0 if unknown
    left: float | None = None  #: remaining charge, 0 to 1; None if not reported

    @classmethod
    def of_state(cls, payload: bytes) -> Self:
        """Read Betaflight's ``BATTERY_STATE``."""
        cells, _, tenths, _, current, _ = _unpack(_BATTERY, payload, "BATTERY_STATE")
        whole = payload[_BATTERY.size : _BATTERY.size + 2]
        return cls(int.from_bytes(whole, "little") / 100 if len(whole) == 2 else tenths / 10, current / 100, cells)

    @classmethod
    def of_inav(cls, payload: bytes) -> Self:
        """Read ``INAV_ANALOG``."""
        flags, volts, current, _, _, _, _, percent = _unpack(_INAV_ANALOG, payload, "INAV_ANALOG")
        return cls(volts / 100, current / 100, flags >> 4, min(percent, 100) / 100)

    @classmethod
    def of_analog(cls, payload: bytes) -> Self:
        """Read ``ANALOG``."""
        tenths, _, _, current = _unpack(_ANALOG, payload, "ANALOG")
        whole = payload[_ANALOG.size : _ANALOG.size + 2]
        return cls(int.from_bytes(whole, "little") / 100 if len(whole) == 2 else tenths / 10, current / 100)

    def state(self) -> bytes:
        """Return the payload for ``BATTERY_STATE``."""
        tenths = min(255, round(self.voltage_v * 10))
        made = _BATTERY.pack(self.cells, 0, tenths, 0, in_16_bits(self.current_a * 100), 0)
        return made + struct.pack("<H", round(self.voltage_v * 100))

    def analog(self) -> bytes:
        """Return the payload for ``ANALOG``."""
        made = _ANALOG.pack(min(255, round(self.voltage_v * 10)), 0, 0, in_16_bits(self.current_a * 100))
        return made + struct.pack("<H", round(self.voltage_v * 100))


@dataclass(frozen=True, slots=True)
class CellVoltages:
    """Voltages of an empty and a full cell [V]."""

    empty_v: float = 3.3
    full_v: float = 4.2

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        low, high = _unpack(struct.Struct("<BB"), payload, "BATTERY_CONFIG")
        return cls(low / 10, high / 10)


@dataclass(frozen=True, slots=True)
class Gps:
    """A GPS fix. Angles are in degrees; ``speed_m_s`` is over ground towards ``course_deg``, clockwise from north."""

    fix: bool
    satellites: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    speed_m_s: float
    course_deg: float

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        fix, satellites, latitude, longitude, altitude, speed, course = _unpack(_GPS, payload, "RAW_GPS")
        return cls(bool(fix), satellites, latitude / 1e7, longitude / 1e7, altitude, speed / 100, course / 10)

    def encode(self) -> bytes:
        place = round(self.latitude_deg * 1e7), round(self.longitude_deg * 1e7), round(self.altitude_m)
        speed, course = round(self.speed_m_s * 100), round(self.course_deg * 10) % 3600
        return _GPS.pack(int(self.fix) * 2, self.satellites, *place, speed, course)


@dataclass(frozen=True, slots=True)
class Imu:
    """Raw sensor values. Only the gyroscope's readings have the same unit on every board: degrees per second."""

    acceleration: tuple[int, int, int]
    gyro_deg_s: tuple[int, int, int]
    magnetic: tuple[int, int, int]

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        a, b, c, d, e, f, g, h, i = _unpack(_IMU, payload, "RAW_IMU")
        return cls((a, b, c), (d, e, f), (g, h, i))

    def encode(self) -> bytes:
        return _IMU.pack(*self.acceleration, *self.gyro_deg_s, *self.magnetic)


# Sticks --------------------------------------------------------------------------------------------------------------


def channels(payload: bytes) -> list[int]:
    """Return pulse widths [µs] from ``RC``, in the order roll, pitch, yaw, throttle, AUX 1 and so on."""
    return [value for (value,) in struct.iter_unpack("<H", payload[: len(payload) // 2 * 2])]


def pack_channels(widths_us: Sequence[int]) -> bytes:
    """Return the payload for ``SET_RAW_RC``, or for the reply ``RC``."""
    return struct.pack(f"<{len(widths_us)}H", *widths_us)


def multiple(payload: bytes, functions: Sequence[int]) -> list[tuple[int, bytes]]:
    """Return the replies in ``MULTIPLE`` to the requested functions, except for those that did not fit in it."""
    found = []
    at = 0
    for function in functions:
        if at >= len(payload) or at + 1 + payload[at] > len(payload):
            break
        found.append((function, payload[at + 1 : at + 1 + payload[at]]))
        at += 1 + payload[at]
    return found


# Settings ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ModeRange:
    """The range of an AUX channel that activates a mode."""

    mode: int  #: the mode's permanent number
    aux: int  #: the channel, 0 for AUX 1
    low_us: int  #: lowest pulse width in the range [µs]
    high_us: int  #: first pulse width above the range [µs]; 2100 for no upper limit


def mode_ranges(payload: bytes) -> list[ModeRange]:
    """Return the non-empty ranges in ``MODE_RANGES``."""
    found = []
    for mode, aux, low, high in struct.iter_unpack("<BBBB", payload[: len(payload) // 4 * 4]):
        if low < high:
            found.append(ModeRange(mode, aux, 900 + 25 * low, 900 + 25 * high))
    return found


def pack_mode_ranges(ranges: Sequence[ModeRange], places: int = 20) -> bytes:
    """Return the payload for ``MODE_RANGES``."""
    made = b"".join(
        bytes((each.mode, each.aux, (each.low_us - 900) // 25, (each.high_us - 900) // 25)) for each in ranges
    )
    return made.ljust(4 * places, b"\0")


def box_names(payload: bytes) -> list[str]:
    """Return the names in ``BOXNAMES``, in the order of the bits in :attr:`MspStatus.modes`."""
    return [name for name in text(payload, len(payload)).split(";") if name]


@dataclass(frozen=True, slots=True)
class FailsafeConfig:
    """How the firmware reacts to the loss of its receiver."""

    delay_s: float  #: time until the failsafe starts [s]
    landing_s: float  #: duration of a landing, or how long the motors keep running [s]
    throttle_us: int  #: throttle during a landing [µs]
    low_throttle_s: float  #: time with a low throttle after which the vehicle disarms immediately [s]
    procedure: int  #: Betaflight: 0 land, 1 drop, 2 GPS rescue; INAV: 0 land, 1 drop, 2 return, 3 nothing

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        delay, landing, throttle, _, low, procedure = _unpack(_FAILSAFE, payload, "FAILSAFE_CONFIG")
        return cls(delay / 10, float(landing), throttle, low / 10, procedure)

    def encode(self) -> bytes:
        delay, low = round(self.delay_s * 10), round(self.low_throttle_s * 10)
        return _FAILSAFE.pack(delay, round(self.landing_s), self.throttle_us, 0, low, self.procedure)


class OnLoss(IntEnum):
    """The value that a channel takes 0.3 s after the receiver is lost."""

    AUTO = 0  #: centred sticks and no throttle
    HOLD = 1
    SET = 2


def rx_fail(payload: bytes) -> list[tuple[int, int]]:
    """Return the :class:`OnLoss` value and pulse width [µs] of each channel in ``RXFAIL_CONFIG``."""
    return list(struct.iter_unpack("<BH", payload[: len(payload) // 3 * 3]))


def pack_rx_fail(channels: Sequence[tuple[int, int]]) -> bytes:
    """Return the payload for ``RXFAIL_CONFIG``."""
    return b"".join(struct.pack("<BH", mode, width) for mode, width in channels)


@dataclass(frozen=True, slots=True)
class RxConfig:
    """Pulse widths [µs]. The throttle is low below ``low_us``; a channel outside the valid range has failed."""

    low_us: int = 1050
    middle_us: int = 1500
    high_us: int = 1900
    least_us: int = 885
    most_us: int = 2115

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        _, high, middle, low, _, least, most = _unpack(_RX, payload, "RX_CONFIG")
        return cls(low, middle, high, least, most)

    def encode(self) -> bytes:
        return _RX.pack(0, self.high_us, self.middle_us, self.low_us, 0, self.least_us, self.most_us)


RX_MSP: Final = 1 << 14  #: bit in Betaflight's features: sticks are received over MSP
USUAL_MAP: Final = (0, 1, 3, 2)  #: positions of roll, pitch, yaw and throttle in ``SET_RAW_RC`` (AETR)


def rx_map(payload: bytes) -> tuple[int, ...]:
    """Return the positions of roll, pitch, yaw and throttle in ``SET_RAW_RC``. Raises :class:`DecodeError`."""
    made = tuple(payload[:4])
    if sorted(made) != [0, 1, 2, 3]:
        raise DecodeError(f"RX_MAP {payload[:8].hex()} does not contain the sticks")
    return made


def features(payload: bytes) -> int:
    """Return the bits in ``FEATURE_CONFIG``."""
    (bits,) = _unpack(struct.Struct("<I"), payload, "FEATURE_CONFIG")
    return bits


ANGLE_LIMIT_AT: Final = 17  #: offset of the limit in ``PID_ADVANCED``


def angle_limit_deg(payload: bytes) -> int:
    """Return the tilt at full stick [degrees] from Betaflight's ``PID_ADVANCED``."""
    if len(payload) <= ANGLE_LIMIT_AT:
        raise DecodeError(f"PID_ADVANCED of {len(payload)} bytes: at least {ANGLE_LIMIT_AT + 1} expected")
    if payload[ANGLE_LIMIT_AT] == 0:
        raise DecodeError("PID_ADVANCED has no angle limit")
    return payload[ANGLE_LIMIT_AT]
