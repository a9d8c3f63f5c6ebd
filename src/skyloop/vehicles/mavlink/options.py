"""Options in ``mavlink://`` addresses, including the camera's, listed in ``docs/mavlink.md``. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Final

from skyloop.drivers.base import Sink, reject_unknown_options
from skyloop.drivers.byte_stream import serial_port
from skyloop.drivers.live_camera import (
    INTRINSICS_OPTIONS,
    CameraSource,
    LiveCamera,
    LiveCameraSettings,
    check_intrinsics,
    intrinsics_of,
    source_of,
)
from skyloop.drivers.uri import VehicleUri, host_and_port
from skyloop.drivers.vehicle_session import OwnLimit
from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.files import expand, read_bytes
from skyloop.messages import CameraInfo
from skyloop.messages.frame import H264, LOOKING_DOWN, LOOKING_FORWARD

Peer = tuple[str, int] | None  #: host and port of a UDP sender; None for a stream

TAKEOFF_ALTITUDE: Final = "limits.takeoff_altitude"
ALTITUDE: Final = "limits.altitude"


OWN_LIMITS: Final = (
    OwnLimit(ALTITUDE, 3.0, 0.5, 500.0, "m", "Maximum height above the take-off point"),
    OwnLimit("limits.climb", 1.0, 0.05, 10.0, "m/s", "Maximum vertical speed"),
    OwnLimit("limits.speed", 2.0, 0.05, 30.0, "m/s", "Maximum horizontal speed of a velocity set-point"),
    OwnLimit(TAKEOFF_ALTITUDE, 1.5, 0.5, 50.0, "m", "Height of a take-off above its start"),
)
USUAL: Final = {limit.name: limit.usual for limit in OWN_LIMITS}

KEY_BYTES: Final = 32  #: size of a signing key
DEFAULT_BAUD: Final = 57_600  #: usual speed of telemetry radios [bit/s]
#: Rotations from a camera's optical axes (right, down, forward) to body axes, row by row. The top of the image points
#: up or, for a camera that looks down, forward.
FACINGS: Final = {
    "forward": LOOKING_FORWARD,
    "down": LOOKING_DOWN,
}
_EXAMPLES: Final = (
    "it should look like mavlink://udpin:127.0.0.1:14540, mavlink://udpout:127.0.0.1:14580, "
    "mavlink://tcp:127.0.0.1:5760, mavlink://serial:/dev/ttyACM0:921600 or mavlink://serial:COM3:921600"
)
KNOWN: Final = {
    *("sysid", "component", "peer", "own_sysid", "rate", "parameters", "signing_key", "origin", "world_origin", "pose"),
    *(limit.option for limit in OWN_LIMITS),
    *("camera", "camera_name", "camera_width", "camera_height", "camera_fps", "camera_facing", "camera_stream"),
    *INTRINSICS_OPTIONS,
}


class ConnectionKind(StrEnum):
    """Kinds of connection."""

    UDP_IN = "udpin"  #: listens, and replies to the sender
    UDP_OUT = "udpout"  #: sends first
    TCP = "tcp"  #: connects
    SERIAL = "serial"


class PoseMessage(StrEnum):
    """The message type for external poses."""

    ODOMETRY = "odometry"
    VISION = "vision_position_estimate"


@dataclass(frozen=True, slots=True)
class Address:
    """The address of the vehicle's connection."""

    kind: ConnectionKind
    place: str  #: host or device
    number: int  #: port, or bits per second

    def __str__(self) -> str:
        place = f"[{self.place}]" if ":" in self.place and self.kind is not ConnectionKind.SERIAL else self.place
        return f"{self.kind.value}:{place}:{self.number}"


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """A camera separate from the autopilot. The image size and rate are announced before the first frame arrives."""

    source: str = field(repr=False)  # may contain credentials
    name: str
    width: int
    height: int
    fps: float
    facing: str  #: one of :data:`FACINGS`
    stream: bool = True  #: whether to announce a network camera's H.264 as a stream that is relayed unchanged


