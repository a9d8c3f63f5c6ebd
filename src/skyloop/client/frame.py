"""Frames for applications: NumPy arrays with their camera, their times, and the vehicle's state at capture."""

from __future__ import annotations

import math
import struct
import threading
import time
import weakref
import zlib
from bisect import bisect_left
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, Literal, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.clock import Clock
from skyloop.errors import DecodeError, MissingExtraError
from skyloop.messages import Encoding, Feedback, FrameHeader, Intrinsics, Vector
from skyloop.messages.frame import image_size, why_not_decoded
from skyloop.messages.subscription import VideoRequest
from skyloop.transport.frame_encoding import encode_frame, resized, scaled_header

if TYPE_CHECKING:
    from skyloop.transport.base import Pixels

    _Base = NDArray[np.uint8]
else:
    _Base = np.ndarray

HISTORY_DEPTH: Final = 256  #: number of feedback samples kept: 8 s at 32 Hz
_PNG_LEVEL: Final = 1  #: fastest compression: notebooks display images immediately and rarely keep them
_ATTRIBUTES: Final = frozenset(
    {"camera", "seq", "captured_ns", "published_ns", "received_ns", "intrinsics", "header", "age_s"}
    | {"feedback", "feedback_reach_s"}
)
_THE_IMAGE: Final = frozenset({"image", "img", "pixels", "array"})  #: names other libraries use for the image


class Frame(_Base):
    """An image as a read-only BGR array of shape (height, width, 3) and dtype uint8; draw on ``frame.copy()``.

    It is a NumPy array, so NumPy and OpenCV accept it directly. Where a plain array is required,
    ``numpy.asarray(frame)`` returns the same memory without the attributes below. Where possible, the frame uses the
    transport's memory directly, without a copy. Slices, copies and results of arithmetic are plain arrays or lack the
    attributes below. Times [ns] are ``captured_ns`` (middle of the exposure) and ``published_ns`` on the proxy's clock,
    ``received_ns`` on this host's.
    """

    _arrival: ReceivedFrame

    @property
    def header(self) -> FrameHeader:
        """The header received with the pixels."""
        return self._arrival.header

    @property
    def camera(self) -> str:
        """Name of the camera."""
        return self._arrival.header.camera

    @property
    def seq(self) -> int:
        """Sequence number, which increases by one with each frame of the camera, including dropped ones."""
        return self._arrival.header.seq

    @property
    def captured_ns(self) -> int:
        """Middle of the exposure, on the proxy's clock [ns]."""
        return self._arrival.header.captured_ns

    @property
    def published_ns(self) -> int:
        """Time at which the proxy received the frame, on the proxy's clock [ns]."""
        return self._arrival.header.published_ns

    @property
    def received_ns(self) -> int:
        """Time at which this process received the frame, on this host's clock [ns]."""
        return self._arrival.received_ns

    @property
    def intrinsics(self) -> Intrinsics | None:
        """Intrinsics of the camera in pixels of this frame; None if unknown."""
        return self._arrival.header.intrinsics

    @property
    def age_s(self) -> float:
        """Time since the capture [s]."""
        return self._arrival.age_s

    @property
    def feedback(self) -> Feedback | None:
        """The vehicle's state at the time of capture, interpolated between the samples before and after it.

        Until the later sample arrives, the earlier one is used unchanged (:attr:`feedback_reach_s`). None if unknown.
        """
        return self._arrival.state_at_capture()[0]

    @property
    def feedback_reach_s(self) -> float | None:
        """Time from the capture to the farther sample used for :attr:`feedback` [s]; None if there are no samples."""
        return self._arrival.state_at_capture()[1]

    def copy(self, order: Literal["K", "A", "C", "F"] | None = "C") -> NDArray[np.uint8]:  # type: ignore[override]
        """Return a writable plain array with the same pixels, for drawing; ``order`` is that of :func:`numpy.copy`."""
        return self.view(np.ndarray).copy(order)

    def _repr_png_(self) -> bytes | None:
        """Return the image as PNG for display in a notebook; None for a slice that is not an image."""
        return png(np.asarray(self))

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        """Return results of arithmetic as plain arrays or numbers."""
        plain = np.asarray(array)
        return plain if plain.ndim else plain[()]

    def __getattr__(self, name: str) -> NoReturn:
        if name in _ATTRIBUTES or name == "_arrival":
            raise AttributeError(
                f"this array was derived from a frame and has no {name}: only the delivered frame has it"
            )
        if name in _THE_IMAGE:  # without ``obj``, Python doesn't append a wrong suggestion ("imag")
            raise AttributeError(f"a frame has no {name}: it is the image itself, a NumPy array", name=name)
        raise AttributeError(f"a frame has no attribute {name!r}")


