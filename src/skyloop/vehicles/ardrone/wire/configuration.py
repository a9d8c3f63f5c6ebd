"""The AR.Drone's configuration: its keys, the text form of their values, and the dump on TCP port 5559. Pure.

``AT*CONFIG`` sets a key to a text value. The drone sends all keys as ``section:key = value`` lines, followed by a zero
byte.

Sources: the AR.Drone SDK 2.0.1 (``ardrone_tool/Control``) and a dump from an AR.Drone 1 with firmware 1.7.4. The keys'
names, categories and most defaults come from the SDK's ``config_keys.h``. Keys that only an AR.Drone 1 has come from
the dump. Ranges, where given, come from chapter 8 of the Parrot AR.Drone Developer Guide. The animations' names and
order come from ``ardrone_api.h``, their durations from the requests that the SDK's applications make.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final, TypeAlias

from skyloop.errors import DecodeError

PORT: Final = 5559  #: TCP
END_OF_DUMP: Final = b"\0"
DEFAULT_ID: Final = "00000000"  #: id of the shared session, user and application


def format_value(value: Value) -> str:
    """Return the drone's text for a value: ``TRUE``, ``3000``, ``2.094395e-01``, ``{ 1.0e+00 2.0e+00 }``."""
    if isinstance(value, bool):
        return "TRUE" if value else "FALSE"
    if isinstance(value, float):
        return f"{value:e}"
    if isinstance(value, tuple):
        return "{ " + " ".join(f"{each:e}" for each in value) + " }"
    return str(value)


def parse_value(text: str, like: Value) -> Value:
    """Parse a value of the type of ``like``; raise :class:`DecodeError` if the text does not fit that type."""
    text = text.strip()
    try:
        if isinstance(like, bool):
            return {"TRUE": True, "FALSE": False, "1": True, "0": False}[text.upper()]
        if isinstance(like, int):
            return int(text)
        if isinstance(like, float):
            return _finite(text)
        if isinstance(like, tuple):
            return tuple(_finite(each) for each in text.strip("{}").split())
    except (KeyError, ValueError):
        raise DecodeError(f"{text!r} is not a valid {type(like).__name__}") from None
    return text


def format_dump(values: dict[str, Value]) -> bytes:
    """Return a dump of all keys in the drone's format."""
    lines = "".join(f"{name} = {format_value(value)}\n" for name, value in values.items())
    return lines.encode("latin-1", "replace") + END_OF_DUMP


def parse_dump(dump: bytes) -> dict[str, str]:
    """Return the text value of each key. Invalid lines are skipped; if a key is repeated, the last line applies."""
    values = {}
    for line in dump.split(END_OF_DUMP, 1)[0].decode("latin-1").splitlines():
        name, equals, value = line.partition("=")
        if equals and ":" in name:
            values[name.strip().lower()] = value.strip()
    return values


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


Value: TypeAlias = bool | int | float | str | tuple[float, ...]


class Category(Enum):
    """The scope of a key's value on a drone with sessions, users and applications (AR.Drone 2)."""

    COMMON = "common"
    APPLICATION = "application"
    USER = "user"
    SESSION = "session"


class VideoCodec(IntEnum):
    """Values of ``video:video_codec``."""

    NONE = 0
    UVLC = 0x20
    P264 = 0x40
    MP4_360P = 0x80
    H264_360P = 0x81
    MP4_360P_H264_720P = 0x82
    H264_720P = 0x83
    MP4_360P_SLRS = 0x84
    H264_360P_SLRS = 0x85
    H264_720P_SLRS = 0x86
    H264_AUTO_RESIZE = 0x87
    MP4_360P_H264_360P = 0x88


@dataclass(frozen=True, slots=True)
class Key:
    """A key. ``default`` has the key's type. Units are the drone's own: angles are in radians, lengths in mm."""

    name: str  #: ``section:key``
    default: Value
    category: Category = Category.COMMON
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[int, ...] = ()
    read_only: bool = False
    versions: tuple[int, ...] = (1, 2)  #: AR.Drone versions that have the key
    text: str = ""


class VideoChannel(IntEnum):
    """Values of ``video:video_channel``."""

    FRONT = 0
    BOTTOM = 1
    FRONT_WITH_BOTTOM = 2  #: AR.Drone 1 only
    BOTTOM_WITH_FRONT = 3  #: AR.Drone 1 only
    NEXT = 4


