"""Pictures of H.264 that build on one another, decoded when somebody looks: PyAV is imported then."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.messages.encoded import Chain

_MAX_PIXELS: Final = 7680 * 4320

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext


class Group:
    """A key picture and those that follow it, in the order of their capture. Decoding goes on where it stood before."""

    def __init__(self) -> None:
        self._units: list[bytes] = []
        self._context: VideoCodecContext | None = None
        self._done = 0  # units that were decoded
        self._image: Any = None  # the picture of the last of them

    def __len__(self) -> int:
        return len(self._units)

    def add(self, unit: bytes) -> None:
        self._units.append(unit)

    def pixels(self, index: int, what: str) -> NDArray[np.uint8]:
        """One picture: BGR, shape (height, width, 3). Raises :class:`FileFormatError`, :class:`MissingExtraError`."""
        if self._context is None or index < self._done - 1:
            self._context, self._done = _decoder(), 0
        while self._done <= index and (self._done == 0 or self._image is not None):  # what builds on damage is damaged
            self._image = _decode(self._context, self._units[self._done])
            self._done += 1
        if self._image is None:
            raise FileFormatError(f"{what} can't be decoded: it is no H.264, or it is damaged")
        return np.ascontiguousarray(self._image.to_ndarray(format="bgr24"), dtype=np.uint8)


class Groups:
    """Sorts the pictures of one camera, in their order, into groups."""

    def __init__(self) -> None:
        self._chain = Chain()
        self._group = Group()

    def add(self, number: int, unit: bytes, *, key: bool) -> tuple[Group, int] | None:
        """A picture's group, and its place there; None for one that can't be decoded, as one before it is missing."""
        if not self._chain.follows(number, key=key):
            return None
        if key:
            self._group = Group()
        self._group.add(unit)
        return self._group, len(self._group) - 1


def _decoder() -> VideoCodecContext:
    try:
        import av
    except ImportError as error:
        raise MissingExtraError("decoding recorded H.264", "video", cause=str(error)) from None
    context = av.CodecContext.create("h264", "r")
    # A picture with errors is refused instead of patched up; a damaged header must not ask for gigabytes.
    context.options = {"err_detect": "explode+aggressive", "max_pixels": str(_MAX_PIXELS)}
    context.flags |= av.codec.context.Flags.low_delay
    context.thread_count = 1  # frame threads would hold pictures back
    return context


def _decode(context: VideoCodecContext, unit: bytes) -> Any:
    """The picture of one access unit, or None."""
    import av

    try:
        images = context.decode(av.Packet(unit))
    except (av.error.FFmpegError, ValueError):
        return None
    return images[-1] if images and not images[-1].is_corrupt else None
