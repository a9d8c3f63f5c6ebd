"""H.264 frames that build on one another, decoded on demand: PyAV is imported then."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError
from skyloop.messages.encoded import Chain
from skyloop.pyav import new_decoder

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext


class Group:
    """A key frame and the frames that follow it, in order of capture. Decoding continues where it stopped before."""

    def __init__(self) -> None:
        self._units: list[bytes] = []
        self._context: VideoCodecContext | None = None
        self._done = 0  # units that were decoded
        self._image: Any = None  # the picture of the last of them

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._units)

    def add(self, unit: bytes) -> None:
        """Append a frame's access unit."""
        self._units.append(unit)

    def pixels(self, index: int, what: str) -> NDArray[np.uint8]:
        """Decode one frame.

        Args:
            index: Of the frame in the group.
            what: The frame, for error messages.

        Returns:
            BGR, shape (height, width, 3), uint8.

        Raises:
            FileFormatError: The frame is damaged, or no H.264.
            MissingExtraError: PyAV is not installed.
        """
        if self._context is None or index < self._done - 1:
            self._context, self._done = _decoder(), 0
        while self._done <= index and (self._done == 0 or self._image is not None):  # so are those after damage
            self._image = _decode(self._context, self._units[self._done])
            self._done += 1
        if self._image is None:
            raise FileFormatError(f"{what} can't be decoded: it is no H.264, or it is damaged")
        return np.ascontiguousarray(self._image.to_ndarray(format="bgr24"), dtype=np.uint8)


class Groups:
    """Sorts the frames of one camera, in their order, into groups."""

    def __init__(self) -> None:
        self._chain = Chain()
        self._group = Group()

    def add(self, number: int, unit: bytes, *, key: bool) -> tuple[Group, int] | None:
        """Add a frame.

        Args:
            number: Of the frame.
            unit: Its access unit.
            key: Whether it is a key frame.

        Returns:
            The group and the index in it; None for a frame that can't be decoded, because one before it is missing.
        """
        if not self._chain.follows(number, key=key):
            return None
        if key:
            self._group = Group()
        self._group.add(unit)
        return self._group, len(self._group) - 1


def _decoder() -> VideoCodecContext:
    return new_decoder("h264", "decoding recorded H.264")


def _decode(context: VideoCodecContext, unit: bytes) -> Any:
    """Decode one access unit; None if it is damaged."""
    import av

    try:
        images = context.decode(av.Packet(unit))
    except (av.error.FFmpegError, ValueError):
        return None
    return images[-1] if images and not images[-1].is_corrupt else None