def png(image: NDArray[Any]) -> bytes | None:
    """Encode a uint8 image as PNG, BGR (height, width, 3) or grey (height, width); return None for any other."""
    grey = image.ndim == 2
    if image.dtype != np.uint8 or not image.size or not (grey or (image.ndim == 3 and image.shape[2] == 3)):
        return None
    height, width = image.shape[:2]
    rows = np.zeros((height, 1 + width * (1 if grey else 3)), np.uint8)  # each row begins with its filter type: none
    rows[:, 1:] = (image if grey else image[:, :, ::-1]).reshape(height, -1)
    head = struct.pack(">IIBBBBB", width, height, 8, 0 if grey else 2, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), _PNG_LEVEL)), (b"IEND", b""))
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


class ReceivedFrame:
    """A received frame. The first consumer that needs the image decodes it for all consumers, in its own thread."""

    __slots__ = (
        "_clock",
        "_frame",
        "_full",
        "_history",
        "_image",
        "_lock",
        "_offset_ns",
        "_pixels",
        "_state",
        "header",
        "received_ns",
    )

    def __init__(
        self,
        header: FrameHeader,
        pixels: Pixels,
        received_ns: int,
        offset_ns: int,
        history: FeedbackHistory,
        clock: Clock = time.monotonic_ns,
        scale: float = 1.0,
    ) -> None:
        """Store a frame received at ``received_ns`` on ``clock``; adding ``offset_ns`` gives the proxy's time.

        ``history`` provides the vehicle's state at the time of capture. If a frame is larger than its consumer
        requested, decoding multiplies its width and height by ``scale``.
        """
        self.header = self._full = header
        if scale != 1.0:
            small = scaled_header(header, scale)
            size = small.width * small.height * 3
            self.header = msgspec.structs.replace(small, encoding=Encoding.BGR8, size=size)
        self.received_ns = received_ns
        self._pixels: Pixels | None = pixels
        self._image: NDArray[np.uint8] | None = None
        self._offset_ns = offset_ns
        self._history = history
        self._clock = clock
        self._lock = threading.Lock()
        self._frame: weakref.ref[Frame] | None = None
        self._state: tuple[Feedback | None, float | None] | None = None

    @property
    def age_s(self) -> float:
        """Time since the capture [s]."""
        return (self._clock() + self._offset_ns - self.header.captured_ns) / 1e9

    def as_came(self) -> Pixels | None:
        """Return the bytes as received, shape (size,); None once the image has been decoded or if it is scaled down."""
        with self._lock:
            return self._pixels if self._full is self.header else None

    def frame(self) -> Frame:
        """Return the frame, decoded on the first call. Raises the errors of :func:`to_bgr`."""
        with self._lock:
            frame = self._frame() if self._frame is not None else None
            if frame is not None:
                return frame
            if self._image is None:
                assert self._pixels is not None
                image = to_bgr(self._full, self._pixels)
                self._image = image if self._full is self.header else resized(image, self.header)
                self._image.flags.writeable = False
                self._pixels = None
            frame = self._image.view(Frame)
            frame._arrival = self
            self._frame = weakref.ref(frame)  # a weak reference avoids a cycle: the frame refers to this object
            return frame

    def state_at_capture(self) -> tuple[Feedback | None, float | None]:
        """Return the vehicle's state at the time of capture, and its reach [s] (see :attr:`Frame.feedback_reach_s`).

        The look-up is repeated until there is a sample before and a sample after the capture.
        """
        if self._state is not None:
            return self._state
        feedback, reach_s, final = self._history.at(self.header.captured_ns)
        if final:
            self._state = feedback, reach_s
        return feedback, reach_s


def compressed(frame: Frame, quality: int = 95) -> ReceivedFrame:
    """Return a frame compressed as a JPEG, for storing many frames; :meth:`ReceivedFrame.frame` decodes it.

    Raises :class:`MissingExtraError` if OpenCV is not installed, or :class:`LinkError` if encoding fails.
    """
    from_ = frame._arrival
    plain = msgspec.structs.replace(frame.header, encoding=Encoding.BGR8, size=frame.size)
    request = VideoRequest(frame.camera, encoding="jpeg", quality=quality)
    header, jpeg = encode_frame(plain, np.asarray(frame).reshape(-1), request)
    pixels = np.frombuffer(jpeg, np.uint8)
    return ReceivedFrame(header, pixels, from_.received_ns, from_._offset_ns, from_._history, from_._clock)


