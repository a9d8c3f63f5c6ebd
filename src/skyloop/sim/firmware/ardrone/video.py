"""The drone's video: takes the newest picture, encodes it on a thread of its own, and hands out what is to be sent."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import SkyloopError
from skyloop.sim.firmware import uvlc
from skyloop.sim.firmware.ardrone.board import VideoSettings
from skyloop.sim.firmware.ardrone.clock import DroneClock
from skyloop.sim.firmware.ardrone.encoders import FORMATS, Encoder, Format
from skyloop.sim.firmware.ardrone.telemetry import VideoStatus
from skyloop.wire.ardrone.keys import VideoChannel
from skyloop.wire.ardrone.pave import FrameType, build_header

INSET_1: Final = {VideoChannel.FRONT_WITH_BOTTOM: (88, 72), VideoChannel.BOTTOM_WITH_FRONT: (58, 42)}
_CAMERAS: Final = {
    VideoChannel.FRONT: ("front",),
    VideoChannel.BOTTOM: ("bottom",),
    VideoChannel.FRONT_WITH_BOTTOM: ("front", "bottom"),
    VideoChannel.BOTTOM_WITH_FRONT: ("bottom", "front"),
}
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Piece:
    """What is sent of one picture: whole, with its header."""

    data: bytes
    starts: bool  #: a decoder can begin here


class Packer(Protocol):
    """Makes what is sent of pictures, one after the other. Not thread-safe."""

    def pack(self, picture: NDArray[np.uint8], settings: VideoSettings, captured_ns: int, /) -> Piece | None: ...


class PavePacker:
    """Of an AR.Drone 2: a PaVE header, and a picture in H.264 or MPEG-4."""

    def __init__(self, clock: DroneClock, header_size: int, attitude: Callable[[], tuple[float, float, float]]) -> None:
        self._clock = clock
        self._header_size = header_size
        self._attitude = attitude
        self._made: tuple[tuple[Format, float, int], Encoder] | None = None
        self._number = 0
        self._position = 0

    def pack(self, picture: NDArray[np.uint8], settings: VideoSettings, captured_ns: int) -> Piece | None:
        form = FORMATS[settings.codec]
        wanted = form, settings.fps, settings.bitrate_kbps
        if self._made is None or self._made[0] != wanted:
            self._made = wanted, Encoder(*wanted)
        encoded = self._made[1].encode(picture)
        if encoded is None:
            return None
        self._number += 1
        header = build_header(
            payload_size=len(encoded.payload),
            type=FrameType.IDR if encoded.key else FrameType.P,
            number=self._number,
            timestamp_ms=self._clock.milliseconds(captured_ns),
            width=form.width,
            height=form.height,
            codec=form.codec,
            stream_id=form.stream_id,
            position=self._position,
            sps_size=encoded.sps_size,
            pps_size=encoded.pps_size,
            header_size=self._header_size,
            attitude_rad=self._attitude(),
        )
        self._position += len(encoded.payload) - encoded.sps_size - encoded.pps_size
        return Piece(header + encoded.payload, encoded.key)


class UvlcPacker:
    """Of an AR.Drone 1: a picture a datagram, each on its own."""

    def __init__(self) -> None:
        self._number = 0

    def pack(self, picture: NDArray[np.uint8], _settings: VideoSettings, _captured_ns: int) -> Piece | None:
        self._number += 1
        return Piece(uvlc.encode(picture, self._number & 0xFFFFFFFF), starts=True)


class VideoEncoding:
    """The thread. A picture that comes while another is encoded waits, and is overtaken by a newer one.

    ``send`` is called on the thread, with what to send.
    """

    def __init__(self, packer: Packer, settings: Callable[[], VideoSettings], send: Callable[[Piece], None]) -> None:
        self._packer = packer
        self._settings = settings
        self._send = send
        self._changed = threading.Condition()
        self._newest: dict[str, tuple[NDArray[np.uint8], int]] = {}
        self._fresh = False
        self._stopping = False
        self._sent_ns = 0
        self._thread = threading.Thread(target=self._run, name="skyloop-ardrone-video", daemon=True)
        self.status = VideoStatus()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def wants(self, camera: str) -> bool:
        """Whether the configured channel shows this camera."""
        return camera in _CAMERAS[self._settings().channel]

    def show(self, camera: str, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """A picture, BGR. Returns at once; the pixels must not change any more."""
        shown = _CAMERAS[self._settings().channel]
        if camera not in shown:
            return
        with self._changed:
            self._newest[camera] = pixels, captured_ns
            if camera == shown[0]:
                self._fresh = True
                self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._fresh or self._stopping)
                if self._stopping:
                    return
                self._fresh = False
                newest = dict(self._newest)
            try:
                self._encode(newest)
            except (SkyloopError, ValueError, OSError):
                _log.exception("a picture could not be encoded")

    def _encode(self, newest: dict[str, tuple[NDArray[np.uint8], int]]) -> None:
        settings = self._settings()
        main, *others = _CAMERAS[settings.channel]
        if main not in newest:
            return
        picture, captured_ns = newest[main]
        if others and others[0] in newest:
            picture = with_inset(picture, newest[others[0]][0], INSET_1[settings.channel])
        piece = self._packer.pack(picture, settings, captured_ns)
        if piece is None:
            return
        size, since_ns = len(piece.data), captured_ns - self._sent_ns
        self._sent_ns = captured_ns
        rate = size * 8 * NS_PER_S // max(since_ns, 1) // 1000
        self.status = VideoStatus(self.status.pictures + 1, size, min(rate, 1_000_000), int(settings.channel))
        self._send(piece)


def with_inset(picture: NDArray[np.uint8], other: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """The picture with another one, made smaller to (width, height), in its upper left corner."""
    width, height = size
    rows = np.arange(height) * other.shape[0] // height
    columns = np.arange(width) * other.shape[1] // width
    made = picture.copy()
    made[:height, :width] = other[rows[:, None], columns]
    return made
