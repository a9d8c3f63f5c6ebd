"""The navdata options as typed structures, and their memory layouts.

Names, types and order come from ``navdata_common.h`` in the AR.Drone SDK 2.0.1, whose structures are packed without
alignment. Units are the drone's own: millidegrees, mm/s, mm, mV. Firmware 2.4 sends ``Gps`` with the tag that
``Zimmu3000`` used before.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

Floats: TypeAlias = tuple[float, ...]
Ints: TypeAlias = tuple[int, ...]


class Layout:
    """The memory layout of an option: a struct format with one word per field (``3f`` is one field of three floats)."""

    def __init__(self, tag: int, kind: type[Any], form: str) -> None:
        self.tag = tag
        self.kind = kind
        counts = [int(re.match(r"\d*", word)[0] or 1) for word in form.split()]  # type: ignore[index]
        if len(counts) != len(kind._fields):
            raise TypeError(f"{kind.__name__} has {len(kind._fields)} fields and a format for {len(counts)}")
        self._struct = struct.Struct("<" + form.replace(" ", ""))
        self._cuts: list[slice | int] = []
        at = 0
        for count in counts:
            self._cuts.append(slice(at, at + count) if count > 1 else at)
            at += count
        self._plain = all(count == 1 for count in counts)

    @property
    def size(self) -> int:
        """Number of bytes, excluding tag and size."""
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


LAYOUTS: Final[dict[type[Any], Layout]] = {}  #: layout of each structure
BY_TAG_AND_SIZE: Final[dict[tuple[int, int], Layout]] = {}  #: keyed by tag and size; the size excludes those two fields

_Kind = TypeVar("_Kind", bound=type[Any])


def _option(tag: int, form: str) -> Callable[[_Kind], _Kind]:
    def register(kind: _Kind) -> _Kind:
        layout = Layout(tag, kind, form)
        LAYOUTS[kind] = BY_TAG_AND_SIZE[tag, layout.size] = layout
        return kind

    return register


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
    """The analogue-to-digital converters' readings; ``vbat_raw`` is in mV."""

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


@_option(4, "3f")
class GyrosOffsets(NamedTuple):
    """Offsets of the gyros [degree/s]."""

    offset: Floats = (0.0,) * 3


@_option(5, "f f")
class EulerAngles(NamedTuple):
    """Attitude computed from the accelerometers alone [millidegree]."""

    theta: float = 0.0
    phi: float = 0.0


@_option(6, "i i i i i i i i f f f f f f I f f f f f i")
class References(NamedTuple):
    """The targets of the control loops."""

    theta: int = 0
    phi: int = 0
    theta_integral: int = 0
    phi_integral: int = 0
    pitch: int = 0
    roll: int = 0
    yaw: int = 0
    psi: int = 0
    vx: float = 0.0
    vy: float = 0.0
    theta_mod: float = 0.0
    phi_mod: float = 0.0
    k_v_x: float = 0.0
    k_v_y: float = 0.0
    k_mode: int = 0
    ui_time: float = 0.0
    ui_theta: float = 0.0
    ui_phi: float = 0.0
    ui_psi: float = 0.0
    ui_psi_accuracy: float = 0.0
    ui_sequence: int = 0


@_option(7, "f f f")
class Trims(NamedTuple):
    """Offsets determined by the flat trim."""

    angular_rates_r: float = 0.0
    euler_angles_theta: float = 0.0
    euler_angles_phi: float = 0.0


@_option(8, "i i i i i")
class RcReferences(NamedTuple):
    """Values in the last ``PCMD``."""

    pitch: int = 0
    roll: int = 0
    yaw: int = 0
    gaz: int = 0
    ag: int = 0


