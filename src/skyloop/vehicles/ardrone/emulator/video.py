"""The AR.Drones' cameras, formats and codecs: from pictures to what goes out. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA
from skyloop.vehicles.ardrone.emulator import uvlc
from skyloop.vehicles.ardrone.emulator.clock import DroneClock
from skyloop.vehicles.ardrone.emulator.logic import VideoSettings
from skyloop.vehicles.ardrone.wire.keys import VideoCodec
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType, build_header
from skyloop.vehicles.emulation.encoders import Encoder, Format
from skyloop.vehicles.emulation.video import Piece

_DIAGONAL_1_PX: Final = math.hypot(176, 144)
_FOCAL_1_PX: Final = BOTTOM_CAMERA.fx * _DIAGONAL_1_PX / math.hypot(BOTTOM_CAMERA.width, BOTTOM_CAMERA.height)

FRONT_2: Final = replace(
    FRONT_CAMERA,
    width=640,
    height=360,
    fx=561.999146,
    fy=561.782697,
    cx=307.433982,
    cy=190.144373,
    distortion=(-0.50758, 0.24911, 0.000579, 0.000996, 0.0),
)
#: The picture that the drone sends, which is the middle of its sensor's 320×240 at twice the size.
BOTTOM_2_SENT: Final = replace(
    BOTTOM_CAMERA, width=640, height=360, fx=686.994766, fy=688.195055, cx=329.323208, cy=159.323007
)
BOTTOM_2: Final = BOTTOM_2_SENT.scaled(0.5)
FRONT_1: Final = replace(FRONT_CAMERA, fps=15.0)
BOTTOM_1: Final = replace(
    BOTTOM_CAMERA, width=176, height=144, fps=15.0, fx=_FOCAL_1_PX, fy=_FOCAL_1_PX, cx=87.5, cy=71.5
)

CAMERAS: Final = {1: (FRONT_1, BOTTOM_1), 2: (FRONT_2, BOTTOM_2)}  #: front and bottom, by version


_PAVE: Final = {"h264": Codec.MPEG4_AVC, "mpeg4": Codec.MPEG4_VISUAL}  #: the codecs in the headers of frames
MP4_360P: Final = Format("mpeg4", 640, 360, 0)
H264_360P: Final = Format("h264", 640, 360, 1)
H264_720P: Final = Format("h264", 1280, 720, 2)
#: What is sent live for each value of ``video:video_codec``.
FORMATS: Final = {
    VideoCodec.MP4_360P: MP4_360P,
    VideoCodec.H264_360P: H264_360P,
    VideoCodec.MP4_360P_H264_720P: MP4_360P,
    VideoCodec.H264_720P: H264_720P,
    VideoCodec.MP4_360P_SLRS: MP4_360P,
    VideoCodec.H264_360P_SLRS: H264_360P,
    VideoCodec.H264_720P_SLRS: H264_720P,
    VideoCodec.H264_AUTO_RESIZE: H264_360P,
    VideoCodec.MP4_360P_H264_360P: MP4_360P,
}


class PavePacker:
    """Packs pictures of an AR.Drone 2: a PaVE header, and a picture in H.264 or MPEG-4.

    Args:
        clock: The drone's.
        header_size: 64 or 68 bytes.
        attitude: Returns theta, phi and psi [rad], for the header.
    """

    def __init__(self, clock: DroneClock, header_size: int, attitude: Callable[[], tuple[float, float, float]]) -> None:
        self._clock = clock
        self._header_size = header_size
        self._attitude = attitude
        self._made: tuple[tuple[Format, float, int], Encoder] | None = None
        self._number = 0
        self._position = 0

    def pack(self, picture: NDArray[np.uint8], settings: VideoSettings, captured_ns: int) -> Piece | None:
        """Encode a picture, with its header; None if the encoder gave nothing."""
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
            codec=_PAVE[form.codec],
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
    """Packs pictures of an AR.Drone 1: one picture in a datagram, each on its own."""

    def __init__(self) -> None:
        self._number = 0

    def pack(self, picture: NDArray[np.uint8], _settings: VideoSettings, _captured_ns: int) -> Piece | None:
        """Encode a picture."""
        self._number += 1
        return Piece(uvlc.encode(picture, self._number & 0xFFFFFFFF), starts=True)