NAVDATA_OPTIONS_USUAL: Final = 0x10001  #: one bit per tag: DEMO and VISION_DETECT
NO_CEILING_MM: Final = 100_000  #: value of ``control:altitude_max`` for no ceiling
_INVALID_GPS: Final = 500.0  #: latitude and longitude while unknown [°]


_GENERAL: Final = (
    Key("general:num_version_config", 1, read_only=True, text="version of the configuration's format"),
    Key("general:num_version_mb", 33, read_only=True, text="version of the mother board"),
    Key("general:num_version_soft", "2.3.3", read_only=True, text="version of the firmware"),
    Key("general:drone_serial", "XXXXXXXXXX", read_only=True, text="serial number"),
    Key("general:soft_build_date", "", read_only=True, text="build date of the firmware"),
    *(
        Key(f"general:motor{motor}_{what}", "0.0", read_only=True, text=f"{what} version of motor {motor}")
        for motor in (1, 2, 3, 4)
        for what in ("soft", "hard", "supplier")
    ),
    Key("general:ardrone_name", "My ARDrone", text="the drone's name"),
    Key("general:flying_time", 0, unit="s", read_only=True, text="total time in the air"),
    Key("general:navdata_demo", False, text="send only the options of the demo mode, 15 times a second"),
    Key("general:navdata_options", NAVDATA_OPTIONS_USUAL, Category.APPLICATION, text="options to send: bits by tag"),
    Key("general:com_watchdog", 2, unit="s", low=0, high=600, text="time without commands before the drone lands"),
    Key("general:video_enable", True, text="reserved"),
    Key("general:vision_enable", True, text="reserved"),
    Key("general:vbat_min", 9000, unit="mV", low=0, high=20000, text="battery voltage at which the drone lands"),
    Key("general:localtime", 0, unit="s", text="the host's time, for the names of recordings", versions=(2,)),
)


def _calibration(name: str, value: Value, sensor: str, versions: tuple[int, ...] = (1, 2)) -> Key:
    return Key(f"control:{name}", value, read_only=True, text=f"calibration of the {sensor}", versions=versions)


def _tilt(name: str, usual_deg: float, high: float, text: str) -> Key:
    return Key(f"control:{name}", math.radians(usual_deg), Category.USER, "rad", 0.0, high, text=text)


def _climb(name: str, usual_mm_s: float, text: str) -> Key:
    return Key(f"control:{name}", usual_mm_s, Category.USER, "mm/s", 200, 2000, text=text)


def _yaw_rate(name: str, usual_deg_s: float, text: str) -> Key:
    return Key(f"control:{name}", math.radians(usual_deg_s), Category.USER, "rad/s", 0.7, 6.11, text=text)


