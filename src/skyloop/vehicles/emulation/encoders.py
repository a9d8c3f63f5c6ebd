"""Encoders of the drones' pictures: H.264 or MPEG-4 by PyAV, which is imported when one is made."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

GROUP: Final = 15  #: pictures from one key frame to the next

_SPS, _PPS, _IDR, _SLICE = 7, 8, 5, 1  # types of NAL units
_START_CODE: Final = b"\0\0\0\1"
_ANY_START_CODE: Final = re.compile(rb"\x00{2,3}\x01")
_X264: Final = {"preset": "ultrafast", "tune": "zerolatency"}


@dataclass(frozen=True, slots=True)
class Format:
    """Format of a stream, as the header of its frames has it."""

    codec: Literal["h264", "mpeg4"]
    width: int
    height: int
    stream_id: int


@dataclass(frozen=True, slots=True)
class Encoded:
    """A picture's payload. A key picture begins with parameters of these sizes, start codes included."""

    payload: bytes
    key: bool
    sps_size: int = 0
    pps_size: int = 0


class Encoder:
    """Encodes one stream.

    Args:
        form: Codec and size.
        fps: Pictures a second.
        bitrate_kbps: On average.
        group: Pictures from one key frame to the next.
        profile: Of H.264.
        buffer_s: No more than the bitrate over so long is sent at once; None: single pictures may have any size.

    Raises:
        MissingExtraError: PyAV is not installed.
    """

    def __init__(
        self,
        form: Format,
        fps: float,
        bitrate_kbps: int,
        *,
        group: int = GROUP,
        profile: str = "Baseline",
        buffer_s: float | None = None,
    ) -> None:
        require_encoder()
        import av

        name: Literal["libx264", "mpeg4"] = "libx264" if form.codec == "h264" else "mpeg4"
        context: VideoCodecContext = av.CodecContext.create(name, "w")
        context.width, context.height, context.pix_fmt = form.width, form.height, "yuv420p"
        context.framerate = Fraction(fps).limit_denominator(1000)
        context.time_base = 1 / context.framerate
        context.bit_rate = bitrate_kbps * 1000
        context.gop_size = group
        context.thread_count = 1
        if name == "libx264":
            keys = f"keyint={group}:min-keyint={group}:scenecut=0"
            if buffer_s is not None:
                keys += f":vbv-maxrate={bitrate_kbps}:vbv-bufsize={round(bitrate_kbps * buffer_s)}"
            context.options = {**_X264, "x264-params": f"{keys}:sliced-threads=0:threads=1:repeat-headers=1"}
            context.profile = profile
        else:
            context.max_b_frames = 0
        self._context = context
        self._form = form
        self._count = 0

    def encode(self, picture: NDArray[np.uint8]) -> Encoded | None:
        """Encode a picture.

        Args:
            picture: BGR, uint8, shape (height, width, 3), of any size: it is scaled.

        Returns:
            None if the encoder gave nothing.
        """
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
        frame = frame.reformat(self._form.width, self._form.height, "yuv420p")
        frame.pts = self._count
        frame.time_base = self._context.time_base
        self._count += 1
        packets = self._context.encode(frame)
        data = b"".join(bytes(packet) for packet in packets)
        if not data:
            return None
        if self._form.codec == "h264":
            return as_the_drone_does(data)
        return Encoded(data, any(packet.is_keyframe for packet in packets))


def as_the_drone_does(stream: bytes) -> Encoded:
    """Return an access unit in Annex B form with parameters and slices alone, each after a start code of four bytes."""
    units = [unit for unit in _ANY_START_CODE.split(stream) if unit]
    kept = [(unit[0] & 31, _START_CODE + unit) for unit in units if unit[0] & 31 in (_SPS, _PPS, _IDR, _SLICE)]
    return Encoded(
        payload=b"".join(unit for _, unit in kept),
        key=any(kind == _IDR for kind, _ in kept),
        sps_size=sum(len(unit) for kind, unit in kept if kind == _SPS),
        pps_size=sum(len(unit) for kind, unit in kept if kind == _PPS),
    )


def require_encoder(what: str = "the video of an emulated AR.Drone 2") -> None:
    """Check that PyAV is installed.

    Args:
        what: Needs it, for the error.

    Raises:
        MissingExtraError: It is not.
    """
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(what, "video", cause=str(error)) from error
