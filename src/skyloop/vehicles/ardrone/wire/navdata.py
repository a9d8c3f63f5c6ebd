"""The AR.Drone's navdata (UDP port 5554): encode and decode datagrams of a header, options and a checksum. Pure.

Little-endian: ``u32 0x55667788, u32 state, u32 sequence, u32 vision defined``, then options, each with ``u16 tag,
u16 size`` (which includes these four bytes) and data. The last option is the checksum, the sum of all bytes before it.
Names, types and order of the options come from ``navdata_common.h`` in the AR.Drone SDK 2.0.1, whose structures are
packed without alignment; sizes were checked against a datagram from a real AR.Drone 2. Units are the drone's own:
millidegrees, mm/s, mm, mV. Firmware 2.4 sends ``Gps`` with the tag that ``Zimmu3000`` used before.
"""

from __future__ import annotations

import struct
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from itertools import accumulate
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar, cast

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.wire import at, configuration

PORT: Final = 5554  #: UDP
SIGNATURE: Final = 0x55667788
MAX_DATAGRAM: Final = 4096  #: bytes; a datagram with all known options is shorter
FIRST_SEQUENCE: Final = 1

_HEADER: Final = struct.Struct("<4I")
_OPTION: Final = struct.Struct("<HH")
_CHECKSUM: Final = struct.Struct("<HHI")
_CHECKSUM_TAG: Final = 0xFFFF
_Option = TypeVar("_Option", bound=tuple[Any, ...])


class State(IntFlag):
    """The drone's state bits, which are part of every datagram."""

    FLYING = 1 << 0
    VIDEO = 1 << 1
    VISION = 1 << 2
    ANGULAR_SPEED_CONTROL = 1 << 3
    ALTITUDE_CONTROL = 1 << 4
    START_BUTTON = 1 << 5
    COMMAND_ACK = 1 << 6
    CAMERA_READY = 1 << 7
    TRAVELLING = 1 << 8
    USB_KEY = 1 << 9
    DEMO = 1 << 10  #: sends only the demo mode's options, 15 times per second
    BOOTSTRAP = 1 << 11  #: sends no options until the mode is configured
    MOTORS_PROBLEM = 1 << 12
    COMMUNICATION_LOST = 1 << 13
    SOFTWARE_FAULT = 1 << 14
    BATTERY_LOW = 1 << 15
    USER_EMERGENCY = 1 << 16
    TIMER_ELAPSED = 1 << 17
    MAGNETOMETER_UNCALIBRATED = 1 << 18
    ANGLES_OUT_OF_RANGE = 1 << 19
    WIND = 1 << 20
    ULTRASOUND_DEAF = 1 << 21
    CUTOUT = 1 << 22
    PIC_VERSION_OK = 1 << 23
    AT_THREAD = 1 << 24
    NAVDATA_THREAD = 1 << 25
    VIDEO_THREAD = 1 << 26
    ACQUISITION_THREAD = 1 << 27
    CONTROL_WATCHDOG = 1 << 28
    ADC_WATCHDOG = 1 << 29
    COMMUNICATION_WATCHDOG = 1 << 30
    EMERGENCY = 1 << 31


class ControlState(IntEnum):
    """Values of the upper half of :attr:`Demo.ctrl_state`."""

    DEFAULT = 0
    INIT = 1
    LANDED = 2
    FLYING = 3
    HOVERING = 4
    TEST = 5
    TAKING_OFF = 6
    GOING_TO_FIX = 7
    LANDING = 8
    LOOPING = 9


# Options -------------------------------------------------------------------------------------------------------------

Floats: TypeAlias = tuple[float, ...]
Ints: TypeAlias = tuple[int, ...]
Option: TypeAlias = Any  #: one of the named tuples below


class OptionLayout:
    """The memory layout of an option: a struct format with one word per field (``3f`` is one field of three floats)."""

    def __init__(self, tag: int, kind: type[Any], words: list[str]) -> None:
        if len(words) != len(kind._fields):
            raise TypeError(f"{kind.__name__} has {len(kind._fields)} fields and a format for {len(words)}")
        self.tag = tag
        self.kind = kind
        self._struct = struct.Struct("<" + "".join(words))
        counts = list(map(_count, words))
        begins = accumulate(counts, initial=0)
        self._cuts = [slice(at, at + count) if count > 1 else at for at, count in zip(begins, counts, strict=False)]
        self._plain = max(counts) == 1

    @property
    def size(self) -> int:
        return self._struct.size

    def unpack(self, data: bytes | memoryview, at: int) -> Any:
        """Return the structure that begins at offset ``at``."""
        values = self._struct.unpack_from(data, at)
        return self.kind(*values) if self._plain else self.kind(*[values[cut] for cut in self._cuts])

    def pack(self, option: Any) -> bytes:
        """Return a structure's bytes; raise :class:`struct.error` if a value is out of its field's range."""
        if self._plain:
            return self._struct.pack(*option)
        values: list[float] = []
        for value in option:
            values.extend(value) if isinstance(value, tuple) else values.append(value)
        return self._struct.pack(*values)