@dataclass(frozen=True, slots=True)
class MavlinkOptions:
    """A parsed address."""

    address: Address
    system: int | None = None  #: the vehicle's system id; None for the first one found
    component: int = 1  #: the autopilot's component id, by default MAV_COMP_ID_AUTOPILOT1
    peer: tuple[str, int] | None = None  #: address the vehicle sends from; None for the sender of its first packet
    own_system: int = 255
    rate_hz: float = 50.0  #: rate of attitude, position and velocity
    limits: Mapping[str, float] = field(default_factory=lambda: dict(USUAL))  #: the driver's limits by parameter name
    parameters: bool = True  #: whether to read the autopilot's parameters
    key: bytes | None = field(default=None, repr=False)
    origin: tuple[float, float, float] | None = None  #: latitude and longitude [degrees], altitude [m]
    world_origin: tuple[float, float, float] | None = None  #: the world origin's position, in the same units
    pose: PoseMessage = PoseMessage.ODOMETRY
    camera: CameraOptions | None = None


def options_of(uri: VehicleUri) -> MavlinkOptions:
    """Parse an address."""
    reject_unknown_options(uri, KNOWN)
    check_intrinsics(uri)
    own = uri.whole("own_sysid", 255, minimum=1, maximum=255)
    system = uri.whole("sysid", 1, minimum=1, maximum=255) if "sysid" in uri.options else None
    if system == own:
        raise UsageError(f"{uri}: sysid is the vehicle's and own_sysid is ours: they must differ")
    limits = {limit.name: limit.given(uri) for limit in OWN_LIMITS}
    if limits[TAKEOFF_ALTITUDE] > limits[ALTITUDE]:
        above = f"takeoff_altitude={limits[TAKEOFF_ALTITUDE]:g} is above the ceiling of {limits[ALTITUDE]:g} m"
        raise UsageError(f"{uri}: {above}: raise that too, with altitude=…")
    return MavlinkOptions(
        address=address_of(uri),
        system=system,
        component=uri.whole("component", 1, minimum=1, maximum=255),
        peer=_peer(uri),
        own_system=own,
        rate_hz=uri.number("rate", 50.0, minimum=1.0, maximum=200.0),
        limits=limits,
        parameters=uri.flag("parameters", default=True),
        key=_key(uri),
        origin=_origin(uri, "origin"),
        world_origin=_origin(uri, "world_origin"),
        pose=_pose(uri),
        camera=_camera(uri),
    )


def address_of(uri: VehicleUri) -> Address:
    """Parse the part of an address that specifies how to reach the vehicle."""
    word, _, rest = uri.place.partition(":")
    if word not in [kind.value for kind in ConnectionKind]:
        raise UsageError(f"{uri}: {word!r} is none of {', '.join(ConnectionKind)}: {_EXAMPLES}")
    kind = ConnectionKind(word)
    if kind is not ConnectionKind.SERIAL:
        found = host_and_port(rest)
        if found is None:
            raise UsageError(f"{uri} names no host or device: {_EXAMPLES}")
        return Address(kind, *found)
    place, colon, number = rest.rpartition(":")
    if not colon or not number.isdecimal():
        place, number = rest, str(DEFAULT_BAUD)
    if not place or not 1 <= int(number) <= 10_000_000:
        raise UsageError(f"{uri} names no host or device: {_EXAMPLES}")
    return Address(kind, serial_port(place) or place, int(number))


def _peer(uri: VehicleUri) -> tuple[str, int] | None:
    given = uri.options.get("peer")
    if given is None:
        return None
    found = host_and_port(given)
    if found is None:
        raise UsageError(f"{uri}: peer is {given!r}; it should look like peer=127.0.0.1:14580 or peer=[fe80::1]:14580")
    return found


def _key(uri: VehicleUri) -> bytes | None:
    given = uri.reveal("signing_key")
    if given is None:
        return None
    if not expand(given).exists():  # don't repeat the value, which may be the key itself
        raise FileFormatError(f"{uri}: signing_key can't be read: it must be the path of a file that holds the key")
    held = read_bytes(given, f"{uri}: the signing key's file", 1024)
    if len(held) == KEY_BYTES:
        return held
    text = held.decode("ascii", "replace").strip()
    if not re.fullmatch(r"[0-9a-fA-F]{64}", text):
        raise UsageError(f"{uri}: {given} must contain a signing key: 32 bytes, or 64 hexadecimal digits")
    return bytes.fromhex(text)


