"""Decoders and encoders of PyAV, made in one place: PyAV is optional, and imported when the first one is made."""

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
    """Check that PyAV is installed.

    Raises:
        MissingExtraError: It is not.
    """
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(purpose, "video", cause=str(error)) from error


def new_decoder(
    codec: Literal["h264", "mpeg4"], purpose: str, *, patch: bool = False, low_delay: bool = True
) -> VideoCodecContext:
    """Make a decoder that gives each picture at once.

    Args:
        codec: FFmpeg's name of it.
        purpose: As for :func:`require_pyav`.
        patch: Fill what is damaged with what stood there before; otherwise a damaged picture is an error.
        low_delay: False for a stream whose pictures build on later ones: they are held back for those.

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
    if low_delay:
        context.flags |= av.codec.context.Flags.low_delay
    context.thread_count = 1  # frame threads would hold pictures back
    return context


def limit_memory(context: CodecContext) -> None:
    """A damaged header must not make the decoder ask for gigabytes."""
    context.options = {**context.options, "max_pixels": str(MAX_PIXELS)}


_TICK: Final = Fraction(1, 1_000_000)  # of the stamps that the encoder's rate control goes by [s]
#: How much of a second at its rate a stream may send at once: what a key picture takes. A slow link has to carry it
#: before the next picture.
_BURST_S: Final = 0.15
_GROWS: Final = 3
_FALLS: Final = 12  # below this share of the most it may send, a single picture takes the path for too long
_KEY_EVERY_S: Final = 10.0  #: who comes later asks for one
#: The colours of PAL television, with 16 to 235 from black to white: what FFmpeg converts to, and decoders expect.
_COLOURS: Final = "colorprim=smpte170m:transfer=smpte170m:colormatrix=smpte170m:range=tv"


class H264Encoder:
    """Encodes one stream so that each picture comes out at once. Used by one thread at a time.

    H.264, Main profile, Annex B, without pictures that build on later ones; parameter sets before each key picture.

    Args:
        width: Of the pictures [px], even.
        height: Of the pictures [px], even.
        fps: About how many there will be in a second.
        kbit_s: On average [kbit/s].
        varies: Whether the rate will be changed, up to three times as much. What x264 may send at once is set when it
            begins, so a steady rate is kept more strictly.

    Raises:
        MissingExtraError: PyAV is not installed, or without x264.
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
        # x264 takes another rate later only if it began with the most that it may send, and then none above that.
        context.bit_rate = kbit_s * 1000
        self._context = context
        self._fresh = True

    def carries(self, kbit_s: int) -> bool:
        """Return whether it can be set to a rate [kbit/s], or another one has to be begun."""
        return self._most_kbit_s / _FALLS <= kbit_s <= self._most_kbit_s

    def set_rate(self, kbit_s: int) -> None:
        """Change the average rate from the next picture on [kbit/s], at no cost; see :meth:`carries`."""
        self.kbit_s = kbit_s
        self._context.bit_rate = kbit_s * 1000

    def encode(
        self, pixels: NDArray[np.uint8], form: str, captured_ns: int, *, key: bool = False
    ) -> tuple[bytes, bool]:
        """Encode one picture; other threads run meanwhile.

        Args:
            pixels: Shape (height, width, 3) or (height, width), dtype uint8, C-contiguous, of any size: it is scaled.
            form: FFmpeg's name of the pixels' format: ``bgr24``, ``rgb24`` or ``gray``.
            captured_ns: When it was captured [ns], later than the one before.
            key: Make it a key picture.

        Returns:
            The access unit, and whether it is a key picture. Empty if the encoder gave none.
        """
        import av

        picture = av.VideoFrame.from_numpy_buffer(pixels, format=form)  # copies nothing
        picture = picture.reformat(self.width, self.height, "yuv420p", interpolation="AREA")
        picture.pts, picture.time_base = captured_ns // 1000, _TICK
        first, self._fresh = self._fresh, False
        picture.pict_type = av.video.frame.PictureType.I if key or first else av.video.frame.PictureType.NONE
        units = self._context.encode(picture)
        return b"".join(bytes(unit) for unit in units), any(unit.is_keyframe for unit in units)