def _count(word: str) -> int:
    return int(word[:-1] or 1)


LAYOUTS: Final[dict[type[Any], OptionLayout]] = {}  #: layout of each structure
BY_TAG_AND_SIZE: Final[dict[tuple[int, int], OptionLayout]] = {}  #: by tag and size; the size excludes those two fields

_Kind = TypeVar("_Kind", bound=type[Any])


def _option(tag: int, form: str) -> Callable[[_Kind], _Kind]:
    """Register a class for an option whose fields the driver reads. Using a class lets their types be checked."""

    def register(kind: _Kind) -> _Kind:
        layout = OptionLayout(tag, kind, form.split())
        LAYOUTS[kind] = BY_TAG_AND_SIZE[tag, layout.size] = layout
        return kind

    return register


def _declared(tag: int, name: str, fields: str) -> Any:
    """Register an option by its fields, declared as in C; all are zero by default."""
    typed = [(word, field) for word, *names in map(str.split, fields.split(";")) for field in names]
    words, names = zip(*typed, strict=True)
    kind: Any = namedtuple(name, names, defaults=map(_zero, words))  # type: ignore[misc]  # noqa: PYI024
    return _option(tag, " ".join(words))(kind)


def _zero(word: str) -> float | Ints | Floats:
    zero, count = 0.0 if word[-1] in "fd" else 0, _count(word)
    return (zero,) * count if count > 1 else zero


@_option(0, "I I f f f i f f f I 9f 3f I I 9f 3f")
class Demo(NamedTuple):
    """The main state: attitude [millidegree], altitude [mm], velocity [mm/s], battery [%]."""

    ctrl_state: int = 0
    battery: int = 0
    theta: float = 0.0
    phi: float = 0.0
    psi: float = 0.0
    altitude: int = 0
    vx: float = 0.0
    vy: float = 0.0
    vz: float = 0.0
    num_frames: int = 0
    detection_rotation: Floats = (0.0,) * 9
    detection_translation: Floats = (0.0,) * 3
    detection_tag_index: int = 0
    detection_camera_type: int = 0
    camera_rotation: Floats = (0.0,) * 9
    camera_translation: Floats = (0.0,) * 3


@_option(1, "I")
class Time(NamedTuple):
    """The drone's clock: the upper 11 bits are seconds, the lower 21 microseconds."""

    time: int = 0


@_option(2, "3H 3h 2h I H H H H H H H H H I i h")
class RawMeasures(NamedTuple):
    """The analogue-to-digital converters' readings; ``vbat`` is in mV."""

    accs: Ints = (0,) * 3
    gyros: Ints = (0,) * 3
    gyros_110: Ints = (0,) * 2
    vbat: int = 0
    us_start_echo: int = 0
    us_end_echo: int = 0
    us_association_echo: int = 0
    us_distance_echo: int = 0
    us_curve_time: int = 0
    us_curve_value: int = 0
    us_curve_ref: int = 0
    echo_flag: int = 0
    echo_count: int = 0
    echo_sum: int = 0
    altitude_temp: int = 0
    gradient: int = 0


@_option(3, "f H 3f 3f I I I")
class PhysMeasures(NamedTuple):
    """Measurements in physical units: accelerations [mg], rates [degree/s]."""

    acc_temp: float = 0.0
    gyro_temp: int = 0
    accs: Floats = (0.0,) * 3
    gyros: Floats = (0.0,) * 3
    alim_3v3: int = 0
    vref_epson: int = 0
    vref_idg: int = 0


