"""What an AR.Drone sends of pictures: PaVE frames of H.264 or MPEG-4, or UVLC a datagram each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.firmware.ardrone import uvlc
from skyloop.sim.firmware.ardrone.board import VideoSettings
from skyloop.sim.firmware.ardrone.clock import DroneClock
from skyloop.sim.firmware.ardrone.formats import FORMATS
from skyloop.sim.firmware.encoders import Encoder, Format
from skyloop.sim.firmware.video import Piece
from skyloop.wire.ardrone.pave import FrameType, build_header


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
