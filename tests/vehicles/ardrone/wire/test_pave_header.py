"""Headers of PaVE frames, built and compared with those of real drones."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType, PaveParser, build_header
from tests.support.recordings import recorded


def test_the_first_header_of_a_real_drone_with_recent_firmware() -> None:
    real = recorded("ardrone2/video-8s.pave").read_bytes()[:68]
    header = build_header(
        payload_size=10253,
        type=FrameType.IDR,
        number=190195,
        timestamp_ms=6215152,
        width=640,
        height=360,
        position=792483264,
        sps_size=14,
        pps_size=10,
        stream_id=1,
    )
    assert header[:56] == real[:56]
    assert len(header) == 68


def test_the_first_header_of_a_real_drone_with_early_firmware() -> None:
    real = recorded("ardrone2/video-64-byte-headers.pave").read_bytes()[:64]
    header = build_header(
        payload_size=2632,
        type=FrameType.P,
        number=17368,
        timestamp_ms=1792570814,
        width=640,
        height=360,
        position=72366960,
        stream_id=5,
        header_size=64,
    )
    assert header == real


@given(
    payload=st.binary(min_size=1, max_size=200),
    type=st.sampled_from(FrameType),
    codec=st.sampled_from(Codec),
    number=st.integers(0, 1 << 40),
    timestamp_ms=st.integers(0, 1 << 40),
    width=st.integers(1, 1280),
    height=st.integers(1, 720),
    stream_id=st.integers(0, 0xFFFF),
    position=st.integers(0, 1 << 63),
    header_size=st.sampled_from([64, 68]),
)
def test_built_headers_are_parsed(
    payload: bytes,
    type: FrameType,
    codec: Codec,
    number: int,
    timestamp_ms: int,
    width: int,
    height: int,
    stream_id: int,
    position: int,
    header_size: int,
) -> None:
    header = build_header(
        payload_size=len(payload),
        type=type,
        number=number,
        timestamp_ms=timestamp_ms,
        width=width,
        height=height,
        codec=codec,
        stream_id=stream_id,
        position=position,
        header_size=header_size,
        attitude_rad=(0.1, -0.2, 3.0),
    )
    assert len(header) == header_size
    parser = PaveParser()
    frames = parser.feed(header + payload)
    parser.end()
    if b"PaVE" in payload:  # may look like the next frame
        return
    (frame,) = frames
    assert (frame.codec, frame.type, frame.width, frame.height) == (codec, type, width, height)
    assert (frame.number, frame.timestamp_ms) == (number & 0xFFFFFFFF, timestamp_ms & 0xFFFFFFFF)
    assert (frame.stream_id, frame.payload) == (stream_id, payload)


def test_another_size_is_refused() -> None:
    with pytest.raises(UsageError, match="must be 64"):
        build_header(payload_size=1, type=FrameType.P, number=1, timestamp_ms=0, width=640, height=360, header_size=60)
