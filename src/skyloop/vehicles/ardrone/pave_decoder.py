"""A PyAV decoder for PaVE streams, live or from a file. Import this module only where video is needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from skyloop.errors import MissingExtraError
from skyloop.pyav import new_decoder
from skyloop.vehicles.ardrone.wire.pave import Codec, PaveFrame

try:
    import av
    import av.error
except ImportError as error:
    raise MissingExtraError("video://", "video", cause=str(error)) from error

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

__all__ = ["PaveDecoder", "av"]

_DECODERS: Final[dict[int, Literal["mpeg4", "h264"]]] = {Codec.MPEG4_VISUAL: "mpeg4", Codec.MPEG4_AVC: "h264"}
# FFmpeg occasionally refuses an MPEG-4 frame padded by a single bit, unless an end-of-sequence code follows it.
_ENDS: Final = {int(Codec.MPEG4_VISUAL): b"\0\0\1\xb1"}


class PaveDecoder:
    """Decodes the frames of a PaVE stream: one frame in, at most one image out, without delay.

    Returns nothing until the first key frame, because the drone sends a stale frame first, and nothing after damage or
    a gap in the frame numbers until the next key frame, because the images would be smeared. ``waited`` counts the
    frames dropped for these reasons; ``damaged`` counts undecodable frames. PaVE and H.264 have no checksum (only TCP
    has), so a flipped bit goes unnoticed if the stream remains valid.
    """

    def __init__(self) -> None:
        self.waited = 0
        self.damaged = 0
        self._codec: int | None = None
        self._context: VideoCodecContext | None = None
        self._needs_key = True
        self._number = 0  # number of the previous frame

    def restart(self) -> None:
        """Wait for the next key frame because the stream was interrupted."""
        self._needs_key = True

    def decode(self, frame: PaveFrame) -> av.VideoFrame | None:
        """Return a frame's image, or None. Never raises, regardless of content."""
        follows = frame.number == self._number + 1 & 0xFFFFFFFF and frame.codec == self._codec
        self._needs_key = self._needs_key or frame.after_damage or not follows
        self._number = frame.number
        if self._needs_key and not frame.is_key:
            self.waited += 1
            return None
        if self._needs_key:
            self._start(frame.codec)
        if self._context is None:
            self.damaged += 1
            return None
        try:
            images = self._context.decode(av.Packet(frame.payload + _ENDS.get(frame.codec, b"")))
        except (av.error.FFmpegError, ValueError):
            images = []
        if not images or images[-1].is_corrupt or not _fits(images[-1], frame):
            self.damaged += 1
            self._needs_key = True
            return None
        return images[-1]

    def _start(self, codec: int) -> None:
        """Create a new decoder: the old one would show remnants of images from before the damage."""
        self._codec, self._context = codec, None
        name = _DECODERS.get(codec)
        if name is None:
            return
        self._context, self._needs_key = new_decoder(name, "video://"), False


def _fits(image: av.VideoFrame, frame: PaveFrame) -> bool:
    """Return whether an H.264 image has the size in its header; not checked for MPEG-4, whose real size is unknown."""
    return frame.codec != Codec.MPEG4_AVC or (image.width, image.height) == (frame.width, frame.height)
