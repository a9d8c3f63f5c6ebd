"""Decodes the frames of a PaVE stream with PyAV, which is imported here and nowhere else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from skyloop.errors import MissingExtraError
from skyloop.wire.ardrone.pave import Codec, PaveFrame

try:
    import av
    import av.error
except ImportError as error:
    raise MissingExtraError("video://", "video", cause=str(error)) from error

if TYPE_CHECKING:
    from av.codec.context import CodecContext
    from av.video.codeccontext import VideoCodecContext

__all__ = ["PaveDecoder", "av", "limit_memory"]

MAX_PIXELS: Final = 7680 * 4320
_DECODERS: Final[dict[int, Literal["mpeg4", "h264"]]] = {Codec.MPEG4_VISUAL: "mpeg4", Codec.MPEG4_AVC: "h264"}


def limit_memory(context: CodecContext) -> None:
    """A damaged header must not make the decoder ask for gigabytes."""
    context.options = {**context.options, "max_pixels": str(MAX_PIXELS)}


class PaveDecoder:
    """Frames of a PaVE stream to pictures, one in and at most one out, without delay.

    Gives nothing before the first key frame (a stream torn open, or the stale frame with which the drone greets), and
    after damage nothing up to the next key frame: those pictures would be smeared. ``waited`` counts frames left out
    for that, ``damaged`` those that could not be decoded.
    """

    def __init__(self) -> None:
        self.waited = 0
        self.damaged = 0
        self._codec: int | None = None
        self._context: VideoCodecContext | None = None
        self._needs_key = True

    def decode(self, frame: PaveFrame) -> av.VideoFrame | None:
        """The picture of this frame, or None. Never raises for what a frame holds."""
        self._needs_key = self._needs_key or frame.after_damage or frame.codec != self._codec
        if self._needs_key and not frame.is_key:
            self.waited += 1
            return None
        if self._needs_key:
            self._start(frame.codec)
        if self._context is None:
            self.damaged += 1
            return None
        try:
            images = self._context.decode(av.Packet(frame.payload))
        except (av.error.FFmpegError, ValueError):
            images = []
        if not images or images[-1].is_corrupt:
            self.damaged += 1
            self._needs_key = True
            return None
        return images[-1]

    def _start(self, codec: int) -> None:
        """A fresh decoder: what an old one remembers of the pictures before the damage must not show."""
        self._codec, self._context = codec, None
        name = _DECODERS.get(codec)
        if name is None:
            return
        context = av.CodecContext.create(name, "r")
        context.options = {"err_detect": "explode"}  # a frame with errors is refused instead of patched up
        limit_memory(context)
        context.flags |= av.codec.context.Flags.low_delay
        context.thread_count = 1  # frame threads would hold pictures back
        self._context, self._needs_key = context, False
