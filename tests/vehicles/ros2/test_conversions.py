"""Numbers of ROS 2's messages, without rclpy: messages are any objects with their fields."""

from __future__ import annotations

import math
import struct
from array import array
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.messages import Encoding, Intrinsics
from skyloop.messages.geometry import quaternion_from_euler, rotation_from_euler
from skyloop.vehicles.ros2.wire import (
    ENCODINGS,
    NOT_KNOWN,
    ClockMap,
    Transform,
    body_velocity,
    camera_model,
    covariance,
    encode_transforms,
    euler_of,
    intrinsics_of,
    levelled_velocity,
    nanoseconds_of,
    pixels_of,
    quaternion_of,
    rotation_of,
    stamp_of,
)
from skyloop.vision import unproject

ANGLE = st.floats(-math.pi, math.pi)
TILT = st.floats(-1.5, 1.5)
SPEED = st.floats(-20, 20)
MS = 1_000_000


@given(st.integers(0, 2**62))
def test_stamps_go_both_ways(ns: int) -> None:
    sec, nanosec = stamp_of(ns)
    assert 0 <= nanosec < 10**9
    assert nanoseconds_of(SimpleNamespace(sec=sec, nanosec=nanosec)) == ns


@given(TILT, TILT, ANGLE)
def test_quaternions_are_the_rotation_of_the_angles(roll: float, pitch: float, yaw: float) -> None:
    turn = rotation_from_euler(roll, pitch, yaw)
    of_angles = quaternion_from_euler(roll, pitch, yaw)
    of_matrix = quaternion_of(tuple(turn.ravel()))
    assert math.hypot(*of_matrix) == pytest.approx(1.0)
    for quaternion in (of_angles, of_matrix):
        rotation = rotation_of(quaternion)
        assert rotation is not None
        assert rotation == pytest.approx(turn, abs=1e-9)
    angles = euler_of(of_matrix)
    assert angles is not None
    assert angles == pytest.approx((roll, pitch, yaw), abs=1e-6)


@pytest.mark.parametrize(
    "rows", [(1, 0, 0, 0, -1, 0, 0, 0, -1), (-1, 0, 0, 0, 1, 0, 0, 0, -1), (-1, 0, 0, 0, -1, 0, 0, 0, 1)]
)
def test_half_turns_are_also_rotations(rows: tuple[float, ...]) -> None:
    rotation = rotation_of(quaternion_of(rows))
    assert rotation is not None
    assert rotation.ravel() == pytest.approx(rows)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 1.0)])
def test_an_invalid_quaternion_gives_no_angles(quaternion: tuple[float, float, float, float]) -> None:
    assert euler_of(quaternion) is None


@given(st.tuples(SPEED, SPEED, SPEED), TILT, TILT)
def test_velocities_go_both_ways(velocity: tuple[float, float, float], roll: float, pitch: float) -> None:
    body = body_velocity(velocity, roll, pitch)
    assert math.hypot(*body) == pytest.approx(math.hypot(*velocity), abs=1e-9)
    assert levelled_velocity(body, roll, pitch) == pytest.approx(velocity, abs=1e-9)


def test_a_body_with_its_nose_down_flies_up_in_its_own_axes_when_it_flies_level() -> None:
    forward, _, up = body_velocity((1.0, 0.0, 0.0), 0.0, math.radians(30.0))
    assert forward == pytest.approx(math.cos(math.radians(30.0)))
    assert up == pytest.approx(math.sin(math.radians(30.0)))


def test_unknown_values_have_a_covariance_of_minus_one() -> None:
    assert covariance(3, known=False) == [NOT_KNOWN, *[0.0] * 8]
    assert covariance(2, variance=4.0) == [4.0, 0.0, 0.0, 4.0]


def test_stamps_keep_their_distance_while_the_clocks_do() -> None:
    clocks = ClockMap()
    assert clocks.to_ros(5, 10, 0) is None  # ROS time is not known yet
    assert clocks.to_ros(1000 * MS, 1010 * MS, 5010 * MS) == 5000 * MS
    assert clocks.to_ros(1030 * MS, 1040 * MS, 5040 * MS + 300_000) == 5030 * MS  # 0.3 ms off: the same offset
    assert clocks.to_ros(1060 * MS, 1070 * MS, 9070 * MS) == 9060 * MS  # the system's clock was set
    assert clocks.to_ros(0, 9000 * MS, 1 * MS) is None  # before the start of a simulation