#: Offsets of the gyros [degree/s].
GyrosOffsets = _declared(4, "GyrosOffsets", "3f offset")
#: Attitude computed from the accelerometers alone [millidegree].
EulerAngles = _declared(5, "EulerAngles", "f theta phi")
#: The targets of the control loops.
References = _declared(
    6,
    "References",
    "i theta phi theta_integral phi_integral pitch roll yaw psi; f vx vy theta_mod phi_mod k_v_x k_v_y; I k_mode; "
    "f ui_time ui_theta ui_phi ui_psi ui_psi_accuracy; i ui_sequence",
)
#: Offsets determined by the flat trim.
Trims = _declared(7, "Trims", "f angular_rates_r euler_angles_theta euler_angles_phi")
#: Values in the last ``PCMD``.
RcReferences = _declared(8, "RcReferences", "i pitch roll yaw gaz ag")
#: The motors' control values.
Pwm = _declared(
    9,
    "Pwm",
    "4B motors saturations; f gaz_feed_forward gaz_altitude altitude_integral vz_ref; i u_pitch u_roll u_yaw; "
    "f yaw_integral; i u_pitch_planned u_roll_planned u_yaw_planned; f u_gaz_planned; 4H currents; "
    "f altitude_proportional altitude_derivative",
)
#: The altitude estimate [mm].
Altitude = _declared(
    10,
    "Altitude",
    "i vision; f vz; i reference raw; f obs_acc_z obs_altitude; 3f obs_x; I obs_state; 2f est_vb; I est_state",
)
#: Translation seen by the vertical camera.
VisionRaw = _declared(11, "VisionRaw", "f tx ty tz")
#: Optical flow in five zones.
VisionOpticalFlow = _declared(12, "VisionOpticalFlow", "5f dx dy")
#: Inputs to the vision-based velocity estimate.
Vision = _declared(
    13,
    "Vision",
    "I state; i misc; f phi_trim phi_ref_proportional theta_trim theta_ref_proportional; i new_raw_picture; "
    "f theta_capture phi_capture psi_capture; i altitude_capture; I time_capture; 3f body_velocity; f delta_phi "
    "delta_theta delta_psi; I gold_defined gold_reset; f gold_x gold_y",
)
#: How long each vision step takes [ms].
VisionPerf = _declared(14, "VisionPerf", "f szo corners compute tracking trans update; 20f custom")
#: Points tracked across images: whether each is locked, then the x and y of each.
TrackersSend = _declared(15, "TrackersSend", "30i locked; 60i points")


@_option(16, "I 4I 4I 4I 4I 4I 4I 4f 36f 12f 4I")
class VisionDetect(NamedTuple):
    """Up to four detected tags: type, centre and size (0 to 1000 across the image), distance [cm], orientation [°]."""

    detected: int = 0
    kinds: Ints = (0,) * 4
    xc: Ints = (0,) * 4
    yc: Ints = (0,) * 4
    width: Ints = (0,) * 4
    height: Ints = (0,) * 4
    distance: Ints = (0,) * 4
    orientation: Floats = (0.0,) * 4
    rotation: Floats = (0.0,) * 36
    translation: Floats = (0.0,) * 12
    camera_source: Ints = (0,) * 4


#: The control loop's watchdog.
Watchdog = _declared(17, "Watchdog", "i watchdog")
#: A frame from the acquisition board.
AdcDataFrame = _declared(18, "AdcDataFrame", "I version; 32B data")
#: The state of the video encoder.
VideoStream = _declared(
    19,
    "VideoStream",
    "B quant; I frame_size frame_number atcmd_ref_sequence atcmd_mean_ref_gap; f atcmd_var_ref_gap; "
    "I atcmd_ref_quality out_bitrate desired_bitrate; 5i data; I tcp_queue_level fifo_queue_level",
)
#: Counters used by games.
Games = _declared(20, "Games", "I double_tap_counter finish_line_counter")
#: Barometer readings: temperature [0.1 °C], pressure [Pa].
PressureRaw = _declared(21, "PressureRaw", "i up; h ut; i temperature pressure")
#: Magnetometer readings; headings are in degrees.
Magneto = _declared(
    22,
    "Magneto",
    "h mx my mz; 3f raw rectified offset; f heading heading_gyro heading_fusion; B calibrated; I state; f radius "
    "error_mean error_variance",
)
#: The estimated wind: speed [m/s], angle [rad].
WindSpeed = _declared(23, "WindSpeed", "f speed angle compensation_theta compensation_phi; 6f state; 3f debug")
#: State of the barometer's Kalman filter.
KalmanPressure = _declared(
    24,
    "KalmanPressure",
    "f pressure_offset est_z est_zdot est_bias_pwm est_bias_pressure us_offset us_prediction cov_altitude cov_pwm "
    "cov_speed; i ground_effect; f innovation_sum; i us_rejected; f multisine gaz_altitude; i multisine_on "
    "multisine_starting",
)
#: The high-definition recording.
HdVideo = _declared(25, "HdVideo", "I state fifo_packets fifo_size usb_size usb_free frame_number usb_remaining_s")
#: The quality of the radio link.
Wifi = _declared(26, "Wifi", "I link_quality")
#: Another estimate of vertical speed, sent by firmware up to 2.2.
Zimmu3000 = _declared(27, "Zimmu3000", "i lsb; f find")
#: The GPS receiver's data from firmware 2.4, in degrees and metres.
Gps = _declared(
    27,
    "Gps",
    "d latitude longitude elevation hdop; i data_available zero_validated waypoint_validated; d latitude_zero "
    "longitude_zero latitude_fused longitude_fused; I state; 10f trajectory; d vdop pdop; f speed; I last_frame_time; "
    "f heading heading_magnetic ehpe ehve c_n0; I satellites; 24B channels; i plugged; I ephemeris_state; "
    "f vx_trajectory vy_trajectory; I firmware_status",
)


