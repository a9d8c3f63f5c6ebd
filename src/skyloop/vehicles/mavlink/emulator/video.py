"""The camera beside an emulated autopilot: H.264 in an MPEG transport stream over UDP."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.vehicles.emulation.encoders import GROUP
from skyloop.vehicles.emulation.video import OneCamera, VideoEncoding

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

CAMERA: Final[CameraModel] = replace(FRONT_CAMERA, fps=20.0)
_CLOCK: Final = Fraction(1, 90_000)  #: of transport streams [s]
_X264: Final = {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "scenecut=0:repeat-headers=1:threads=1"}
_SETTINGS: Final = OneCamera("front", CAMERA.fps, 1500)


class TransportStream:
    """Encodes and sends each picture as it comes. Not thread-safe.

    Args:
        host: To send to.
        port: UDP.

    Raises:
        MissingExtraError: PyAV is not installed.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            import av
        except ImportError as error:
            raise MissingExtraError("the video of an emulated vehicle", "video", cause=str(error)) from error
        self._av = av
        options = {"mpegts_flags": "resend_headers", "flush_packets": "1"}
        url = f"udp://{host}:{port}?pkt_size=1316"
        self._container: OutputContainer = av.open(url, "w", format="mpegts", options=options)
        self._stream: VideoStream = self._container.add_stream("libx264", rate=round(CAMERA.fps), options=dict(_X264))
        self._stream.width, self._stream.height = CAMERA.width, CAMERA.height
        self._stream.pix_fmt = "yuv420p"
        self._stream.bit_rate = _SETTINGS.bitrate_kbps * 1000
        self._stream.gop_size = GROUP
        self._stream.time_base = self._stream.codec_context.time_base = _CLOCK  # or two pictures may get one stamp
        self._begun_ns: int | None = None
        self._stamp = -1

    def pack(self, picture: NDArray[np.uint8], _settings: OneCamera, captured_ns: int) -> None:
        """Encode and send a picture: BGR, uint8, shape (height, width, 3)."""
        self._begun_ns = captured_ns if self._begun_ns is None else self._begun_ns
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
        # Exposures of a drone may come out of order; a stream's stamps must grow.
        self._stamp = max(self._stamp + 1, round((captured_ns - self._begun_ns) / 1e9 / _CLOCK))
        frame.pts = self._stamp
        frame.time_base = _CLOCK
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def close(self) -> None:
        """Close the stream."""
        self._container.close()


def encoding(stream: TransportStream) -> VideoEncoding[OneCamera]:
    """Return the thread that encodes the newest picture; not started."""
    return VideoEncoding(stream, lambda: _SETTINGS, lambda _: None)
