"""The emulated drone's video: the output of its encoders, and the thread that they run on."""

from __future__ import annotations

import logging
import sys
import threading
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.drivers.uri import parse_uri
from skyloop.errors import MissingExtraError, UsageError
from skyloop.transport.testing import wait_until
from skyloop.vehicles.ardrone.emulator.logic import VideoSettings
from skyloop.vehicles.ardrone.emulator.video import (
    BOTTOM_1,
    BOTTOM_2,
    BOTTOM_2_SENT,
    FORMATS,
    FRONT_1,
    FRONT_2,
    DroneClock,
    PavePacker,
    UvlcPacker,
)
from skyloop.vehicles.ardrone.video import cameras_of
from skyloop.vehicles.ardrone.wire import uvlc
from skyloop.vehicles.ardrone.wire.configuration import VideoChannel, VideoCodec
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType, PaveFrame, PaveParser
from skyloop.vehicles.emulation.video import (
    GROUP,
    Encoder,
    Piece,
    VideoEncoding,
    as_the_drone_does,
    require_encoder,
    with_inset,
)

av = pytest.importorskip("av")

SETTINGS = VideoSettings(VideoChannel.FRONT, VideoCodec.H264_360P, 30.0, 1000)
Picture = NDArray[np.uint8]


def plain(level: int, width: int = 64, height: int = 36) -> Picture:
    return np.full((height, width, 3), level, np.uint8)


def frames_of(count: int, settings: VideoSettings = SETTINGS, header_size: int = 68) -> list[PaveFrame]:
    """Return the frames that a client reads for this many pictures, each brighter than the last."""
    packer, parser = PavePacker(DroneClock(0), header_size, lambda: (0.1, 0.2, 0.3)), PaveParser()
    frames = []
    for n in range(count):
        piece = packer.pack(plain(20 + 5 * n), settings, n * 33_000_000)
        assert piece is not None
        frames += parser.feed(piece.data)
    assert parser.skipped_bytes == parser.buffered == 0
    return frames


# Cameras -------------------------------------------------------------------------------------------------------


def test_the_cameras_of_an_ar_drone_1_have_parrots_fields_of_view() -> None:
    (pixel,) = FRONT_1.project(np.array([[np.tan(np.radians(46.0)), 0.0, 1.0]]))
    assert pixel[0] - FRONT_1.cx == pytest.approx(np.hypot(320, 240) / 2, rel=0.01)
    assert np.hypot(176, 144) / 2 / BOTTOM_1.fx == pytest.approx(np.tan(np.radians(32.0)), rel=0.01)


def test_the_cameras_of_an_ar_drone_2_match_the_drivers() -> None:
    known = {camera.name: camera for camera in cameras_of(parse_uri("ardrone://127.0.0.1"), 2)}
    for model in (FRONT_2, BOTTOM_2_SENT):
        assert model.intrinsics() == known[model.name].intrinsics
        assert (model.width, model.height) == (known[model.name].width, known[model.name].height)
    assert (BOTTOM_2.width, BOTTOM_2.height) == (320, 180)


# Encoding ------------------------------------------------------------------------------------------------------


def test_key_pictures_are_as_frequent_as_the_drones() -> None:
    frames = frames_of(2 * GROUP + 1)
    assert [n for n, frame in enumerate(frames) if frame.is_key] == [0, GROUP, 2 * GROUP]
    assert {frame.type for frame in frames} == {FrameType.IDR, FrameType.P}
    assert [frame.number for frame in frames] == list(range(1, 2 * GROUP + 2))
    assert [frame.timestamp_ms for frame in frames[:4]] == [0, 33, 66, 99]


def test_a_payload_is_like_the_drones() -> None:
    key, other = frames_of(2)
    units = key.payload.split(b"\0\0\0\1")
    assert units[0] == b""
    assert [unit[0] for unit in units[1:]] == [0x67, 0x68, 0x65]
    assert units[1][1] == 66, "baseline"
    assert other.payload[:5] in (b"\0\0\0\1\x61", b"\0\0\0\1\x41")
    assert other.payload.count(b"\0\0\0\1") == 1


def test_other_units_are_dropped_and_start_codes_are_long() -> None:
    sei, sps, pps, idr = b"\6\5\1", b"\x67ab", b"\x68c", b"\x65defg"
    encoded = as_the_drone_does(b"\0\0\0\1" + sei + b"\0\0\1" + sps + b"\0\0\1" + pps + b"\0\0\1" + idr)
    assert encoded.payload == b"\0\0\0\1" + sps + b"\0\0\0\1" + pps + b"\0\0\0\1" + idr
    assert (encoded.sps_size, encoded.pps_size, encoded.key) == (7, 6, True)


@pytest.mark.parametrize("header_size", [64, 68])
@pytest.mark.parametrize(
    ("codec", "of", "size", "stream_id", "decoder"),
    [
        (VideoCodec.H264_360P, Codec.MPEG4_AVC, (640, 360), 1, "h264"),
        (VideoCodec.H264_720P, Codec.MPEG4_AVC, (1280, 720), 2, "h264"),
        (VideoCodec.MP4_360P_H264_720P, Codec.MPEG4_VISUAL, (640, 360), 0, "mpeg4"),
    ],
)
def test_the_stream_can_be_decoded(
    codec: VideoCodec, of: Codec, size: tuple[int, int], stream_id: int, decoder: str, header_size: int
) -> None:
    context = av.CodecContext.create(decoder, "r")
    frames = frames_of(4, replace(SETTINGS, codec=codec), header_size)
    assert {(frame.codec, (frame.width, frame.height), frame.stream_id) for frame in frames} == {(of, size, stream_id)}
    pictures = [picture for frame in frames for picture in context.decode(av.Packet(frame.payload))]
    pictures += context.decode(None)
    levels = [picture.to_ndarray(format="bgr24").mean() for picture in pictures]
    assert [(picture.width, picture.height) for picture in pictures] == [size] * 4
    assert levels == pytest.approx([20, 25, 30, 35], abs=2.5)