def to_bgr(header: FrameHeader, pixels: Pixels) -> NDArray[np.uint8]:
    """Convert a frame's bytes to BGR, shape (height, width, 3), uint8; bytes that are already BGR are not copied.

    For a JPEG, raises :class:`DecodeError` if it is damaged or does not have the size in the header, and
    :class:`MissingExtraError` if OpenCV is not installed.
    """
    height, width = header.height, header.width
    encoding = header.encoding
    if encoding is Encoding.BGR8:
        return pixels.reshape(height, width, 3)
    if encoding is Encoding.RGB8:
        return np.ascontiguousarray(pixels.reshape(height, width, 3)[:, :, ::-1])
    if encoding is Encoding.MONO8:
        return np.repeat(pixels.reshape(height, width, 1), 3, axis=2)
    return _decode_jpeg(header, pixels)


def _decode_jpeg(header: FrameHeader, pixels: Pixels) -> NDArray[np.uint8]:
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("reading JPEG frames", "vision", cause=str(error)) from None
    image: Any = None
    if image_size(pixels.data) == (header.width, header.height) and not why_not_decoded(pixels.data):
        with suppress(cv2.error):
            image = cv2.imdecode(pixels, cv2.IMREAD_COLOR)
    if image is None or image.shape != (header.height, header.width, 3):
        raise DecodeError(f"frame {header.seq} of {header.camera} is not a JPEG of {header.width} × {header.height}")
    result: NDArray[np.uint8] = image
    return result


class FeedbackHistory:
    """The newest feedback samples, ordered by capture time. One thread adds samples; any thread may read."""

    def __init__(self, depth: int = HISTORY_DEPTH) -> None:
        self._samples: deque[Feedback] = deque(maxlen=depth)

    def add(self, sample: Feedback) -> None:
        """Add a sample; if it is older than the newest (because the proxy was restarted), start a new history."""
        samples = self._samples
        if samples and sample.captured_ns < samples[-1].captured_ns:
            samples.clear()
        samples.append(sample)

    def at(self, captured_ns: int) -> tuple[Feedback | None, float | None, bool]:
        """Return the state at a time on the proxy's clock, its reach [s], and whether samples exist on both sides.

        The reach is the time from ``captured_ns`` to the farther of the samples used. If samples exist on only one
        side, the state is the nearest sample unchanged; without any samples, state and reach are None.
        """
        samples = list(self._samples)
        if not samples:
            return None, None, False
        after = bisect_left(samples, captured_ns, key=lambda sample: sample.captured_ns)
        if after < len(samples) and samples[after].captured_ns == captured_ns:
            return samples[after], 0.0, True
        if after in (0, len(samples)):
            nearest = samples[0] if after == 0 else samples[-1]
            return nearest, abs(nearest.captured_ns - captured_ns) / 1e9, False
        a, b = samples[after - 1], samples[after]
        reach_ns = max(captured_ns - a.captured_ns, b.captured_ns - captured_ns)
        return interpolate(a, b, captured_ns), reach_ns / 1e9, True


def interpolate(a: Feedback, b: Feedback, captured_ns: int) -> Feedback:
    """Interpolate the state at a time linearly between two samples; angles turn the shorter way round.

    Fields that only one sample has, or that can't be interpolated (states, names), are taken from the nearer sample.
    """
    share = (captured_ns - a.captured_ns) / (b.captured_ns - a.captured_ns)
    nearer = a if share < 0.5 else b
    return msgspec.structs.replace(
        nearer,
        captured_ns=captured_ns,
        battery=_number(a.battery, b.battery, share),
        battery_v=_number(a.battery_v, b.battery_v, share),
        roll_rad=_angle(a.roll_rad, b.roll_rad, share),
        pitch_rad=_angle(a.pitch_rad, b.pitch_rad, share),
        yaw_rad=_angle(a.yaw_rad, b.yaw_rad, share),
        altitude_m=_number(a.altitude_m, b.altitude_m, share),
        velocity_m_s=_vector(a.velocity_m_s, b.velocity_m_s, share),
        angular_velocity_rad_s=_vector(a.angular_velocity_rad_s, b.angular_velocity_rad_s, share),
        acceleration_m_s2=_vector(a.acceleration_m_s2, b.acceleration_m_s2, share),
        position_m=_vector(a.position_m, b.position_m, share),
    )


def _number(a: float | None, b: float | None, share: float) -> float | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    return a + (b - a) * share


def _angle(a: float | None, b: float | None, share: float) -> float | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    turn = math.remainder(b - a, math.tau)  # within [-π, π], which is the shorter way round
    return math.remainder(a + turn * share, math.tau)


def _vector(a: Vector | None, b: Vector | None, share: float) -> Vector | None:
    if a is None or b is None:
        return a if share < 0.5 else b
    return (a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, a[2] + (b[2] - a[2]) * share)
