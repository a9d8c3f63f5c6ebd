"""Define video samples: frame headers and the encoded frames of streams. Also read the size of image files.

A stream contains frames as the vehicle or the proxy encoded them. A stream runs only while it has subscribers.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Final

import msgspec

from skyloop.messages.fields import Count, Encoding, Finite, Name, Pixels, TimeNs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

H264: Final = "h264"  #: the only codec that is recorded without decoding
#: Maximum number of bytes of a frame in one packet, which also contains the other fields.
MAX_PIECE: Final = 57_000
MAX_PIECES: Final = 64  #: maximum number of pieces of one frame
MAX_ENCODED: Final = MAX_PIECE * MAX_PIECES  #: maximum size of a complete frame [bytes]
#: Rotations from a camera's optical axes (x right, y down, z forward) to the body axes, row by row.
Rotation9 = tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite]
LOOKING_FORWARD: Final[Rotation9] = (0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0)  #: with the image's top up
LOOKING_DOWN: Final[Rotation9] = (0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0)  #: with the image's top forward
Topic = Annotated[str, msgspec.Meta(max_length=200)]


class Intrinsics(msgspec.Struct, frozen=True, array_like=True):
    """A camera's intrinsics in the OpenCV convention, in pixels of the accompanying frame."""

    fx: Finite
    fy: Finite
    cx: Finite
    cy: Finite
    #: k1, k2, p1, p2[, k3, …] for a pinhole model, or k1 … k4 for a fisheye model
    distortion: Annotated[tuple[Finite, ...], msgspec.Meta(max_length=14)] = ()
    model: str = "pinhole"  #: ``pinhole`` or ``fisheye``

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The camera matrix K, shape (3, 3)."""
        import numpy as np

        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class FrameHeader(msgspec.Struct, frozen=True, array_like=True):
    """Header of one frame; the pixels are sent separately."""

    camera: Name
    seq: Count  #: increases by one with each frame of this camera, including dropped ones
    captured_ns: TimeNs  #: middle of the exposure, as accurately as the vehicle reports it, on the proxy's clock
    published_ns: TimeNs  #: time at which the proxy received the frame
    width: Pixels
    height: Pixels
    encoding: Encoding
    size: Count  #: number of bytes of pixel data
    intrinsics: Intrinsics | None = None


class CameraInfo(msgspec.Struct, frozen=True, array_like=True):
    """One of the vehicle's cameras, known before the first frame."""

    name: Name
    width: Pixels
    height: Pixels
    fps: Finite  #: nominal frame rate
    encoding: Encoding = Encoding.BGR8
    intrinsics: Intrinsics | None = None
    #: rotation from the camera's optical axes (x right, y down, z forward) to the body axes, row by row
    rotation: Rotation9 | None = None
    position_m: tuple[Finite, Finite, Finite] | None = None  #: position of the optical centre in body axes [m]
    stream: str = ""  #: codec of the frames available without decoding (``h264``); empty if there are none


class EncodedFrame(msgspec.Struct, frozen=True, array_like=True):
    """An encoded frame. For H.264 it is an access unit in Annex B format; a key frame includes the parameter sets.

    A frame that exceeds one packet is sent in pieces, each of which is an ``EncodedFrame``. Every frame except a key
    frame depends on the previous frame. After a gap in ``seq``, nothing can be decoded until the next key frame. Frames
    never depend on later frames. The decoded frame has the same ``captured_ns`` but its own ``seq``.
    """

    camera: Name
    seq: Count  #: number of the frame in the stream, counting also frames that were too large to send
    captured_ns: TimeNs  #: capture time, the same as that of the decoded frame
    published_ns: TimeNs  #: when the proxy received it
    width: Pixels  #: width of the decoded frame
    height: Pixels
    codec: Annotated[str, msgspec.Meta(max_length=16)]  #: ``h264``
    key: bool  #: whether the frame can be decoded without earlier frames
    data: Annotated[bytes, msgspec.Meta(max_length=MAX_ENCODED)]  #: one packet holds at most :data:`MAX_PIECE` bytes
    intrinsics: Intrinsics | None = None
    topic: Topic = ""  #: topic of the frame; empty: ``stream/CAMERA``, frames as encoded by the vehicle
    piece: Annotated[int, msgspec.Meta(ge=0, lt=MAX_PIECES)] = 0
    pieces: Annotated[int, msgspec.Meta(ge=1, le=MAX_PIECES)] = 1

    def decoded(self, width: int, height: int) -> FrameHeader:
        """Return the header of the BGR image of this size [px] that is decoded from this frame."""
        same = (width, height) == (self.width, self.height)
        times = (self.captured_ns, self.published_ns)
        lens = self.intrinsics if same else None  # the intrinsics apply to the announced size
        return FrameHeader(self.camera, self.seq, *times, width, height, Encoding.BGR8, width * height * 3, lens)


