"""Addresses of MAVLink vehicles."""

from __future__ import annotations

from pathlib import Path

import pytest

from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError
from skyloop.vehicles.mavlink.driver import MavlinkDriver
from skyloop.vehicles.mavlink.options import ConnectionKind, MavlinkOptions, options_of


def understood(text: str) -> MavlinkOptions:
    return options_of(parse_uri(text))


@pytest.mark.parametrize(
    ("text", "way", "place", "number"),
    [
        ("mavlink://udpin:127.0.0.1:14540", ConnectionKind.UDP_IN, "127.0.0.1", 14540),
        ("mavlink://udpout:drone.local:14580", ConnectionKind.UDP_OUT, "drone.local", 14580),
        ("mavlink://udpin:[::]:14550", ConnectionKind.UDP_IN, "::", 14550),
        ("mavlink://udpout:[fe80::1%eth0]:14580", ConnectionKind.UDP_OUT, "fe80::1%eth0", 14580),
        ("mavlink://tcp:[::1]:5760", ConnectionKind.TCP, "::1", 5760),
        ("mavlink://tcp:192.168.4.1:5760", ConnectionKind.TCP, "192.168.4.1", 5760),
        ("mavlink://serial:/dev/ttyACM0:921600", ConnectionKind.SERIAL, "/dev/ttyACM0", 921600),
        ("mavlink://serial:/dev/serial/by-id/usb-x@1:9600", ConnectionKind.SERIAL, "/dev/serial/by-id/usb-x@1", 9600),
        ("mavlink://serial:/dev/ttyACM0", ConnectionKind.SERIAL, "/dev/ttyACM0", 57600),
        ("mavlink://serial:COM3", ConnectionKind.SERIAL, "COM3", 57600),
        (r"mavlink://serial:\\.\com12:115200", ConnectionKind.SERIAL, "COM12", 115200),
    ],
)
def test_connections(text: str, way: ConnectionKind, place: str, number: int) -> None:
    address = understood(text).address
    assert (address.kind, address.place, address.number) == (way, place, number)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("mavlink://", "none of udpin, udpout, tcp, serial"),
        ("mavlink://127.0.0.1:14540", "none of udpin"),
        ("mavlink://udpin:127.0.0.1", "names no host or device"),
        ("mavlink://tcp:127.0.0.1:99999", "names no host or device"),
        ("mavlink://serial:", "names no host or device"),
        ("mavlink://udpin:[::x]:14550", "names no host or device"),
        ("mavlink://udpin:::14550", "names no host or device"),
        ("mavlink://udpin:[::]:14550?component=0", "component"),
        ("mavlink://udpin:0.0.0.0:14550?sysid=0", "sysid"),
        ("mavlink://udpin:0.0.0.0:14550?sysid=255", "must differ"),
        ("mavlink://udpin:0.0.0.0:14550?peer=here", "peer=127.0.0.1:14580"),
        ("mavlink://udpin:0.0.0.0:14550?sped=1", "speed"),
        ("mavlink://udpin:0.0.0.0:14550?speed=99", "speed"),
        ("mavlink://udpin:0.0.0.0:14550?takeoff_altitude=8", "above the ceiling of 3 m: raise that too"),
        ("mavlink://udpin:0.0.0.0:14550?origin=91,0,0", "origin"),
        ("mavlink://udpin:0.0.0.0:14550?world_origin=47", "world_origin=47.3977,8.5456,488"),
        ("mavlink://udpin:0.0.0.0:14550?pose=mocap", "odometry"),
        ("mavlink://udpin:0.0.0.0:14550?signing_key=/nowhere", "can't be read"),
        ("mavlink://udpin:0.0.0.0:14550?camera_fps=30", "give camera="),
        ("mavlink://udpin:0.0.0.0:14550?camera=", "camera is empty"),
        ("mavlink://udpin:0.0.0.0:14550?camera=picture.jpg", "must be one of rtsp"),
        ("mavlink://udpin:0.0.0.0:14550?camera=/dev/video0&camera_facing=up", "camera_facing"),
    ],
)
def test_invalid_options_are_refused_with_valid_ones(text: str, what: str) -> None:
    with pytest.raises(UsageError) as caught:
        MavlinkDriver(parse_uri(text))
    assert what in str(caught.value)


@pytest.mark.parametrize("held", [bytes(range(32)), bytes(range(32)).hex().encode() + b"\n"])
def test_a_signing_key_is_read_from_a_file(tmp_path: Path, held: bytes) -> None:
    file = tmp_path / "key"
    file.write_bytes(held)
    assert understood(f"mavlink://udpin:0.0.0.0:14550?signing_key={file}").key == bytes(range(32))
    file.write_bytes(b"short")
    with pytest.raises(UsageError, match="64 hexadecimal digits"):
        understood(f"mavlink://udpin:0.0.0.0:14550?signing_key={file}")


def test_a_camera() -> None:
    text = "mavlink://udpin:0.0.0.0:14550?camera=rtsp://10.0.0.2:8554/live&camera_facing=down&camera_name=belly"
    camera = understood(text).camera
    assert camera is not None
    assert (camera.source, camera.name) == ("rtsp://10.0.0.2:8554/live", "belly")
    (info,) = MavlinkDriver(parse_uri(text)).capabilities().cameras
    assert info.rotation is not None
    assert info.rotation[6:] == (0.0, 0.0, -1.0)