@_option(9, "4B 4B f f f f i i i f i i i f 4H f f")
class Pwm(NamedTuple):
    """The motors' control values."""

    motors: Ints = (0,) * 4
    saturations: Ints = (0,) * 4
    gaz_feed_forward: float = 0.0
    gaz_altitude: float = 0.0
    altitude_integral: float = 0.0
    vz_ref: float = 0.0
    u_pitch: int = 0
    u_roll: int = 0
    u_yaw: int = 0
    yaw_integral: float = 0.0
    u_pitch_planned: int = 0
    u_roll_planned: int = 0
    u_yaw_planned: int = 0
    u_gaz_planned: float = 0.0
    currents: Ints = (0,) * 4
    altitude_proportional: float = 0.0
    altitude_derivative: float = 0.0


@_option(10, "i f i i f f 3f I 2f I")
class Altitude(NamedTuple):
    """The altitude estimate [mm]."""

    vision: int = 0
    vz: float = 0.0
    reference: int = 0
    raw: int = 0
    obs_acc_z: float = 0.0
    obs_altitude: float = 0.0
    obs_x: Floats = (0.0,) * 3
    obs_state: int = 0
    est_vb: Floats = (0.0,) * 2
    est_state: int = 0


@_option(11, "f f f")
class VisionRaw(NamedTuple):
    """Translation seen by the vertical camera."""

    tx: float = 0.0
    ty: float = 0.0
    tz: float = 0.0


@_option(12, "5f 5f")
class VisionOpticalFlow(NamedTuple):
    """Optical flow in five zones."""

    dx: Floats = (0.0,) * 5
    dy: Floats = (0.0,) * 5


@_option(13, "I i f f f f i f f f i I 3f f f f I I f f")
class Vision(NamedTuple):
    """The inputs to the vision-based velocity estimate."""

    state: int = 0
    misc: int = 0
    phi_trim: float = 0.0
    phi_ref_proportional: float = 0.0
    theta_trim: float = 0.0
    theta_ref_proportional: float = 0.0
    new_raw_picture: int = 0
    theta_capture: float = 0.0
    phi_capture: float = 0.0
    psi_capture: float = 0.0
    altitude_capture: int = 0
    time_capture: int = 0
    body_velocity: Floats = (0.0,) * 3
    delta_phi: float = 0.0
    delta_theta: float = 0.0
    delta_psi: float = 0.0
    gold_defined: int = 0
    gold_reset: int = 0
    gold_x: float = 0.0
    gold_y: float = 0.0


@_option(14, "f f f f f f 20f")
class VisionPerf(NamedTuple):
    """How long each vision step takes [ms]."""

    szo: float = 0.0
    corners: float = 0.0
    compute: float = 0.0
    tracking: float = 0.0
    trans: float = 0.0
    update: float = 0.0
    custom: Floats = (0.0,) * 20


@_option(15, "30i 60i")
class TrackersSend(NamedTuple):
    """Points tracked across images: whether each is locked, then the x and y of each."""

    locked: Ints = (0,) * 30
    points: Ints = (0,) * 60


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


@_option(17, "i")
class Watchdog(NamedTuple):
    """The control loop's watchdog."""

    watchdog: int = 0


@_option(18, "I 32B")
class AdcDataFrame(NamedTuple):
    """A frame of the acquisition board."""

    version: int = 0
    data: Ints = (0,) * 32


@_option(19, "B I I I I f I I I 5i I I")
class VideoStream(NamedTuple):
    """The state of the video encoder."""

    quant: int = 0
    frame_size: int = 0
    frame_number: int = 0
    atcmd_ref_sequence: int = 0
    atcmd_mean_ref_gap: int = 0
    atcmd_var_ref_gap: float = 0.0
    atcmd_ref_quality: int = 0
    out_bitrate: int = 0
    desired_bitrate: int = 0
    data: Ints = (0,) * 5
    tcp_queue_level: int = 0
    fifo_queue_level: int = 0


@_option(20, "I I")
class Games(NamedTuple):
    """Counters used by games."""

    double_tap_counter: int = 0
    finish_line_counter: int = 0


@_option(21, "i h i i")
class PressureRaw(NamedTuple):
    """Barometer readings: temperature [0.1 °C], pressure [Pa]."""

    up: int = 0
    ut: int = 0
    temperature: int = 0
    pressure: int = 0