# Datagrams -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Navdata:
    """One datagram."""

    state: State
    sequence: int
    vision_defined: int
    options: dict[type[Option], Option]  #: options by type
    unknown: tuple[tuple[int, int], ...]  #: tag and size of unknown options

    def get(self, kind: type[_Option]) -> _Option | None:
        """Return the option of this type; None if the datagram has none."""
        return cast("_Option | None", self.options.get(kind))


def decode(datagram: bytes | memoryview) -> Navdata:
    """Decode a datagram; raise :class:`DecodeError` if it is damaged. Unknown options are listed but not decoded."""
    end = len(datagram) - _CHECKSUM.size
    if not _HEADER.size <= end <= MAX_DATAGRAM - _CHECKSUM.size:
        raise DecodeError(f"{len(datagram)} bytes are not navdata")
    signature, state, sequence, vision_defined = _HEADER.unpack_from(datagram)
    if signature != SIGNATURE:
        raise DecodeError(f"navdata must begin with {SIGNATURE:#x}, got {signature:#x}")
    tag, size, checksum = _CHECKSUM.unpack_from(datagram, end)
    if tag != _CHECKSUM_TAG or size != _CHECKSUM.size:
        raise DecodeError("navdata does not end with a checksum")
    if checksum != sum(datagram[:end]):
        raise DecodeError(f"navdata {sequence} is damaged: its checksum is wrong")
    options, unknown = _decode_options(datagram, end)
    return Navdata(State(state), sequence, vision_defined, options, tuple(unknown))


def encode(state: int, sequence: int, options: Iterable[Option] = (), vision_defined: int = 0) -> bytes:
    """Return a datagram with these options in this order; raise :class:`struct.error` if a number is out of range."""
    parts = [_HEADER.pack(SIGNATURE, state, sequence, vision_defined)]
    for option in options:
        layout = LAYOUTS[type(option)]
        parts += (_OPTION.pack(layout.tag, layout.size + _OPTION.size), layout.pack(option))
    body = b"".join(parts)
    return body + _CHECKSUM.pack(_CHECKSUM_TAG, _CHECKSUM.size, sum(body) & 0xFFFFFFFF)


def _decode_options(datagram: bytes | memoryview, end: int) -> tuple[dict[type[Option], Option], list[tuple[int, int]]]:
    options: dict[type[Option], Option] = {}
    unknown: list[tuple[int, int]] = []
    at = _HEADER.size
    while at < end:
        if at + _OPTION.size > end:
            raise DecodeError("navdata has bytes that belong to no option")
        tag, size = _OPTION.unpack_from(datagram, at)
        if size < _OPTION.size or at + size > end:
            raise DecodeError(f"navdata option {tag} of {size} bytes does not fit in its datagram")
        layout = BY_TAG_AND_SIZE.get((tag, size - _OPTION.size))
        if layout is None:
            unknown.append((tag, size))
        else:
            options[layout.kind] = layout.unpack(datagram, at + _OPTION.size)
        at += size
    return options, unknown


VIDEO: Final = 5555  #: the video's port


@dataclass(frozen=True, slots=True)
class Ports:
    """The drone's ports; for an emulated drone, 0 means any free port."""

    navdata: int = PORT  #: UDP
    video: int = VIDEO  #: UDP on an AR.Drone 1, TCP on an AR.Drone 2
    at: int = at.PORT  #: UDP
    control: int = configuration.PORT  #: TCP

    @classmethod
    def free(cls) -> Ports:
        """Return 0 for each port, which means any free port."""
        return cls(0, 0, 0, 0)


STANDARD: Final = Ports()
