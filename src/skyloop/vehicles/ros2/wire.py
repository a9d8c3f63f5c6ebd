"""Conversions between the values in ROS 2 messages and Skyloop's. Pure.

Both use the same axes (REP 103): body x forward, y left, z up; world x east, y north, z up; a camera's optical axes x
right, y down, z forward. The differences: Skyloop's velocity is in the body's *levelled* axes, a twist's velocity is in
body axes; ROS 2 expresses angles as quaternions, and marks unknown values with a covariance of -1 or with NaN.

A ``tf2_msgs/msg/TFMessage`` is built as bytes, because its package can be installed only with a ROS 2 distribution. The
format is OMG's Common Data Representation, version 1, little-endian, as in DDS: a four-byte header, then the fields in
order, each number aligned to its size, counted from the end of the header. A string is its length, including the
terminating zero, followed by the text and the zero.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import DecodeError
from skyloop.messages import Encoding, Intrinsics, Vector
from skyloop.messages.geometry import euler_from_rotation, rotation_from_euler

Quaternion = tuple[float, float, float, float]  #: x, y, z, w

NOT_KNOWN: Final = -1.0  #: first covariance element of a quantity that was not measured (sensor_msgs/Imu)
#: Variance reported where none was measured, meaning "about right" rather than "exact" [m², (m/s)², rad² …].
VARIANCE: Final = 0.01

#: Bytes per pixel and their order for each pixel format in ``sensor_msgs/image_encodings.hpp``.
_PIXELS: Final[dict[str, tuple[int, tuple[int, ...] | None, Encoding]]] = {
    "bgr8": (3, None, Encoding.BGR8),
    "8UC3": (3, None, Encoding.BGR8),
    "rgb8": (3, None, Encoding.RGB8),
    "mono8": (1, None, Encoding.MONO8),
    "8UC1": (1, None, Encoding.MONO8),
    "bgra8": (4, (0, 1, 2), Encoding.BGR8),
    "8UC4": (4, (0, 1, 2), Encoding.BGR8),
    "rgba8": (4, (2, 1, 0), Encoding.BGR8),
}


# Time -----------------------------------------------------------------------------------------------------------


def stamp_of(ns: int) -> tuple[int, int]:
    """Return the seconds and nanoseconds for a ``builtin_interfaces/Time``."""
    return divmod(ns, NS_PER_S)


def nanoseconds_of(stamp: Any) -> int:
    """Return a ``builtin_interfaces/Time`` in nanoseconds."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


class ClockMap:
    """Converts times on a proxy's monotonic clock to ROS time.

    The offset between the clocks is kept until its error exceeds ``tolerance_s``, so that the intervals between stamps
    equal the intervals between captures. A larger error means that a clock was set, or that ROS time is simulated.
    """

    def __init__(self, tolerance_s: float = 1e-3) -> None:
        self._tolerance_ns = round(tolerance_s * NS_PER_S)
        self._offset_ns: int | None = None

    def to_ros(self, captured_ns: int, now_ns: int, ros_now_ns: int) -> int | None:
        """Convert a capture time to ROS time [ns]; None if it is unknown or before zero."""
        if ros_now_ns <= 0:
            return None
        offset_ns = ros_now_ns - now_ns
        if self._offset_ns is None or abs(offset_ns - self._offset_ns) > self._tolerance_ns:
            self._offset_ns = offset_ns
        stamp_ns = captured_ns + self._offset_ns
        return stamp_ns if stamp_ns >= 0 else None


# Attitude and velocity -------------------------------------------------------------------------------------------