def test_every_value_of_the_codec_has_a_format() -> None:
    assert set(FORMATS) == {codec for codec in VideoCodec if codec >= VideoCodec.MP4_360P}


def test_an_encoder_with_another_bitrate_begins_with_a_key_picture() -> None:
    packer = PavePacker(DroneClock(0), 64, lambda: (0.0, 0.0, 0.0))
    pieces = [
        packer.pack(plain(50), replace(SETTINGS, bitrate_kbps=kbps), 0) for kbps in (1000, 1000, 2000, 2000, 1000)
    ]
    assert [piece is not None and piece.starts for piece in pieces] == [True, False, True, False, True]


def test_without_pyav_the_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install video"):
        require_encoder()


def test_pictures_of_any_size_are_scaled() -> None:
    encoder = Encoder(FORMATS[VideoCodec.H264_360P], 30.0, 1000)
    encoded = encoder.encode(plain(100, 320, 180))
    assert encoded is not None
    (picture,) = av.CodecContext.create("h264", "r").decode(av.Packet(encoded.payload)) or av.CodecContext.create(
        "h264", "r"
    ).decode(None)
    assert (picture.width, picture.height) == (640, 360)


def test_an_ar_drone_1_sends_each_picture_whole() -> None:
    packer, decoder = UvlcPacker(), uvlc.UvlcDecoder()
    for number, (width, height) in enumerate(((320, 240), (176, 144)), 1):
        piece = packer.pack(plain(90, width, height), SETTINGS, 0)
        assert piece is not None
        picture = decoder.decode(piece.data)
        assert picture.number == number
        assert picture.pixels.shape == (height, width, 3)
        assert picture.pixels.mean() == pytest.approx(90, abs=2)


def test_a_picture_in_the_corner_of_another() -> None:
    made = with_inset(plain(10, 40, 30), plain(200, 20, 20), (8, 6))
    assert (made[:6, :8] == 200).all()
    assert (made == 200).sum() == 8 * 6 * 3


# The thread ----------------------------------------------------------------------------------------------------


@dataclass
class Gate:
    """A packer that blocks in each picture until released."""

    entered: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    open: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    def pack(self, picture: Picture, settings: VideoSettings, captured_ns: int, /) -> Piece | None:
        self.entered.release()
        assert self.open.acquire(timeout=5)
        level = int(picture[-1, -1, 0])
        if level == 0:
            raise UsageError("too dark")
        return Piece(bytes([level, picture[0, 0, 0]]), starts=True)


def test_a_newer_picture_replaces_a_waiting_one() -> None:
    gate, sent = Gate(), list[bytes]()
    encoding = VideoEncoding(gate, lambda: SETTINGS, lambda piece: sent.append(piece.data))
    encoding.start()
    try:
        encoding.show("front", plain(1), 0)
        assert gate.entered.acquire(timeout=5)
        for level in (2, 3):
            encoding.show("front", plain(level), level)
        gate.open.release(2)
        wait_until(lambda: len(sent) == 2, "two pictures are sent")
        assert sent == [b"\1\1", b"\3\3"]
        assert encoding.status.pictures == 2
    finally:
        gate.open.release(9)
        encoding.stop()


def test_encoding_continues_after_a_picture_that_cannot_be_encoded(caplog: pytest.LogCaptureFixture) -> None:
    gate, sent = Gate(), list[bytes]()
    gate.open.release(9)
    encoding = VideoEncoding(gate, lambda: SETTINGS, lambda piece: sent.append(piece.data))
    encoding.start()
    try:
        with caplog.at_level(logging.ERROR):
            encoding.show("front", plain(0), 0)
            wait_until(lambda: caplog.records, "the error is logged")
        encoding.show("front", plain(7), 1)
        wait_until(lambda: sent, "the next one is sent")
    finally:
        encoding.stop()


@pytest.mark.parametrize(
    ("channel", "wanted", "sent"),
    [
        (VideoChannel.FRONT, {"front"}, [b"\x0a\x0a"]),
        (VideoChannel.BOTTOM, {"bottom"}, [b"\x14\x14"]),
        (VideoChannel.FRONT_WITH_BOTTOM, {"front", "bottom"}, [b"\x0a\x14"]),
        (VideoChannel.BOTTOM_WITH_FRONT, {"front", "bottom"}, [b"\x14\x0a"]),
    ],
)
def test_the_channel_selects_the_camera(channel: VideoChannel, wanted: set[str], sent: list[bytes]) -> None:
    gate, pieces = Gate(), list[bytes]()
    gate.open.release(9)
    settings = replace(SETTINGS, channel=channel)
    encoding = VideoEncoding(gate, lambda: settings, lambda piece: pieces.append(piece.data))
    assert {camera for camera in ("front", "bottom") if encoding.wants(camera)} == wanted
    pictures = {"front": plain(10, 160, 120), "bottom": plain(20, 160, 120)}
    for camera in ("bottom", "front") if channel in (0, 2) else ("front", "bottom"):  # the large picture comes last
        encoding.show(camera, pictures[camera], 0)
    encoding.start()
    try:
        wait_until(lambda: pieces, "a picture is sent")
        assert pieces == sent
    finally:
        encoding.stop()
