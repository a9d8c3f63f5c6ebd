"""A recording's index agrees with a scan of the whole file, or is not trusted."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from skyloop.errors import UsageError
from skyloop.recording.reader import Entry, Recording
from skyloop.recording.scan import Scan, indexed, scan
from tests.recording.streams import film, write_film


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("index")


@pytest.fixture(scope="module")
def kept(folder: Path) -> Path:
    """A recording with an index; do not modify."""
    return write_film(folder / "kept.mcap", film())


def known(found: Scan | None) -> dict[str, object]:
    assert found is not None
    names = ("size", "schemas", "channels", "metadata", "attachments", "cut", "damaged", "head")
    pieces = [replace(piece, crc=None) for piece in found.pieces]  # checksums from the index are read later
    return {"pieces": pieces, **{name: getattr(found, name) for name in names}}


def read(path: Path) -> list[Entry]:
    return list(Recording.open(path).entries())


def test_it_agrees_with_a_scan(kept: Path, flight: Path) -> None:
    for path in (kept, flight):
        assert known(indexed(path)) | {"head": 0} == known(scan(path)) | {"head": 0}
    assert len(read(kept)) == 40


def test_attachments_and_messages_between_chunks(folder: Path) -> None:
    for chunked in (True, False):
        path = folder / f"{chunked}.mcap"
        with path.open("wb") as file:
            writer = Writer(file, compression=CompressionType.NONE, use_chunking=chunked)
            writer.start("x", "test")
            channel = writer.register_channel("/a", "json", 0)
            writer.add_message(channel, 1, b"{}", 1)
            writer.add_attachment(1, 1, "a", "text/plain", b"attached")
            writer.add_message(channel, 2, b"{}", 2)
            writer.finish()  # type: ignore[no-untyped-call]
        found = indexed(path)
        assert (found is not None) == chunked  # messages outside chunks are in no index
        if found is not None:
            assert known(found) | {"head": 0} == known(scan(path)) | {"head": 0}
            assert len(found.attachments) == 1


def test_opening_reads_no_chunk(kept: Path, folder: Path) -> None:
    data = bytearray(kept.read_bytes())
    pieces = Recording.open(kept).found.pieces
    begin, end = pieces[1].offset - 52, pieces[1].offset + pieces[1].size
    data[begin:end] = bytes(end - begin)
    path = folder / "blank.mcap"
    path.write_bytes(data)
    recording = Recording.open(path)
    assert recording.found.pieces == pieces
    assert len(list(recording.entries())) == 30
    assert recording.damaged == [f"at byte {pieces[1].offset}: the file's index points to a chunk that is not there"]


def test_a_chunk_whose_size_differs_from_the_index(kept: Path, folder: Path) -> None:
    data = bytearray(kept.read_bytes())
    piece = Recording.open(kept).found.pieces[1]
    data[piece.offset - 43 + 16 : piece.offset - 43 + 24] = struct.pack("<Q", piece.unpacked + 1)
    path = folder / "sized.mcap"
    path.write_bytes(data)
    recording = Recording.open(path)
    assert len(list(recording.entries())) == 30
    assert "a chunk's size differs from the file's index" in recording.damaged[0]


@given(st.data())
def test_an_index_with_a_wrong_byte_is_not_trusted(kept: Path, folder: Path, data: st.DataObject) -> None:
    whole = kept.read_bytes()
    (summary,) = struct.unpack_from("<Q", whole, len(whole) - 8 - 20)
    at = data.draw(st.integers(summary, len(whole) - 1))
    flip = data.draw(st.integers(1, 255))
    path = folder / "flipped.mcap"
    path.write_bytes(whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :])
    assert indexed(path) is None
    assert len(read(path)) == 40


@given(st.data())
def test_the_index_of_a_file_with_a_part_cut_out_is_not_trusted(kept: Path, folder: Path, data: st.DataObject) -> None:
    whole = kept.read_bytes()
    begin = data.draw(st.integers(0, len(whole) - 1))
    end = data.draw(st.integers(begin + 1, len(whole)))
    path = folder / "shorter.mcap"
    path.write_bytes(whole[:begin] + whole[end:])
    assert indexed(path) is None


@given(st.binary(max_size=200))
def test_other_data_has_no_index(folder: Path, data: bytes) -> None:
    path = folder / "any.mcap"
    path.write_bytes(data)
    assert indexed(path) is None


def test_a_missing_file(folder: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        indexed(folder / "nothing.mcap")