@pytest.mark.parametrize(
    ("intrinsics", "model", "many"),
    [
        (Intrinsics(300.0, 301.0, 159.5, 119.5), "plumb_bob", 5),
        (Intrinsics(300.0, 301.0, 159.5, 119.5, (0.1, -0.2, 0.0, 0.001)), "plumb_bob", 5),
        (Intrinsics(300.0, 301.0, 159.5, 119.5, (0.1,) * 8), "rational_polynomial", 8),
        (Intrinsics(300.0, 301.0, 159.5, 119.5, (0.1, 0.2, 0.3, 0.4), "fisheye"), "equidistant", 4),
    ],
)
def test_intrinsics_go_both_ways(intrinsics: Intrinsics, model: str, many: int) -> None:
    told = camera_model(intrinsics)
    assert (told.model, len(told.d)) == (model, many)
    assert told.p[0] == told.k[0] == 300.0
    back = intrinsics_of(SimpleNamespace(distortion_model=told.model, d=told.d, k=told.k))
    assert back is not None
    assert back.matrix == pytest.approx(intrinsics.matrix)
    assert back.model == intrinsics.model
    assert back.distortion[: len(intrinsics.distortion)] == intrinsics.distortion


def test_a_camera_without_intrinsics_is_reported_as_uncalibrated() -> None:
    told = camera_model(None)
    assert (told.model, told.d, told.k[0]) == ("", [], 0.0)
    assert intrinsics_of(SimpleNamespace(distortion_model="", d=[], k=told.k)) is None


def image(encoding: str, channels: int, padding: int = 0) -> SimpleNamespace:
    height, width = 2, 3
    rows = [bytes(range(10 * y, 10 * y + width * channels)) + b"\xff" * padding for y in range(height)]
    data = array("B", b"".join(rows))
    return SimpleNamespace(encoding=encoding, height=height, width=width, step=width * channels + padding, data=data)


def test_pixels_lose_their_padding() -> None:
    pixels, encoding = pixels_of(image("rgb8", 3, padding=5))
    assert encoding is Encoding.RGB8
    assert pixels.shape == (2, 3, 3)
    assert pixels.flags.c_contiguous
    assert pixels[1, 0].tolist() == [10, 11, 12]
    grey, encoding = pixels_of(image("mono8", 1))
    assert (grey.shape, encoding) == ((2, 3), Encoding.MONO8)


def test_pixels_with_transparency_become_blue_green_red() -> None:
    pixels, encoding = pixels_of(image("rgba8", 4))
    assert encoding is Encoding.BGR8
    assert pixels[0, 1].tolist() == [6, 5, 4]
    assert pixels_of(image("bgra8", 4))[0][0, 1].tolist() == [4, 5, 6]


def test_other_pixels_are_refused() -> None:
    with pytest.raises(DecodeError, match="encoding '32FC1' are not supported, only bgr8"):
        pixels_of(image("32FC1", 4))
    short = image("bgr8", 3)
    short.height = 3
    with pytest.raises(DecodeError, match="can't have 18 bytes"):
        pixels_of(short)


def packed(encoding: str, rows: np.ndarray[Any, Any], width: int, height: int, padding: int = 4) -> SimpleNamespace:
    """Return an image of these bytes, with padding at the end of each row."""
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    return SimpleNamespace(
        encoding=encoding, height=height, width=width, step=padded.shape[1], data=padded.tobytes(), is_bigendian=0
    )


