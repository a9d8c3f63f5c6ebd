"""A recorded frame and its pixels: JPEG, PNG or H.264. H.264 frames depend on each other and are decoded on demand.

The image is in the field ``data`` of a foxglove.CompressedImage or, if the vehicle's H.264 was kept, of a
foxglove.CompressedVideo. The data are extracted from the Protocol Buffers encoding
(https://protobuf.dev/programming-guides/encoding/, https://docs.foxglove.dev/docs/sdk/schemas/compressed-image,
…/compressed-video).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.messages import Encoding, FrameHeader
from skyloop.messages.frame import H264, Chain, why_not_decoded
from skyloop.pyav import new_decoder
from skyloop.recording.layout import FrameRecord

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

_DATA: Final = 2  #: field number of ``data`` in CompressedImage
_VIDEO_DATA: Final = 3  #: field number of ``data`` in CompressedVideo
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  #: wire types of Protocol Buffers fields
_FIXED_SIZE: Final = {_FIXED64: 8, _FIXED32: 4}


@dataclass(frozen=True, slots=True)
class RecordedImage:
    """A frame of a recording, with its image."""

    camera: str
    record: FrameRecord
    log_ns: int  #: time at which it was received, Unix time [ns]
    publish_ns: int  #: time at which it was captured, Unix time [ns]
    message: bytes  #: foxglove.CompressedImage or CompressedVideo
    group: tuple[FrameGroup, int] | None = None  #: the frame's group and its index in it, for decodable H.264

    @property
    def header(self) -> FrameHeader:
        """The frame's header, as received."""
        return self.record.header

    @property
    def compressed(self) -> bytes:
        """The image file or access unit, in ``record.format``.

        Raises:
            FileFormatError: The message is damaged.
        """
        return compressed(self.message, self.record)

    @property
    def can_be_decoded(self) -> bool:
        """Whether all frames that this one depends on are known; false for H.264 whose key frame is missing."""
        return self.record.format != H264 or self.group is not None

    def pixels(self) -> NDArray[np.uint8]:
        """Decode the frame to BGR, shape (height, width, 3), uint8.

        Raises:
            FileFormatError: The frame can't be decoded.
            MissingExtraError: OpenCV, or for H.264 PyAV, is not installed.
        """
        return self._decoded(grey=False)

    def as_recorded(self) -> tuple[NDArray[np.uint8], Encoding]:
        """Decode the frame to the vehicle's own encoding if that encoding was raw, otherwise to BGR.

        Raises:
            FileFormatError: The frame can't be decoded.
            MissingExtraError: OpenCV, or for H.264 PyAV, is not installed.
        """
        grey = self.header.encoding is Encoding.MONO8
        image = self._decoded(grey=grey)
        if self.header.encoding is Encoding.RGB8:
            return np.ascontiguousarray(image[:, :, ::-1]), Encoding.RGB8
        return image, Encoding.MONO8 if grey else Encoding.BGR8

    def _decoded(self, *, grey: bool) -> NDArray[np.uint8]:
        what = f"frame {self.header.seq} of {self.camera}"
        if self.record.format != H264:
            return decode_image(self.compressed, what, grey=grey)
        if self.group is None:
            raise FileFormatError(f"{what} can't be decoded: frames that it depends on are missing")
        group, place = self.group
        return group.pixels(place, what)


def compressed(message: bytes, record: FrameRecord) -> bytes:
    """Extract an image file or access unit from its message.

    Raises:
        FileFormatError: The message is damaged.
    """
    return _field(message, _VIDEO_DATA if record.format == H264 else _DATA)


def decode_image(data: bytes, what: str, *, grey: bool) -> NDArray[np.uint8]:
    """Decode JPEG or PNG to BGR, shape (height, width, 3), or greyscale, shape (height, width); uint8.

    Raises:
        FileFormatError: The data can't be decoded.
        MissingExtraError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("decoding recorded frames", "vision", cause=str(error)) from None
    if reason := why_not_decoded(data):
        raise FileFormatError(f"{what} can't be decoded: {reason}")
    try:
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise FileFormatError(f"{what} can't be decoded: it is damaged")
    result: NDArray[np.uint8] = image
    return result


def _field(message: bytes, number: int) -> bytes:
    """Return a bytes field of an encoded message; empty if the field is missing."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        kind = key & 7
        if kind == _VARINT:
            _, at = _varint(message, at)
        elif kind in _FIXED_SIZE:
            at += _FIXED_SIZE[kind]
        elif kind == _BYTES:
            size, at = _varint(message, at)
            if key >> 3 == number:
                return message[at : at + size]
            at += size
        else:
            raise FileFormatError(f"an image's message is damaged at byte {at}")
    return b""


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """Decode a varint (seven bits per byte); return it and the index after it."""
    number = shift = 0
    while at < len(message) and shift < 64:
        byte = message[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
        shift += 7
    raise FileFormatError(f"an image's message is damaged at byte {at}")


# H.264 ----------------------------------------------------------------------------------------------------------


class FrameGroup:
    """A key frame and the frames that depend on it, in the order of capture. Decoding resumes where it stopped."""

    def __init__(self) -> None:
        self._units: list[bytes] = []
        self._context: VideoCodecContext | None = None
        self._done = 0  # number of units decoded so far
        self._image: Any = None  # the most recently decoded image

    def __len__(self) -> int:
        return len(self._units)

    def add(self, unit: bytes) -> None:
        self._units.append(unit)

    def pixels(self, index: int, what: str) -> NDArray[np.uint8]:
        """Decode one frame to BGR, shape (height, width, 3), uint8.

        Raises:
            FileFormatError: The frame is damaged, or not H.264.
            MissingExtraError: PyAV is not installed.
        """
        if self._context is None or index < self._done - 1:
            self._context, self._done = new_decoder("h264", "decoding recorded H.264"), 0
        while self._done <= index and (self._done == 0 or self._image is not None):  # damage ends the group of frames
            self._image = _decode(self._context, self._units[self._done])
            self._done += 1
        if self._image is None:
            raise FileFormatError(f"{what} can't be decoded: it is not H.264, or it is damaged")
        return np.ascontiguousarray(self._image.to_ndarray(format="bgr24"), dtype=np.uint8)


class Groups:
    """Sorts one camera's frames, which are passed in order, into groups."""

    def __init__(self) -> None:
        self._chain = Chain()
        self._group = FrameGroup()

    def add(self, number: int, unit: bytes, *, key: bool) -> tuple[FrameGroup, int] | None:
        """Add a frame.

        Returns:
            The group and the frame's index in it; None if the frame can't be decoded because an earlier one is missing.
        """
        if not self._chain.follows(number, key=key):
            return None
        if key:
            self._group = FrameGroup()
        self._group.add(unit)
        return self._group, len(self._group) - 1


def _decode(context: VideoCodecContext, unit: bytes) -> Any:
    """Decode one access unit; None if it is damaged."""
    import av

    try:
        images = context.decode(av.Packet(unit))
    except (av.error.FFmpegError, ValueError):
        return None
    return images[-1] if images and not images[-1].is_corrupt else None
