"""Extract an image file from any message."""

from __future__ import annotations

import sys
from contextlib import suppress

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.messages import Encoding, FrameHeader
from skyloop.recording.layout import FrameRecord
from skyloop.recording.pictures import compressed, decode_image

RECORD = FrameRecord(FrameHeader("front", 1, 1, 2, 64, 48, Encoding.BGR8, 64 * 48 * 3), 3, "jpeg")


@given(st.binary(max_size=300), st.text(max_size=20))
def test_the_file_comes_out_unchanged(data: bytes, frame_id: str) -> None:
    message = CompressedImage(frame_id=frame_id, data=data, format="jpeg")
    message.timestamp.seconds = 12
    assert compressed(message.SerializeToString(), RECORD) == data


def test_unknown_fields_are_ignored() -> None:
    unknown = bytes.fromhex("78 ac02  7d 01020304  79 0102030405060708  7a 02 6869")  # field 15, in all four wire types
    message = CompressedImage(data=b"picture", format="jpeg").SerializeToString()
    assert compressed(unknown + message, RECORD) == b"picture"
    assert compressed(unknown, RECORD) == b"", "there is no image in it"


@pytest.mark.parametrize("message", ["7b", "80", "ff" * 11, "12 ff"], ids=["group", "cut", "endless", "size cut"])
def test_damage_is_reported_with_its_place(message: str) -> None:
    with pytest.raises(FileFormatError, match="damaged at byte"):
        compressed(bytes.fromhex(message), RECORD)


@given(st.binary(max_size=200))
def test_noise_is_an_image_or_an_error(noise: bytes) -> None:
    with suppress(FileFormatError):
        assert len(compressed(noise, RECORD)) <= len(noise)


def test_invalid_images_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    for data in (b"", b"no picture"):
        with pytest.raises(FileFormatError, match="frame 7 can't be decoded: it is neither JPEG nor PNG"):
            decode_image(data, "frame 7", grey=False)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match="vision"):
        decode_image(b"no picture", "frame 7", grey=False)