@_option(22, "h h h 3f 3f 3f f f f B I f f f")
class Magneto(NamedTuple):
    """Magnetometer readings; headings are in degrees."""

    mx: int = 0
    my: int = 0
    mz: int = 0
    raw: Floats = (0.0,) * 3
    rectified: Floats = (0.0,) * 3
    offset: Floats = (0.0,) * 3
    heading: float = 0.0
    heading_gyro: float = 0.0
    heading_fusion: float = 0.0
    calibrated: int = 0
    state: int = 0
    radius: float = 0.0
    error_mean: float = 0.0
    error_variance: float = 0.0


@_option(23, "f f f f 6f 3f")
class WindSpeed(NamedTuple):
    """The estimated wind: speed [m/s], angle [rad]."""

    speed: float = 0.0
    angle: float = 0.0
    compensation_theta: float = 0.0
    compensation_phi: float = 0.0
    state: Floats = (0.0,) * 6
    debug: Floats = (0.0,) * 3


@_option(24, "f f f f f f f f f f i f i f f i i")
class KalmanPressure(NamedTuple):
    """State of the barometer's Kalman filter."""

    pressure_offset: float = 0.0
    est_z: float = 0.0
    est_zdot: float = 0.0
    est_bias_pwm: float = 0.0
    est_bias_pressure: float = 0.0
    us_offset: float = 0.0
    us_prediction: float = 0.0
    cov_altitude: float = 0.0
    cov_pwm: float = 0.0
    cov_speed: float = 0.0
    ground_effect: int = 0
    innovation_sum: float = 0.0
    us_rejected: int = 0
    multisine: float = 0.0
    gaz_altitude: float = 0.0
    multisine_on: int = 0
    multisine_starting: int = 0


@_option(25, "I I I I I I I")
class HdVideo(NamedTuple):
    """The high-definition recording."""

    state: int = 0
    fifo_packets: int = 0
    fifo_size: int = 0
    usb_size: int = 0
    usb_free: int = 0
    frame_number: int = 0
    usb_remaining_s: int = 0


@_option(26, "I")
class Wifi(NamedTuple):
    """The quality of the radio link."""

    link_quality: int = 0


@_option(27, "i f")
class Zimmu3000(NamedTuple):
    """Another estimate of vertical speed, sent by firmware up to 2.2."""

    lsb: int = 0
    find: float = 0.0


@_option(27, "d d d d i i i d d d d I 10f d d f I f f f f f I 24B i I f f I")
class Gps(NamedTuple):
    """The GPS receiver's data from firmware 2.4, in degrees and metres."""

    latitude: float = 0.0
    longitude: float = 0.0
    elevation: float = 0.0
    hdop: float = 0.0
    data_available: int = 0
    zero_validated: int = 0
    waypoint_validated: int = 0
    latitude_zero: float = 0.0
    longitude_zero: float = 0.0
    latitude_fused: float = 0.0
    longitude_fused: float = 0.0
    state: int = 0
    trajectory: Floats = (0.0,) * 10
    vdop: float = 0.0
    pdop: float = 0.0
    speed: float = 0.0
    last_frame_time: int = 0
    heading: float = 0.0
    heading_magnetic: float = 0.0
    ehpe: float = 0.0
    ehve: float = 0.0
    c_n0: float = 0.0
    satellites: int = 0
    channels: Ints = (0,) * 24
    plugged: int = 0
    ephemeris_state: int = 0
    vx_trajectory: float = 0.0
    vy_trajectory: float = 0.0
    firmware_status: int = 0


Option: TypeAlias = (
    Demo
    | Time
    | RawMeasures
    | PhysMeasures
    | GyrosOffsets
    | EulerAngles
    | References
    | Trims
    | RcReferences
    | Pwm
    | Altitude
    | VisionRaw
    | VisionOpticalFlow
    | Vision
    | VisionPerf
    | TrackersSend
    | VisionDetect
    | Watchdog
    | AdcDataFrame
    | VideoStream
    | Games
    | PressureRaw
    | Magneto
    | WindSpeed
    | KalmanPressure
    | HdVideo
    | Wifi
    | Zimmu3000
    | Gps
)