_CONTROL: Final = (
    _calibration("accs_offset", (0.0, 0.0, 0.0), "accelerometers"),
    _calibration("accs_gains", (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), "accelerometers"),
    _calibration("gyros_offset", (0.0, 0.0, 0.0), "gyros"),
    _calibration("gyros_gains", (1.0, 1.0, 1.0), "gyros"),
    _calibration("gyros110_offset", (0.0, 0.0), "gyros"),
    _calibration("gyros110_gains", (1.0, 1.0), "gyros"),
    _calibration("magneto_offset", (0.0, 0.0, 0.0), "magnetometer", (2,)),
    _calibration("magneto_radius", 0.0, "magnetometer", (2,)),
    Key("control:gyro_offset_thr_x", 4.0, read_only=True, text="threshold of the gyro's offset"),
    Key("control:gyro_offset_thr_y", 4.0, read_only=True, text="threshold of the gyro's offset"),
    Key("control:gyro_offset_thr_z", 0.5, read_only=True, text="threshold of the gyro's offset"),
    Key("control:pwm_ref_gyros", 500, read_only=True, text="reference of the gyros"),
    Key("control:osctun_value", 63, read_only=True, text="tuning of the oscillator"),
    Key("control:osctun_test", True, read_only=True, text="tuning of the oscillator"),
    Key("control:altitude_max", 3000, unit="mm", low=500, high=NO_CEILING_MM, text="ceiling; 100000 means none"),
    Key("control:altitude_min", 50, unit="mm", low=50, high=5000, text="minimum altitude"),
    Key("control:outdoor", False, text="use the outdoor limits"),
    Key("control:flight_without_shell", False, text="the outdoor hull is on"),
    Key("control:autonomous_flight", False, text="reserved"),
    Key("control:flight_anim", "0,0", text="flight animation: number, duration [ms]"),
    Key("control:control_level", 0, Category.APPLICATION, low=0, high=3, text="bit 1: combined yaw"),
    _tilt("euler_angle_max", 12, 0.52, "maximum tilt"),
    _tilt("control_iphone_tilt", 20, 1.0, "maximum tilt of the phone"),
    _climb("control_vz_max", 700.0, "maximum climb and descent"),
    _yaw_rate("control_yaw", 100, "maximum yaw rate"),
    Key("control:manual_trim", False, Category.USER, text="manual trim"),
    _tilt("indoor_euler_angle_max", 12, 0.52, "indoors"),
    _climb("indoor_control_vz_max", 700.0, "indoors"),
    _yaw_rate("indoor_control_yaw", 100, "indoors"),
    _tilt("outdoor_euler_angle_max", 20, 0.52, "outdoors"),
    _climb("outdoor_control_vz_max", 1000.0, "outdoors"),
    _yaw_rate("outdoor_control_yaw", 200, "outdoors"),
    Key("control:flying_mode", 0, Category.SESSION, choices=(0, 1, 2, 3), text="0 free, 1 over a roundel, 2 oriented"),
    Key("control:hovering_range", 1000, Category.SESSION, unit="mm", low=0, high=20000, text="range over a roundel"),
    Key("control:shield_enable", False, text="the indoor hull is on", versions=(1,)),
    Key("control:brushless", True, read_only=True, text="whether the motors are brushless", versions=(1,)),
    Key("control:control_trim_z", 0.0, Category.USER, unit="rad/s", text="trim of the yaw", versions=(1,)),
)
_NETWORK: Final = (
    Key("network:ssid_single_player", "ardrone2", text="name of the access point"),
    Key("network:ssid_multi_player", "ardrone2", text="name of the access point, multi-player"),
    Key("network:wifi_mode", 0, choices=(0, 1, 2), text="0 access point, 1 ad hoc, 2 station"),
    Key("network:wifi_rate", 0, text="reserved"),
    Key("network:owner_mac", "00:00:00:00:00:00", text="the only device that may connect; zeros mean any"),
    Key("network:navdata_port", 5554, read_only=True, versions=(1,)),
    Key("network:video_port", 5555, read_only=True, versions=(1,)),
    Key("network:at_port", 5556, read_only=True, versions=(1,)),
    Key("network:cmd_port", 0, read_only=True, versions=(1,)),
    Key("network:secure", 0, read_only=True, versions=(1,)),
    Key("network:passkey", "", read_only=True, versions=(1,)),
)
_VIDEO: Final = (
    Key("video:camif_fps", 30, unit="1/s", read_only=True, text="frame rate of the sensor"),
    Key("video:camif_buffers", 2, read_only=True),
    Key("video:num_trackers", 12, read_only=True, text="number of points tracked by vision"),
    Key("video:video_on_usb", True, text="record to a USB stick if present", versions=(2,)),
    Key("video:video_file_index", 1, text="number of the next recording", versions=(2,)),
    Key("video:bitrate", 1000, Category.APPLICATION, unit="kbit/s", low=250, high=4000, text="bit rate in manual mode"),
    Key("video:bitrate_ctrl_mode", 0, Category.APPLICATION, choices=(0, 1, 2), text="0 constant, 1 dynamic, 2 manual"),
    Key("video:bitrate_storage", 4000, Category.APPLICATION, unit="kbit/s", text="recording bit rate", versions=(2,)),
    Key("video:codec_fps", 30, Category.SESSION, unit="1/s", low=15, high=30, text="frame rate", versions=(2,)),
    Key("video:video_codec", VideoCodec.H264_360P.value, Category.SESSION, text="see VideoCodec"),
    Key("video:video_slices", 0, Category.SESSION, versions=(2,)),
    Key("video:video_live_socket", 0, Category.SESSION, versions=(2,)),
    Key("video:max_bitrate", 4000, Category.SESSION, unit="kbit/s", low=250, high=4000, versions=(2,)),
    Key("video:video_channel", 0, Category.SESSION, choices=(0, 1, 2, 3, 4), text="0 front, 1 bottom, 4 the next one"),
)
_OTHERS: Final = (
    Key("leds:leds_anim", "0,0,0", text="animation: number, frequency [bits of a float, Hz], duration [s]"),
    Key("detect:enemy_colors", 1, choices=(1, 2, 3), text="indoor stickers: 1 green, 2 yellow, 3 blue"),
    Key("detect:enemy_without_shell", 0, text="look for the outdoor stickers"),
    Key("detect:groundstripe_colors", 16, Category.SESSION),
    Key("detect:detect_type", 3, Category.SESSION, choices=tuple(range(15)), text="2 vision, 3 nothing, 10 several"),
    Key("detect:detections_select_h", 0, Category.SESSION, text="tags for the front camera: bits"),
    Key("detect:detections_select_v_hsync", 0, Category.SESSION, text="tags for the bottom camera, at full rate: bits"),
    Key("detect:detections_select_v", 0, Category.SESSION, text="tags for the bottom camera: bits"),
    Key("syslog:output", 7),
    Key("syslog:max_size", 102400),
    Key("syslog:nb_files", 5),
    Key("pic:ultrasound_freq", 8, choices=(7, 8), text="7 for 22.22 Hz, 8 for 25 Hz"),
    Key("pic:ultrasound_watchdog", 3, read_only=True),
    Key("pic:pic_version", "0", read_only=True),
    Key("userbox:userbox_cmd", 0, Category.SESSION, versions=(2,)),
    Key("gps:latitude", _INVALID_GPS, Category.SESSION, unit="degree", versions=(2,), text="500 means unknown"),
    Key("gps:longitude", _INVALID_GPS, Category.SESSION, unit="degree", versions=(2,), text="500 means unknown"),
    Key("gps:altitude", 0.0, Category.SESSION, unit="m", versions=(2,)),
    Key("custom:application_id", "00000000", Category.SESSION, text="the application in use", versions=(1, 2)),
    Key("custom:application_desc", "Default application configuration", Category.APPLICATION),
    Key("custom:profile_id", "00000000", Category.SESSION, text="the user in use"),
    Key("custom:profile_desc", "Default profile configuration", Category.USER),
    Key("custom:session_id", "00000000", Category.SESSION, text="the session in use"),
    Key("custom:session_desc", "Default session configuration", Category.SESSION),
)
KEYS: Final = {key.name: key for key in (*_GENERAL, *_CONTROL, *_NETWORK, *_VIDEO, *_OTHERS)}