def as_camera(encoding: str, picture: np.ndarray[Any, Any]) -> SimpleNamespace:
    """Return a BGR picture in a camera's encoding."""
    height, width = picture.shape[:2]
    blue, green, red = (picture[..., n].astype(np.uint8) for n in range(3))
    if encoding.startswith("bayer_"):
        pattern = encoding[6:10]
        planes = {"r": red, "g": green, "b": blue}
        mosaic = np.empty((height, width), np.uint8)
        for n, letter in enumerate(pattern):
            mosaic[n // 2 :: 2, n % 2 :: 2] = planes[letter][n // 2 :: 2, n % 2 :: 2]
        if encoding.endswith("16"):
            mosaic = (mosaic.astype("<u2") << 8).view(np.uint8)
        return packed(encoding, mosaic, width, height)
    planar = cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420)
    luma, chroma = planar[:height], planar[height:].reshape(2, height // 2, width // 2)
    if encoding in ("nv12", "nv21"):
        order = chroma if encoding == "nv12" else chroma[::-1]
        return packed(encoding, np.vstack([luma, np.dstack(list(order)).reshape(height // 2, width)]), width, height)
    us, vs = (plane.repeat(2, axis=0) for plane in chroma)
    pairs = np.empty((height, width // 2, 4), np.uint8)
    places = (0, 1, 2, 3) if encoding in ("yuv422_yuy2", "yuyv") else (1, 0, 3, 2)
    for place, plane in zip(places, (luma[:, ::2], us, luma[:, 1::2], vs), strict=True):
        pairs[..., place] = plane
    return packed(encoding, pairs.reshape(height, -1), width, height)


PLAIN = {"bgr8", "8UC3", "rgb8", "mono8", "8UC1", "bgra8", "8UC4", "rgba8", "mono16"}


@pytest.mark.parametrize("encoding", sorted({*ENCODINGS} - PLAIN))
def test_usual_camera_encodings_become_blue_green_red(encoding: str) -> None:
    """``yuv422_yuy2`` is the default of usb_cam."""
    picture = np.zeros((24, 32, 3), np.uint8)
    picture[:12, :16], picture[:12, 16:], picture[12:, :16] = (200, 60, 40), (40, 200, 60), (60, 40, 200)
    pixels, read_as = pixels_of(as_camera(encoding, picture))
    assert (read_as, pixels.shape) == (Encoding.BGR8, picture.shape)
    assert pixels.dtype == np.uint8
    assert pixels.flags.c_contiguous
    for y, x in ((6, 8), (6, 24), (18, 8), (18, 24)):
        assert pixels[y, x].astype(int) == pytest.approx(picture[y, x].astype(int), abs=8), (y, x)


def test_sixteen_bits_of_grey_become_eight() -> None:
    grey = np.array([[0x1234, 0xFF00], [0x00FF, 0x8000]], "<u2")
    little = packed("mono16", grey.view(np.uint8), 2, 2)
    pixels, read_as = pixels_of(little)
    assert read_as is Encoding.MONO8
    assert pixels.tolist() == [[0x12, 0xFF], [0x00, 0x80]]
    big = packed("mono16", grey.astype(">u2").view(np.uint8), 2, 2)
    big.is_bigendian = 1
    assert pixels_of(big)[0].tolist() == pixels.tolist()


def test_an_image_that_cannot_be_halved_is_refused() -> None:
    with pytest.raises(DecodeError, match="can't be converted"):
        pixels_of(packed("nv12", np.zeros((5, 3), np.uint8), 3, 3))


@pytest.mark.parametrize(
    ("model", "given", "kept"),
    [
        ("plumb_bob", [0.1, 0.2], (0.1, 0.2, 0.0, 0.0)),
        ("plumb_bob", [0.1] * 6, (*[0.1] * 6, 0.0, 0.0)),
        ("rational_polynomial", [0.1] * 7, (*[0.1] * 7, 0.0)),
        ("plumb_bob", [0.1, 0.2, 0.0, 0.0, 0.0], (0.1, 0.2, 0.0, 0.0)),
        ("equidistant", [0.1, 0.2, 0.3, 0.4, 0.0], (0.1, 0.2, 0.3, 0.4)),
        ("equidistant", [0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], (0.1, 0.2, 0.0, 0.0)),
        ("", [], ()),
    ],
)
def test_the_number_of_coefficients_suits_opencv(model: str, given: list[float], kept: tuple[float, ...]) -> None:
    """With 2, 6 or 7 of them, the first use once raised in the application's own callback."""
    k = [300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0]
    found = intrinsics_of(SimpleNamespace(distortion_model=model, d=given, k=k))
    assert found is not None
    assert found.distortion == kept
    assert np.isfinite(unproject([[200.0, 100.0]], found)).all()


@pytest.mark.parametrize(("model", "given"), [("equidistant", [0.1] * 5), ("omni", [0.1]), ("plumb_bob", [0.1] * 15)])
def test_an_unknown_lens_is_refused_on_arrival(model: str, given: list[float]) -> None:
    k = [300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0]
    with pytest.raises(DecodeError, match=model):
        intrinsics_of(SimpleNamespace(distortion_model=model, d=given, k=k))


def test_transforms_as_the_bytes_of_their_type() -> None:
    """As written and read by rclpy 9.1.2; ``third_party/test_ros2.py`` reads them with rosbags."""
    packed = encode_transforms([Transform(5 * 10**9 + 6, "odom", "base_link", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))])
    head = b"\x00\x01\x00\x00" + struct.pack("<IiI", 1, 5, 6)
    texts = struct.pack("<I", 5) + b"odom\0\0\0\0" + struct.pack("<I", 10) + b"base_link\0" + b"\0\0" * 1
    assert packed[: len(head)] == head
    assert packed[len(head) : len(head) + len(texts)] == texts
    assert packed[-56:] == struct.pack("<7d", 1, 2, 3, 0, 0, 0, 1)
    assert (len(packed) - 4 - 56) % 8 == 0  # numbers of eight bytes are aligned


@given(st.lists(st.text(min_size=0, max_size=9), min_size=1, max_size=4))
def test_each_transform_begins_aligned(names: list[str]) -> None:
    packed = encode_transforms([Transform(0, name, name, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0)) for name in names])
    assert struct.unpack_from("<I", packed, 4) == (len(names),)
    assert len(packed) % 4 == 0