def _origin(uri: VehicleUri, option: str) -> tuple[float, float, float] | None:
    given = uri.options.get(option)
    if given is None:
        return None
    try:
        latitude, longitude, altitude = (float(each) for each in given.split(","))
    except ValueError:
        latitude = longitude = altitude = float("nan")
    if not (abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) <= 10_000):
        raise UsageError(f"{uri}: {option} is {given!r}; it should look like {option}=47.3977,8.5456,488 (degrees, m)")
    return latitude, longitude, altitude


def _pose(uri: VehicleUri) -> PoseMessage:
    given = uri.options.get("pose", PoseMessage.ODOMETRY.value)
    if given not in [each.value for each in PoseMessage]:
        raise UnknownNameError("pose of mavlink://", given, [each.value for each in PoseMessage])
    return PoseMessage(given)


def _camera(uri: VehicleUri) -> CameraOptions | None:
    source = uri.reveal("camera")
    if source is None:
        given = sorted(name for name in uri.options if name.startswith("camera_"))
        if given:
            raise UsageError(f"{uri}: {given[0]} is for a camera: give camera=rtsp://… as well")
        return None
    if not source:
        raise UsageError(f"{uri}: camera is empty; give camera=rtsp://192.168.1.10/live or camera=/dev/video0")
    name, facing = uri.options.get("camera_name", "front"), uri.options.get("camera_facing", "forward")
    if facing not in FACINGS:
        raise UnknownNameError("camera_facing of mavlink://", facing, FACINGS)
    if not 1 <= len(name) <= 64:
        raise UsageError(f"{uri}: a camera name must have 1 to 64 characters")
    return CameraOptions(
        source=source,
        name=name,
        width=uri.whole("camera_width", 640, minimum=1, maximum=16384),
        height=uri.whole("camera_height", 480, minimum=1, maximum=16384),
        fps=uri.number("camera_fps", 30.0, minimum=0.1, maximum=1000.0),
        facing=facing,
        stream=uri.flag("camera_stream", default=True),
    )


def takeoff_height(values: Mapping[str, float]) -> float:
    """Return the height of the next take-off [m], capped at the ceiling."""
    return min(values[TAKEOFF_ALTITUDE], values[ALTITUDE])


def limits_text(values: Mapping[str, float]) -> str:
    """Return a readable sentence that describes the limits in force."""
    speed, climb, altitude = (values[name] for name in ("limits.speed", "limits.climb", ALTITUDE))
    return (
        f"limits: {speed:g} m/s, {climb:g} m/s up and down, {altitude:g} m high; raise them with the parameters "
        "limits.speed, limits.climb and limits.altitude, or in the address (?speed=…&climb=…&altitude=…)"
    )


def camera_info(uri: VehicleUri, options: CameraOptions) -> CameraInfo:
    """Return the camera as announced before the first frame: network cameras are assumed to send H.264."""
    return CameraInfo(
        options.name,
        options.width,
        options.height,
        options.fps,
        intrinsics=intrinsics_of(uri, options.width, options.height),
        rotation=FACINGS[options.facing],
        stream=H264 if options.stream and source(uri, options).scheme else "",
    )


def source(uri: VehicleUri, options: CameraOptions) -> CameraSource:
    """Return the source of the camera's video: a stream or a device."""
    return source_of(options.source, f"{uri}: camera")


def camera_receiver(uri: VehicleUri, options: CameraOptions, sink: Sink) -> LiveCamera:
    """Return a receiver for the camera; the receiver is not started yet."""
    settings = LiveCameraSettings(
        source(uri, options),
        options.name,
        options.width,
        options.height,
        options.fps,
        stream=options.stream,
        purpose="a camera beside the autopilot",
    )
    return LiveCamera(settings, sink, partial(intrinsics_of, uri))