class StreamReport(msgspec.Struct, frozen=True, array_like=True):
    """A subscriber's report about a stream that the proxy encodes. The next report makes up for a lost one."""

    topic: Topic
    seq: Count  #: number of the newest completely received frame; 0 if there is none yet
    wants_key: bool = False  #: whether the subscriber can't decode anything before the next key frame


def split(picture: EncodedFrame) -> Iterator[EncodedFrame]:
    """Yield the pieces of a frame in order, or the frame itself if it fits into one packet."""
    pieces = -(-len(picture.data) // MAX_PIECE)
    if pieces <= 1:
        yield picture
        return
    for piece in range(pieces):
        data = picture.data[piece * MAX_PIECE : (piece + 1) * MAX_PIECE]
        yield msgspec.structs.replace(picture, data=data, piece=piece, pieces=pieces)


class Pieces:
    """Reassembles the frames of one stream. A frame whose pieces arrive out of order is dropped."""

    def __init__(self) -> None:
        self._parts: list[EncodedFrame] = []

    def add(self, part: EncodedFrame) -> EncodedFrame | None:
        """Add a piece; return the frame if this piece completes it."""
        if part.pieces == 1:
            self._parts.clear()
            return part
        last = self._parts[-1] if self._parts else None
        if part.piece == 0:
            self._parts = [part]
        elif last is not None and (part.seq, part.pieces, part.piece) == (last.seq, last.pieces, last.piece + 1):
            self._parts.append(part)
        else:
            self._parts.clear()
            return None
        if len(self._parts) < part.pieces:
            return None
        parts, self._parts = self._parts, []
        return msgspec.structs.replace(part, data=b"".join(each.data for each in parts), piece=0, pieces=1)


class Chain:
    """Decides which frames of a stream can be decoded: key frames, and frames that follow without a gap."""

    def __init__(self) -> None:
        self._last: int | None = None  # None while a key frame is awaited

    def follows(self, number: int, *, key: bool) -> bool:
        """Return whether frame ``number``, received next, can be decoded; only key frames may be repeated."""
        if number == self._last and not key:
            return False
        whole = key or (self._last is not None and number == self._last + 1)
        self._last = number if whole else None
        return whole

    def restart(self) -> None:
        """Start over, because the next frame does not continue the previous ones."""
        self._last = None


# The size is read from the header of a JPEG or PNG before decoding: decoders reserve memory for the announced size, and
# a file of a few kilobytes could announce gigabytes. ITU-T T.81 (JPEG), annex B; W3C PNG, section 5.

#: Maximum size of an image to decode: 8K UHD (100 MB as BGR), far more than the camera of any small drone delivers.
MAX_PIXELS: Final = 7680 * 4320
#: Maximum number of scans in a progressive JPEG. Each scan covers the whole image, and encoders produce about ten.
MAX_SCANS: Final = 100

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8"
_SCAN: Final = b"\xff\xda"
_START_OF_FRAME: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH: Final = frozenset({0x01, *range(0xD0, 0xD8)})
_ENDS: Final = frozenset({0xD8, 0xD9, 0xDA})  #: markers that end a header: another start, the end, or a scan


def image_size(data: bytes | memoryview) -> tuple[int, int] | None:
    """Return width and height [px] from the header of a JPEG or PNG; None if it is damaged or has another format."""
    if data[:8] == _PNG:
        if data[12:16] != b"IHDR" or len(data) < 24:
            return None
        width, height = struct.unpack_from(">II", data, 16)
        return (width, height) if width and height else None
    if data[:2] == _JPEG:
        return _jpeg_size(data)
    return None


def why_not_decoded(data: bytes | memoryview) -> str:
    """Return why an image must not be decoded; empty if it may be decoded."""
    size = image_size(data)
    if size is None:
        return "it is neither JPEG nor PNG, or it is damaged"
    width, height = size
    if width * height > MAX_PIXELS:
        return f"it announces {width} × {height} pixels; at most {MAX_PIXELS} are decoded"
    if data[:2] == _JPEG and (scans := bytes(data).count(_SCAN)) > MAX_SCANS:
        return f"it is a JPEG of {scans} scans; at most {MAX_SCANS} are decoded"
    return ""


def _jpeg_size(data: bytes | memoryview) -> tuple[int, int] | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF or data[at + 1] in (0x00, 0xFF):  # fill bytes, or bytes that decoders skip over
            at += 1
            continue
        marker = data[at + 1]
        at += 2
        if marker in _WITHOUT_LENGTH:
            continue
        if marker in _ENDS or at + 2 > len(data):
            return None
        (length,) = struct.unpack_from(">H", data, at)
        if marker in _START_OF_FRAME:
            if length < 8 or at + 7 > len(data):
                return None
            height, width = struct.unpack_from(">HH", data, at + 3)
            return (width, height) if width and height else None
        if length < 2:
            return None
        at += length
    return None