def rotation_of(quaternion: Quaternion) -> NDArray[np.float64] | None:
    """Return the matrix of a quaternion, shape (3, 3); None if the quaternion is not finite or is almost zero."""
    length = math.sqrt(sum(each * each for each in quaternion))
    if not (math.isfinite(length) and length > 1e-6):
        return None
    x, y, z, w = (each / length for each in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def euler_of(quaternion: Quaternion) -> tuple[float, float, float] | None:
    """Return roll, pitch and yaw of a quaternion [rad]; None if the quaternion is invalid."""
    rotation = rotation_of(quaternion)
    return None if rotation is None else euler_from_rotation(rotation)


def quaternion_of(rotation: tuple[float, ...]) -> Quaternion:
    """Return the unit quaternion for a rotation matrix given row by row (9 numbers).

    Source: S. W. Shepperd, "Quaternion from Rotation Matrix", Journal of Guidance and Control 1(3), 1978.
    """
    r = np.asarray(rotation, dtype=np.float64).reshape(3, 3)
    trace = float(np.trace(r))
    squares = [float(r[i, i]) for i in range(3)] + [trace]
    largest = max(range(4), key=squares.__getitem__)
    if largest == 3:
        found = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1.0 + trace]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        found = [0.0] * 4
        found[i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        found[j] = r[j, i] + r[i, j]
        found[k] = r[k, i] + r[i, k]
        found[3] = r[k, j] - r[j, k]
    length = math.sqrt(sum(float(each) ** 2 for each in found))
    x, y, z, w = (float(each) / length for each in found)
    return x, y, z, w


def body_velocity(levelled: Vector, roll: float, pitch: float) -> Vector:
    """Convert a velocity [m/s] from the body's levelled axes to body axes."""
    x, y, z = rotation_from_euler(roll, pitch, 0.0).T @ np.array(levelled)
    return float(x), float(y), float(z)


def levelled_velocity(body: Vector, roll: float, pitch: float) -> Vector:
    """Convert a velocity [m/s] from body axes to the body's levelled axes."""
    x, y, z = rotation_from_euler(roll, pitch, 0.0) @ np.array(body)
    return float(x), float(y), float(z)


def covariance(size: int, *, known: bool = True, variance: float = VARIANCE) -> list[float]:
    """Return a covariance matrix row by row: ``variance`` on its diagonal, or :data:`NOT_KNOWN` as first element."""
    found = [0.0] * (size * size)
    if not known:
        found[0] = NOT_KNOWN
    else:
        found[:: size + 1] = [variance] * size
    return found


# Cameras ---------------------------------------------------------------------------------------------------------


class RosCameraInfo(NamedTuple):
    """Content of a ``sensor_msgs/CameraInfo``, row by row; all zero if there are no intrinsics, as usual in ROS."""

    model: str
    d: list[float]
    k: list[float]
    r: list[float]
    p: list[float]


def camera_model(intrinsics: Intrinsics | None) -> RosCameraInfo:
    """Return the content of a ``sensor_msgs/CameraInfo`` for a camera's intrinsics."""
    if intrinsics is None:
        return RosCameraInfo("", [], [0.0] * 9, [0.0] * 9, [0.0] * 12)
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    given = list(intrinsics.distortion)
    if intrinsics.model == "fisheye":
        model, many = "equidistant", 4
    elif len(given) <= 5:
        model, many = "plumb_bob", 5
    else:
        model, many = "rational_polynomial", max(8, len(given))
    return RosCameraInfo(
        model,
        given + [0.0] * (many - len(given)),
        [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


#: Possible numbers of coefficients in OpenCV's distortion models for pinhole cameras; missing ones are zero.
_LENGTHS: Final = (0, 4, 5, 8, 12, 14)
_FISHEYES: Final = ("equidistant", "fisheye")
_PINHOLES: Final = ("", "plumb_bob", "rational_polynomial", "thin_prism", "pinhole")


def intrinsics_of(info: Any) -> Intrinsics | None:
    """Return the intrinsics in a ``sensor_msgs/CameraInfo``; None for an uncalibrated camera."""
    k = [float(each) for each in info.k]
    d = [float(each) for each in info.d]
    if not (all(map(math.isfinite, (*k, *d))) and k[0] > 0.0 and k[4] > 0.0):
        return None
    fisheye = info.distortion_model in _FISHEYES
    while d and d[-1] == 0.0:
        del d[-1]
    if d and not fisheye and info.distortion_model not in _PINHOLES:
        known = ", ".join((*_PINHOLES[1:], *_FISHEYES))
        raise DecodeError(f"lens model {info.distortion_model!r} is not supported, only {known}")
    most = 4 if fisheye else _LENGTHS[-1]
    if len(d) > most:
        raise DecodeError(f"lens model {info.distortion_model!r} has at most {most} coefficients, got {len(d)}")
    wanted = (4 if d else 0) if fisheye else next(length for length in _LENGTHS if length >= len(d))
    d += [0.0] * (wanted - len(d))
    return Intrinsics(k[0], k[4], k[2], k[5], tuple(d), "fisheye" if fisheye else "pinhole")


def skew_of(info: Any) -> float:
    """Return the skew in a ``sensor_msgs/CameraInfo`` [px], which :class:`Intrinsics` can't represent."""
    skew = float(info.k[1])
    return skew if math.isfinite(skew) else 0.0


#: Encodings that OpenCV converts to BGR: rows per pixel of height, bytes per pixel of width, and OpenCV's name. ROS
#: names a Bayer pattern after a row's first two pixels, OpenCV after pixels 2 and 3 of the second row.
_CONVERTED: Final[dict[str, tuple[float, int, str]]] = {
    "yuv422": (1, 2, "YUV2BGR_UYVY"),
    "uyvy": (1, 2, "YUV2BGR_UYVY"),
    "yuv422_yuy2": (1, 2, "YUV2BGR_YUY2"),
    "yuyv": (1, 2, "YUV2BGR_YUY2"),
    "nv12": (1.5, 1, "YUV2BGR_NV12"),
    "nv21": (1.5, 1, "YUV2BGR_NV21"),
    **{
        f"bayer_{first}{bits}": (1, bits // 8, f"Bayer{name}2BGR")
        for first, name in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB"))
        for bits in (8, 16)
    },
}
_WIDE: Final = "mono16"
ENCODINGS: Final = (*_PIXELS, _WIDE, *_CONVERTED)


def pixels_of(image: Any) -> tuple[NDArray[np.uint8], Encoding]:
    """Return the pixels of a ``sensor_msgs/Image`` as C-contiguous uint8 without padding, and their encoding.

    16-bit values are reduced to their upper eight bits. Raises :class:`DecodeError` if the encoding is unknown, the
    size does not fit the data, or OpenCV is missing.
    """
    given = image.encoding if image.encoding in _PIXELS else str(image.encoding).lower()
    if given in _PIXELS:
        channels, order, encoding = _PIXELS[given]
        rows, width = _rows(image, 1, channels), int(image.width)
        if order is None:
            shape = (len(rows), width, channels) if channels > 1 else (len(rows), width)
            return np.ascontiguousarray(rows).reshape(shape), encoding
        return np.ascontiguousarray(rows.reshape(len(rows), width, channels)[:, :, order]), encoding
    if given == _WIDE:
        return np.ascontiguousarray(_upper(_rows(image, 1, 2), image)), Encoding.MONO8
    if given not in _CONVERTED:
        raise DecodeError(f"images of encoding {image.encoding!r} are not supported, only {', '.join(ENCODINGS)}")
    high, wide, name = _CONVERTED[given]
    rows = _rows(image, high, wide)
    if given.endswith("16"):
        rows = _upper(rows, image)
    elif wide == 2:
        rows = rows.reshape(len(rows), int(image.width), 2)
    try:
        import cv2
    except ImportError as error:
        raise DecodeError(
            f"images of encoding {image.encoding!r} need OpenCV: pip install opencv-python-headless"
        ) from error
    try:
        found = cv2.cvtColor(np.ascontiguousarray(rows), getattr(cv2, f"COLOR_{name}"))
    except cv2.error as error:  # an odd width or height, which this encoding does not allow
        raise DecodeError(f"an image of {image.width}×{image.height} {image.encoding} can't be converted") from error
    return np.ascontiguousarray(found, dtype=np.uint8), Encoding.BGR8


def _rows(image: Any, high: float, wide: int) -> NDArray[np.uint8]:
    """Return an image's rows without padding: ``high`` rows per row of pixels and ``wide`` bytes per pixel."""
    height, width, step = int(image.height), int(image.width), int(image.step)
    data = np.frombuffer(image.data, np.uint8)
    rows, row = math.ceil(height * high), width * wide
    if not (height > 0 and width > 0 and step >= row and data.size == rows * step):
        raise DecodeError(
            f"an image of {width}×{height} {image.encoding} with step {step} can't have {data.size} bytes"
        )
    return data.reshape(rows, step)[:, :row]


def _upper(rows: NDArray[np.uint8], image: Any) -> NDArray[np.uint8]:
    """Return the upper bytes in rows of 16-bit numbers."""
    return rows[:, 0 if getattr(image, "is_bigendian", 0) else 1 :: 2]


TYPE_NAME: Final = "tf2_msgs/msg/TFMessage"
#: Hash of TFMessage's definition (REP 2011); ``tests/integration/third_party/ros2_bag.py`` compares it with rosbags'.
TYPE_HASH: Final = bytes.fromhex("e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087")
_LITTLE_ENDIAN_CDR: Final = b"\x00\x01\x00\x00"


class Transform(NamedTuple):
    """A ``geometry_msgs/TransformStamped``: the pose of ``child`` in the axes of ``parent``."""

    stamp_ns: int  #: ROS time
    parent: str
    child: str
    translation_m: Vector
    rotation: Quaternion


def encode_transforms(transforms: Iterable[Transform]) -> bytes:
    """Return a ``tf2_msgs/msg/TFMessage`` with these transforms."""
    known = list(transforms)
    packed = bytearray(struct.pack("<I", len(known)))
    for each in known:
        packed += bytes(-len(packed) % 4)
        packed += struct.pack("<iI", *stamp_of(each.stamp_ns))
        for text in (each.parent, each.child):
            encoded = text.encode() + b"\0"
            packed += bytes(-len(packed) % 4)
            packed += struct.pack("<I", len(encoded)) + encoded
        packed += bytes(-len(packed) % 8)
        packed += struct.pack("<7d", *each.translation_m, *each.rotation)
    return _LITTLE_ENDIAN_CDR + bytes(packed)
