"""Create PyAV decoders and encoders in one place, because PyAV is optional and is imported when first needed."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError
from skyloop.messages.frame import MAX_PIXELS

if TYPE_CHECKING:
    from av.codec.context import CodecContext
    from av.video.codeccontext import VideoCodecContext


def require_pyav(purpose: str) -> None:
    """Raise :class:`MissingExtraError` unless PyAV is installed; the message states the ``purpose``."""
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(purpose, "video", cause=str(error)) from error


def new_decoder(
    codec: Literal["h264", "mpeg4"], purpose: str, *, patch: bool = False, low_delay: bool = True
) -> VideoCodecContext:
    """Create a decoder that returns each image immediately; ``codec`` is FFmpeg's name. See :func:`require_pyav`.

    With ``patch``, damaged parts are filled in from earlier images; otherwise, a damaged image is an error.
    ``low_delay`` is False for a stream whose images depend on later images and are delayed until those arrive.
    """
    require_pyav(purpose)
    import av

    context: VideoCodecContext = av.CodecContext.create(codec, "r")
    if patch:
        context.flags |= av.codec.context.Flags.output_corrupt
    else:
        # For H.264, also reject an image with leftover bits. For MPEG-4, this check would reject the end of every
        # sequence.
        context.options = {"err_detect": "explode+aggressive" if codec == "h264" else "explode"}
    limit_memory(context)
    if low_delay:
        context.flags |= av.codec.context.Flags.low_delay
    context.thread_count = 1  # frame threading would delay images
    return context


def limit_memory(context: CodecContext) -> None:
    """Limit a decoder's memory: a damaged header must not make the decoder allocate gigabytes."""
    context.options = {**context.options, "max_pixels": str(MAX_PIXELS)}


_TICK: Final = Fraction(1, 1_000_000)  # time base for the encoder's rate control [s]
#: Time [s] whose share of the data a stream may send at once, which limits the size of a key frame. A slow link has to
#: transmit it before the next image.
_BURST_S: Final = 0.15
_GROWS: Final = 3  # factor by which a variable rate may increase at most
_FALLS: Final = 12  # below 1/12 of the maximum rate, a single image would occupy the link for too long
_KEY_EVERY_S: Final = 10.0  #: maximum time between key frames; long, because late subscribers request a key frame
#: Standard-definition television colours, from 16 (black) to 235 (white), which FFmpeg produces and decoders expect.
_COLOURS: Final = "colorprim=smpte170m:transfer=smpte170m:colormatrix=smpte170m:range=tv"


class H264Encoder:
    """Encodes one stream and returns each image at once. Use it from one thread at a time.

    The format is H.264, Main profile, Annex B, without images that depend on later images; parameter sets precede each
    key frame. The width and height [px] must be even. If the average rate [kbit/s] ``varies``, it may increase up to
    threefold. x264 fixes the largest burst when it starts; a constant rate is therefore kept more strictly. Raises
    :class:`MissingExtraError` if PyAV or x264 is not installed.
    """

    def __init__(self, width: int, height: int, fps: float, kbit_s: int, *, varies: bool = False) -> None:
        purpose = "encoding H.264"
        require_pyav(purpose)
        import av

        self.width, self.height, self.kbit_s = width, height, kbit_s
        self._most_kbit_s = kbit_s * _GROWS if varies else kbit_s
        try:
            context: VideoCodecContext = av.CodecContext.create("libx264", "w")
        except ValueError as error:
            raise MissingExtraError(purpose, "video", cause="this PyAV comes without x264") from error
        context.width, context.height, context.pix_fmt = width, height, "yuv420p"
        context.time_base = _TICK
        context.framerate = Fraction(max(fps, 1.0)).limit_denominator(1000)
        context.bit_rate = self._most_kbit_s * 1000
        context.gop_size = round(max(fps, 1.0) * _KEY_EVERY_S)
        context.max_b_frames = 0
        context.thread_count = 1
        context.options = {
            "preset": "superfast",
            "tune": "zerolatency",
            "profile": "main",
            "forced-idr": "1",
            "maxrate": str(self._most_kbit_s * 1000),
            "bufsize": str(round(kbit_s * 1000 * _BURST_S)),
            "x264-params": f"repeat-headers=1:scenecut=0:sliced-threads=0:{_COLOURS}",
        }
        context.open()
        # x264 accepts a later change of rate only if it was started with a maximum rate, and only up to that maximum.
        context.bit_rate = kbit_s * 1000
        self._context = context
        self._fresh = True

    def carries(self, kbit_s: int) -> bool:
        """Return whether the encoder can switch to a rate [kbit/s]; if not, a new encoder is needed."""
        return self._most_kbit_s / _FALLS <= kbit_s <= self._most_kbit_s

    def set_rate(self, kbit_s: int) -> None:
        """Change the average rate [kbit/s] from the next image on, at no cost; see :meth:`carries`."""
        self.kbit_s = kbit_s
        self._context.bit_rate = kbit_s * 1000

    def encode(
        self, pixels: NDArray[np.uint8], form: str, captured_ns: int, *, key: bool = False
    ) -> tuple[bytes, bool]:
        """Encode one image without blocking other threads.

        Args:
            pixels: Shape (height, width, 3) or (height, width), dtype uint8, C-contiguous; any size is scaled.
            form: FFmpeg's name for the pixels' format: ``bgr24``, ``rgb24`` or ``gray``.
            captured_ns: Capture time [ns], later than that of the previous image.
            key: Whether to make the image a key frame.

        Returns the access unit, which is empty if the encoder returned none, and whether it is a key frame.
        """
        import av

        picture = av.VideoFrame.from_numpy_buffer(pixels, format=form)  # no copy
        picture = picture.reformat(self.width, self.height, "yuv420p", interpolation="AREA")
        picture.pts, picture.time_base = captured_ns // 1000, _TICK
        first, self._fresh = self._fresh, False
        picture.pict_type = av.video.frame.PictureType.I if key or first else av.video.frame.PictureType.NONE
        units = self._context.encode(picture)
        return b"".join(bytes(unit) for unit in units), any(unit.is_keyframe for unit in units)
