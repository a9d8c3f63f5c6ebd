"""Decoders of PyAV, made in one place: PyAV is optional, and imported when the first one is made."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from skyloop.errors import MissingExtraError
from skyloop.messages.image_header import MAX_PIXELS

if TYPE_CHECKING:
    from av.codec.context import CodecContext
    from av.video.codeccontext import VideoCodecContext


def require_pyav(purpose: str) -> None:
    """Check that PyAV is installed.

    Args:
        purpose: What it is needed for, as the error says it.

    Raises:
        MissingExtraError: It is not.
    """
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(purpose, "video", cause=str(error)) from error


def new_decoder(codec: Literal["h264", "mpeg4"], purpose: str, *, patch: bool = False) -> VideoCodecContext:
    """Make a decoder that gives each picture at once.

    Args:
        codec: FFmpeg's name of it.
        purpose: As for :func:`require_pyav`.
        patch: Fill what is damaged with what stood there before; otherwise a damaged picture is an error.

    Raises:
        MissingExtraError: PyAV is not installed.
    """
    require_pyav(purpose)
    import av

    context: VideoCodecContext = av.CodecContext.create(codec, "r")
    if patch:
        context.flags |= av.codec.context.Flags.output_corrupt
    else:
        # A picture of H.264 is refused also if bits of it are left over: the like of it would refuse every end of an
        # MPEG-4 sequence.
        context.options = {"err_detect": "explode+aggressive" if codec == "h264" else "explode"}
    limit_memory(context)
    context.flags |= av.codec.context.Flags.low_delay
    context.thread_count = 1  # frame threads would hold pictures back
    return context


def limit_memory(context: CodecContext) -> None:
    """A damaged header must not make the decoder ask for gigabytes."""
    context.options = {**context.options, "max_pixels": str(MAX_PIXELS)}
