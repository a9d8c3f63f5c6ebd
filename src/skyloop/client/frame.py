"""Frames as an application sees them: NumPy arrays that know where and when they were taken."""

from __future__ import annotations

import threading
import time
import weakref
from typing import TYPE_CHECKING, Any, Final, Literal, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.clock import Clock
from skyloop.errors import DecodeError, MissingExtraError
from skyloop.messages import Encoding, Feedback, FrameHeader, Intrinsics
from skyloop.transport.pictures import resized, scaled_header

if TYPE_CHECKING:
    from skyloop.client.history import FeedbackHistory
    from skyloop.transport.base import Pixels

    _Base = NDArray[np.uint8]
else:
    _Base = np.ndarray

_CHANNELS: Final = {Encoding.BGR8: 3, Encoding.RGB8: 3, Encoding.MONO8: 1}
_ATTRIBUTES: Final = frozenset(
    {"camera", "seq", "captured_ns", "published_ns", "received_ns", "intrinsics", "header", "age_s"}
    | {"feedback", "feedback_reach_s", "image"}
)


class Frame(_Base):
    """One picture: BGR, shape (height, width, 3), uint8, read-only; draw on ``frame.copy()``.

    It is the memory into which the transport received it wherever that is possible, without a copy. Slices, copies and
    results of arithmetic do not have the attributes below. Times are in ns: ``captured_ns`` (middle of the
    exposure) and ``published_ns`` on the proxy's clock, ``received_ns`` on this host's.
    """

    _arrival: Arrival

    @property
    def header(self) -> FrameHeader:
        """What came with the pixels."""
        return self._arrival.header

    @property
    def camera(self) -> str:
        """Name of the camera."""
        return self._arrival.header.camera

    @property
    def seq(self) -> int:
        """Grows by one with each frame that the camera gave."""
        return self._arrival.header.seq

    @property
    def captured_ns(self) -> int:
        """Middle of the exposure, on the proxy's clock [ns]."""
        return self._arrival.header.captured_ns

    @property
    def published_ns(self) -> int:
        """When the proxy had it, on its clock [ns]."""
        return self._arrival.header.published_ns

    @property
    def received_ns(self) -> int:
        """When it was here, on this host's clock [ns]."""
        return self._arrival.received_ns

    @property
    def intrinsics(self) -> Intrinsics | None:
        """Of the camera, in pixels of this frame."""
        return self._arrival.header.intrinsics

    @property
    def image(self) -> NDArray[np.uint8]:
        """The same pixels as a plain read-only array."""
        return self.view(np.ndarray)

    @property
    def age_s(self) -> float:
        """Time since the capture [s]."""
        return self._arrival.age_s

    @property
    def feedback(self) -> Feedback | None:
        """The vehicle's state at the capture, interpolated from the samples on both sides of it.

        While only an earlier sample is known (the later one is still to come), that one as it is; see
        :attr:`feedback_reach_s`. None if nothing is known.
        """
        return self._arrival.state_at_capture()[0]

    @property
    def feedback_reach_s(self) -> float | None:
        """How far from the capture the farther sample behind :attr:`feedback` lies [s]; None if there is none."""
        return self._arrival.state_at_capture()[1]

    def copy(self, order: Literal["K", "A", "C", "F"] | None = "C") -> NDArray[np.uint8]:  # type: ignore[override]
        """A plain array of one's own, to draw on."""
        return self.image.copy(order)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        """What arithmetic gives is a plain array or number."""
        plain = np.asarray(array)
        return plain if plain.ndim else plain[()]

    def __getattr__(self, name: str) -> NoReturn:
        if name in _ATTRIBUTES or name == "_arrival":
            raise AttributeError(
                f"this array was derived from a frame and has no {name}: only the frame as it was delivered knows it"
            )
        raise AttributeError(f"a frame has no attribute {name!r}")


class Arrival:
    """A frame as it came. The picture is made by the first consumer that looks, in its thread, once for all."""

    __slots__ = (
        "_clock",
        "_frame",
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
    ) -> None:
        self.header = header
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
        """The bytes as the transport gave them, shape (size,); None once somebody has looked at the picture."""
        with self._lock:
            return self._pixels

    def frame(self) -> Frame:
        """The picture. Raises :class:`DecodeError` if the pixels are not what the header says."""
        with self._lock:
            frame = self._frame() if self._frame is not None else None
            if frame is None:
                frame = self._make()
                self._frame = weakref.ref(frame)  # the frame refers to us: no circle that only the collector breaks
            return frame

    def _picture(self) -> NDArray[np.uint8]:
        """As BGR. Raises :class:`DecodeError`."""
        assert self._pixels is not None
        return to_bgr(self.header, self._pixels)

    def _make(self) -> Frame:
        image = self._image
        if image is None:
            image = self._image = self._picture()
            if image.flags.writeable:
                image.flags.writeable = False
            self._pixels = None
        frame = image.view(Frame)
        frame._arrival = self
        return frame

    def state_at_capture(self) -> tuple[Feedback | None, float | None]:
        """State and reach; looked up anew until there was a sample on either side of the capture."""
        if self._state is not None:
            return self._state
        feedback, reach_s, final = self._history.at(self.header.captured_ns)
        if final:
            self._state = feedback, reach_s
        return feedback, reach_s


class SmallArrival(Arrival):
    """A frame that came larger than this consumer wants it, and is made smaller when somebody looks."""

    __slots__ = ("_full",)

    def __init__(
        self,
        header: FrameHeader,
        pixels: Pixels,
        received_ns: int,
        offset_ns: int,
        history: FeedbackHistory,
        clock: Clock,
        scale: float,
    ) -> None:
        small = msgspec.structs.replace(scaled_header(header, scale), encoding=Encoding.BGR8)
        small = msgspec.structs.replace(small, size=small.width * small.height * 3)
        super().__init__(small, pixels, received_ns, offset_ns, history, clock)
        self._full = header

    def as_came(self) -> Pixels | None:
        """None: it did not come so."""
        return None

    def _picture(self) -> NDArray[np.uint8]:
        assert self._pixels is not None
        picture: NDArray[np.uint8] = resized(to_bgr(self._full, self._pixels), self.header)
        return picture


def size_error(header: FrameHeader, size: int) -> str:
    """Why ``size`` bytes can't be the frame that the header announces; empty if they can."""
    channels = _CHANNELS.get(header.encoding)
    expected = header.size if channels is None else header.width * header.height * channels
    if size == expected:
        return ""
    return f"frame {header.seq} of {header.camera} has {size} bytes and should have {expected}"


def to_bgr(header: FrameHeader, pixels: Pixels) -> NDArray[np.uint8]:
    """Pixels as BGR, shape (height, width, 3), uint8; the same memory if they are BGR already."""
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
    try:
        image: Any = cv2.imdecode(pixels, cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None or image.shape != (header.height, header.width, 3):
        raise DecodeError(f"frame {header.seq} of {header.camera} is not a JPEG of {header.width} × {header.height}")
    result: NDArray[np.uint8] = image
    return result