def keys_of(version: int) -> dict[str, Key]:
    """Return the keys of an AR.Drone 1 or 2."""
    return {name: key for name, key in KEYS.items() if version in key.versions}


LED_ANIMATIONS: Final = (
    "blink_green_red",
    "blink_green",
    "blink_red",
    "blink_orange",
    "snake_green_red",
    "fire",
    "standard",
    "red",
    "green",
    "red_snake",
    "blank",
    "right_missile",
    "left_missile",
    "double_missile",
    "front_left_green_others_red",
    "front_right_green_others_red",
    "rear_right_green_others_red",
    "rear_left_green_others_red",
    "left_green_right_red",
    "left_red_right_green",
    "blink_standard",
)
#: Name and duration [ms] of each flight animation.
FLIGHT_ANIMATIONS: Final = (
    ("phi_m30_deg", 1000),
    ("phi_30_deg", 1000),
    ("theta_m30_deg", 1000),
    ("theta_30_deg", 1000),
    ("theta_20deg_yaw_200deg", 1000),
    ("theta_20deg_yaw_m200deg", 1000),
    ("turnaround", 5000),
    ("turnaround_godown", 5000),
    ("yaw_shake", 2000),
    ("yaw_dance", 5000),
    ("phi_dance", 5000),
    ("theta_dance", 5000),
    ("vz_dance", 5000),
    ("wave", 5000),
    ("phi_theta_mixed", 5000),
    ("double_phi_theta_mixed", 5000),
    ("flip_ahead", 15),
    ("flip_behind", 15),
    ("flip_left", 15),
    ("flip_right", 15),
)
NO_ANIMATION: Final = "none"
FIRST_FLIP: Final = 16  #: index of the first flip in ``FLIGHT_ANIMATIONS``; an AR.Drone 1 has no flips
