"""The streams that an AR.Drone 2 has. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.sim.firmware.encoders import Format
from skyloop.wire.ardrone.keys import VideoCodec
from skyloop.wire.ardrone.pave import Codec

MP4_360P: Final = Format(Codec.MPEG4_VISUAL, 640, 360, 0)
H264_360P: Final = Format(Codec.MPEG4_AVC, 640, 360, 1)
H264_720P: Final = Format(Codec.MPEG4_AVC, 1280, 720, 2)
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
