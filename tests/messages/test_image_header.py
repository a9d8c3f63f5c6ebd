"""The size in a picture's header, before any decoding."""

from __future__ import annotations

import struct

import pytest

from skyloop.messages.frame import image_size, why_not_decoded

SCAN_HEAD = b"\xff\xc0" + struct.pack(">HBHH", 11, 8, 240, 320) + bytes(4)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sI", 13, b"IHDR", 4), id="a PNG cut within its size"),
        pytest.param(b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"iTXt", 4, 3), id="a PNG without a header"),
        pytest.param(b"\xff\xd8\xff\xd9\xff\xd9", id="a JPEG with nothing but its end"),
        pytest.param(b"\xff\xd8\xff\xe0\x00", id="a JPEG cut within a length"),
        pytest.param(b"\xff\xd8\xff\xe0\x00\x01" + SCAN_HEAD, id="a JPEG with a segment shorter than its length"),
        pytest.param(b"\xff\xd8\xff\xc0\x00\x07" + bytes(8), id="a JPEG with a frame too short for a size"),
        pytest.param(b"\xff\xd8" + SCAN_HEAD[:8], id="a JPEG cut within its size"),
        pytest.param(b"GIF89a" + bytes(20), id="neither"),
    ],
)
def test_a_damaged_header_has_no_size(data: bytes) -> None:
    assert image_size(data) is None
    assert why_not_decoded(data) == "it is neither JPEG nor PNG, or it is damaged"


@pytest.mark.parametrize(
    "before", [b"", b"\x00\x00", b"\xff", b"\xff\x01", b"\xff\xd0", b"\xff\xe0\x00\x04\x00\x00"], ids=bytes.hex
)
def test_segments_that_decoders_skip_are_skipped(before: bytes) -> None:
    data = b"\xff\xd8" + before + SCAN_HEAD
    assert image_size(data) == (320, 240)
    assert why_not_decoded(data) == ""
