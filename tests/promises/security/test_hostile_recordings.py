"""Malicious recordings: none costs more than its own size explains, and none ends in a traceback."""

from __future__ import annotations

import contextlib
import json
import math
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import lz4.frame
import msgspec
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from skyloop import pyav
from skyloop.cli import main
from skyloop.cockpit.recordings import Recordings
from skyloop.errors import FileFormatError, SkyloopError
from skyloop.messages.frame import MAX_PIXELS, MAX_SCANS, image_size, why_not_decoded
from skyloop.recording import scan
from skyloop.recording.layout import Channel
from skyloop.recording.listing import describe
from skyloop.recording.pictures import FrameGroup, RecordedImage, decode_image
from skyloop.recording.reader import Recording
from skyloop.recording.review.report import write_report
from skyloop.recording.review.summary import recover, summarise
from skyloop.recording.review.tables import export_csv, export_npz, read
from skyloop.vehicles.replay.source import ReplaySource
from tests.support.commands import Ended
from tests.support.recorded_flights import Plan, write_flight

MAX_NS = (1 << 63) - 1
RECORD = struct.Struct("<BQ")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(tmp_path_factory.mktemp("flights") / "flight.mcap", Plan(seconds=0.5))


def record(opcode: int, content: bytes) -> bytes:
    return RECORD.pack(opcode, len(content)) + content


def chunk(compression: str, packed: bytes, unpacked: int, *, start: int = 1, end: int = 2, crc: int = 0) -> bytes:
    name = compression.encode()
    head = struct.pack("<QQQII", start, end, unpacked, crc, len(name)) + name
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def with_records(path: Path, flight: Path, *records: bytes) -> Path:
    """A recording with its metadata, these records, and no end, as a killed recorder leaves it."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("skyloop")
        for one in Recording.open(flight).found.metadata:
            writer.add_metadata(one.name, one.metadata)
        for each in records:
            file.write(each)
    return path


def with_messages(path: Path, flight: Path, topic: str, *messages: bytes, log_ns: int = 1) -> Path:
    """A complete recording with these messages of one channel, and the metadata of another."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("skyloop")
        for one in Recording.open(flight).found.metadata:
            writer.add_metadata(one.name, one.metadata)
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel(topic, "json", schema)
        for number, data in enumerate(messages):
            writer.add_message(channel, log_ns, data, log_ns, number)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


ZEROS = 1 << 28


def zstd_zeros() -> bytes:
    return chunk("zstd", zstandard.ZstdCompressor().compress(bytes(ZEROS)), ZEROS)


def zstd_that_lies() -> bytes:
    return chunk("zstd", zstandard.ZstdCompressor().compress(bytes(ZEROS)), 1000)


def zstd_without_size() -> bytes:
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    packed = b"".join(compressor.compress(bytes(1 << 20)) for _ in range(ZEROS >> 20)) + compressor.flush()
    return chunk("zstd", packed, 1 << 16)


def lz4_zeros() -> bytes:
    return chunk("lz4", lz4.frame.compress(bytes(ZEROS)), ZEROS)


def empty_records() -> bytes:
    content = record(0x80, b"") * ((8 << 20) // 9)
    return chunk("zstd", zstandard.ZstdCompressor().compress(content), len(content))


def empty_messages() -> bytes:
    content = record(5, struct.pack("<HIQQ", 1, 0, 1, 1)) * ((8 << 20) // 31)
    return chunk("lz4", lz4.frame.compress(content), len(content))


BOMBS = [zstd_zeros, zstd_that_lies, zstd_without_size, lz4_zeros, empty_records, empty_messages]

# In a separate process, as peak memory never decreases.
_LOOK = """
import resource, sys, time
from skyloop.recording.reader import Recording
for path in sys.argv[1:]:
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    recording = Recording.open(path)
    count = sum(1 for _ in recording.entries())
    kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(kb, time.process_time() - began, recording.damaged, sep="|")
"""


@pytest.mark.process
def test_a_small_file_takes_little_memory_and_time_whatever_it_unpacks_to(tmp_path: Path, flight: Path) -> None:
    paths = [with_records(tmp_path / f"{bomb.__name__}.mcap", flight, bomb()) for bomb in BOMBS]
    assert max(path.stat().st_size for path in paths) < 2e6
    done = subprocess.run([sys.executable, "-c", _LOOK, *map(str, paths)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    for path, line in zip(paths, done.stdout.splitlines(), strict=True):
        memory_kb, seconds, damaged = line.split("|")
        assert damaged != "[]", f"{path.name} is reported as damaged"
        assert float(memory_kb) < 70_000, path.name
        assert float(seconds) < 2.0, path.name


def test_recorders_stay_within_the_limits(tmp_path: Path) -> None:
    """Pictures and telemetry that never change: no real data compresses better."""
    still = cv2.imencode(".png", np.zeros((720, 1280, 3), np.uint8))[1].tobytes()
    for kind in (CompressionType.ZSTD, CompressionType.LZ4):
        plan = Plan(seconds=4.0, compression=kind, chunk_size=4 << 20, packed=lambda _: still)
        recording = Recording.open(write_flight(tmp_path / f"{kind.name}.mcap", plan))
        assert sum(1 for _ in recording.entries()) > 300
        assert recording.damaged == []
        ratios = [piece.unpacked / piece.size for piece in recording.found.pieces]
        assert max(ratios) < scan.MAX_RATIO / 3


def test_a_part_that_is_too_large_is_reported_and_the_rest_is_read(tmp_path: Path, flight: Path) -> None:
    one = record(3, struct.pack("<HI", 9, 1) + b"s" + bytes(8))
    path = with_records(tmp_path / "x.mcap", flight, zstd_zeros(), chunk("", one, len(one)))
    recording = Recording.open(path)
    assert list(recording.entries()) == []
    assert f"claim to unpack to {ZEROS}" in " ".join(recording.damaged)


def test_metadata_and_channels_without_end_are_left_out(
    tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "MAX_HEAD", 100_000)
    monkeypatch.setattr(scan, "MAX_RECORD", 50_000)
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("skyloop")
        for one in Recording.open(flight).found.metadata:
            writer.add_metadata(one.name, one.metadata)
        writer.add_metadata("x", {"x": "x" * 60_000})
        for number in range(100):
            writer.add_metadata("x", {"x": "x" * 10_000})
            writer.register_channel("t" * 10_000 + str(number), "json", 0)
        writer.finish()  # type: ignore[no-untyped-call]
    found = Recording.open(tmp_path / "x.mcap").found
    kept = sum(len(str(one.metadata)) for one in found.metadata) + sum(
        len(one.topic) for one in found.channels.values()
    )
    assert kept < 120_000
    assert any("the rest are skipped" in words for words in found.damaged)
    assert any("at most 50000 are read" in words for words in found.damaged)


def test_records_without_end_are_read_up_to_a_limit(
    tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "MAX_RECORDS", 1000)
    recording = Recording.open(with_records(tmp_path / "x.mcap", flight, record(0x80, b"") * 5000))
    assert "too many records" in recording.cut


def test_messages_outside_chunks_are_read_in_parts(
    tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "_RUN", 1000)
    messages = [record(5, struct.pack("<HIQQ", 1, number, number + 1, 1) + bytes(69)) for number in range(100)]
    channel = record(4, struct.pack("<HH", 1, 0) + struct.pack("<I", 2) + b"/x" + bytes(8))
    recording = Recording.open(with_records(tmp_path / "x.mcap", flight, channel, *messages))
    assert [entry.sequence for entry in recording.entries()] == list(range(100))
    assert max(piece.size for piece in recording.found.pieces) <= 1000


# Pictures ------------------------------------------------------------------------------------------------------


def png(width: int, height: int) -> bytes:
    def part(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(bytes(100))) + part(b"IEND", b"")


def jpeg(width: int, height: int, *, scans: int = 1, filler: bytes = b"") -> bytes:
    start = b"\xff\xc2" + struct.pack(">HBHHB", 11, 8, height, width, 1) + bytes((1, 0x11, 0))
    return b"\xff\xd8" + filler + start + (b"\xff\xda" + struct.pack(">H", 8) + bytes(6)) * scans + b"\xff\xd9"


@pytest.mark.parametrize(
    "data",
    [
        png(30_000, 30_000),
        jpeg(30_000, 30_000),
        jpeg(65535, 1000),
        png(1 << 31, 1),
        jpeg(640, 480, scans=MAX_SCANS + 1),
    ],
)
def test_a_picture_is_refused_by_its_head(data: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it came to the decoder"))
    with pytest.raises(FileFormatError, match="at most"):
        decode_image(data, "frame 1", grey=False)


@pytest.mark.parametrize(
    "data", [b"", b"BM" + bytes(60), b"II*\0" + bytes(60), b"P6 30000 30000 255\n", b"\xff\xd8\xff"]
)
def test_data_that_is_neither_jpeg_nor_png_does_not_reach_a_decoder(
    data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it came to the decoder"))
    with pytest.raises(FileFormatError, match="neither JPEG nor PNG"):
        decode_image(data, "frame 1", grey=False)


def test_the_head_tells_the_size_that_a_decoder_finds() -> None:
    image = np.zeros((48, 65, 3), np.uint8)
    for ending, options in (
        (".png", []),
        (".jpg", []),
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 1]),
    ):
        data = cv2.imencode(ending, image, options)[1].tobytes()
        assert image_size(data) == (65, 48)
        assert why_not_decoded(data) == ""
        assert decode_image(data, "x", grey=False).shape == (48, 65, 3)
    filler = b"\xff\xe1\x00\x04\xff\xc0" + b"\x00junk" + b"\xff\xff\xfe\x00\x02"
    assert image_size(jpeg(7, 5, filler=filler)) == (7, 5), (
        "the size of the frame, not of what another segment contains"
    )
    assert MAX_PIXELS >= 7680 * 4320


def test_a_recorded_picture_of_gigabytes_is_a_damaged_one(tmp_path: Path) -> None:
    huge = png(30_000, 30_000)
    path = write_flight(
        tmp_path / "x.mcap", Plan(seconds=0.5, png=True, packed=lambda number: huge if number == 2 else None)
    )
    good, bad, *others = Recording.open(path).pictures("alpha", "front")
    with pytest.raises(FileFormatError, match="announces 30000 × 30000 pixels"):
        bad.pixels()
    assert {one.pixels().shape for one in (good, *others)} == {(48, 64, 3)}


# Values --------------------------------------------------------------------------------------------------------

NESTED = (
    b'{"processor":"x","worker":1,"number":1,"camera":"front","seq":1,"captured_ns":1,"made_ns":1,"took_ns":1,'
    b'"value":%s}'
)
FEEDBACK = b'{"captured_ns":%s,"seq":%s,"published_ns":%s,"battery":%s,"native":{"x":%s}}'
HUGE = b"9" * 400
VALUES = {
    "nested_results": ("results", NESTED % (b"[" * 5000 + b"]" * 5000)),
    "rather_nested_results": ("results", NESTED % (b"[" * 900 + b"]" * 900)),
    "nested_elsewhere": ("events", b'{"x":' + b"[" * 5000 + b"]" * 5000 + b"}"),
    "huge_results": ("results", NESTED % HUGE),
    "huge_time": ("feedback", FEEDBACK % (HUGE, b"1", b"1", b"0.5", b"1")),
    "large_time": ("feedback", FEEDBACK % (b"%d" % MAX_NS, b"%d" % MAX_NS, b"%d" % MAX_NS, b"0.5", b"1")),
    "negative_time": ("feedback", FEEDBACK % (b"-%d" % MAX_NS, b"-%d" % MAX_NS, b"-%d" % MAX_NS, b"1e308", b"1e308")),
    "beyond_64_bits": ("feedback", FEEDBACK % (b"18446744073709551615", b"1", b"1", b"0.5", b"1")),
    "huge_sequence": ("feedback", FEEDBACK % (b"1", HUGE, b"1", b"0.5", b"1")),
    "odd_native": ("feedback", FEEDBACK % (b"1", b"1", b"1", b"9e29", b'"="')),
    "huge_native": ("feedback", FEEDBACK % (b"1", b"1", b"1", b"0.5", HUGE)),
    "large_native": ("feedback", FEEDBACK % (b"1", b"1", b"1", b"-1e308", b"[1e308,-1e308]")),
    "mixed_native": ("feedback", FEEDBACK % (b"1", b"1", b"1", b"1e308", b"9223372036854775808")),
    "huge_parameter": ("parameters", b'{"name":"x","type":"int","value":%s}' % HUGE),
    "huge_drops": ("drops", b'{"at_ns":1,"dropped":{"x":%s},"missed":{}}' % HUGE),
    "not_utf8": ("logs", b'{"at_ns":1,"source":"\xff","name":"x","text":"x"}'),
}


def everything(path: Path, folder: Path) -> None:
    """Every operation on a recording."""
    recording = Recording.open(path)
    describe(path)
    name = recording.drone().name
    for one in recording.items_and_pictures(name, tuple(Channel)):
        if isinstance(one, RecordedImage):
            one.pixels()
    summarise(recording)
    for _ in ReplaySource(recording, recording.drone()).samples():
        pass
    acts: list[Callable[[], object]] = [
        lambda: export_csv(read(recording, name, None), folder / "csv"),
        lambda: export_npz(read(recording, name, None), folder / "x.npz"),
        lambda: write_report(recording, name, folder / "x.html"),
        lambda: recover(recording, folder / "recovered.mcap"),
    ]
    for number, act in enumerate(acts):
        try:
            act()
        except SkyloopError:
            assert number < 3, "damaged recordings can be recovered"


@pytest.mark.parametrize("name", VALUES)
def test_unusable_values_are_counted_and_left_out(name: str, tmp_path: Path, flight: Path) -> None:
    channel, message = VALUES[name]
    good = b'{"captured_ns":5,"published_ns":6,"seq":1}'
    messages = [good, message, message, good] if channel == "feedback" else [message]
    path = with_messages(tmp_path / "x.mcap", flight, f"/alpha/{channel}", *messages)
    everything(path, tmp_path)


def test_a_message_with_an_invalid_time_is_left_out(tmp_path: Path, flight: Path) -> None:
    for log_ns in (0, MAX_NS, (1 << 64) - 1):
        path = with_messages(tmp_path / "x.mcap", flight, "/alpha/feedback", b'{"captured_ns":5}', log_ns=log_ns)
        (tmp_path / "recovered.mcap").unlink(missing_ok=True)
        everything(path, tmp_path)
        recording = Recording.open(path)
        assert len(list(recording.items("alpha"))) == (log_ns <= MAX_NS)
        assert bool(recording.damaged) == (log_ns > MAX_NS)
        assert math.isfinite(recording.seconds)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("started_unix_ns", "9" * 400),
        ("started_unix_ns", "1e400"),
        ("started_unix_ns", "-1"),
        ("layout", "{}"),
        ("file", "9" * 40),
        ("drones", "[" * 5000 + "]" * 5000),
        ("drones", '[{"name":"alpha","capabilities":{"vehicle":' + "[" * 900 + "]" * 900 + "}}]"),
        ("drones", '[{"name":"alpha","capabilities":{"cameras":7}}]'),
        ("drones", '[{"name":"alpha","clock_offset_ns":%s}]' % ("9" * 300)),
        ("monotonic_ns", "9" * 400),
        ("unix_ns", '"yesterday"'),
    ],
)
def test_invalid_metadata_is_refused_with_a_clear_error(key: str, value: str, tmp_path: Path, flight: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("skyloop")
        for one in Recording.open(flight).found.metadata:
            changed = {**one.metadata, **({key: value} if key in one.metadata else {})}
            writer.add_metadata(one.name, changed)
        writer.finish()  # type: ignore[no-untyped-call]
    with contextlib.suppress(SkyloopError):
        everything(path, tmp_path)
    described = describe(path)
    assert described.problem or described.drones == ("alpha",)


# Folders -------------------------------------------------------------------------------------------------------


def test_a_bad_file_is_a_row_with_its_reason(tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad, worse = (tmp_path / name for name in ("good.mcap", "bad.mcap", "worse.mcap"))
    good.write_bytes(flight.read_bytes())
    bad.write_bytes(b"no recording")
    worse.write_bytes(flight.read_bytes())
    assert describe(good).drones == ("alpha",)
    assert "not an MCAP file" in describe(bad).problem
    assert "No such file" in describe(tmp_path / "gone.mcap").problem

    def fail(_: Path) -> Recording:
        raise OverflowError("what nobody thought of")

    monkeypatch.setattr(Recording, "open", fail)
    assert "what nobody thought of" in describe(worse).problem


def test_a_file_name_that_is_not_text_hides_no_other(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One name that was not UTF-8 emptied the whole list, in the cockpit and in the terminal."""
    for name in (b"good.mcap", b"caf\xe9.mcap"):
        (Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))).write_bytes(flight.read_bytes())
    with pytest.raises(SystemExit):
        main(["log", "list", str(tmp_path), "--json"])
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == ["caf\\xe9.mcap", "good.mcap"]
    assert [row["drones"] for row in rows] == [["alpha"], ["alpha"]]
    recordings = Recordings(tmp_path)
    listed = recordings._past()
    assert {row["name"] for row in msgspec.json.decode(msgspec.json.encode(listed))} == {"caf\\xe9.mcap", "good.mcap"}
    assert recordings._path("caf\\xe9.mcap").read_bytes() == flight.read_bytes()


def test_the_terminals_list_shows_all_recordings(
    tmp_path: Path, flight: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def log(*words: str | Path) -> Ended:
        with pytest.raises(SystemExit) as ended:
            main(["log", *map(str, words)])
        return Ended(int(ended.value.code or 0), *capsys.readouterr())

    monkeypatch.setenv("COLUMNS", "300")

    (tmp_path / "good.mcap").write_bytes(flight.read_bytes())
    (tmp_path / "bad.mcap").write_bytes(b"no recording")
    ended = log("list", tmp_path)
    assert ended.code == 0
    assert [line.split()[0] for line in ended.out.splitlines()] == ["recording", "bad.mcap", "good.mcap"]
    assert "it begins with b'no recor'" in ended.out
    rows = {row["name"]: row for row in json.loads(log("list", tmp_path, "--json").out)}
    assert rows["good.mcap"]["drones"] == ["alpha"]
    assert "not an MCAP file" in rows["bad.mcap"]["problem"]
    assert log("list", tmp_path / "gone").code == 2
    (tmp_path / "empty").mkdir()
    assert "No recording" in log("list", tmp_path / "empty").out


def test_h264_is_refused_by_the_size_in_its_head(monkeypatch: pytest.MonkeyPatch) -> None:
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt, context.time_base = 640, 480, "yuv420p", Fraction(1, 30)
    context.options = {"tune": "zerolatency"}
    image = av.VideoFrame.from_ndarray(np.zeros((480, 640, 3), np.uint8), format="bgr24")
    unit = b"".join(bytes(packet) for packet in [*context.encode(image), *context.encode(None)])
    group = FrameGroup()
    group.add(unit)
    assert group.pixels(0, "frame 1").shape == (480, 640, 3)
    monkeypatch.setattr(pyav, "MAX_PIXELS", 640 * 479)
    group = FrameGroup()
    group.add(unit)
    with pytest.raises(FileFormatError, match="can't be decoded"):
        group.pixels(0, "frame 1")


def test_listing_unpacks_nothing(tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan, "records", lambda *_: pytest.fail("it was unpacked"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flight.read_bytes()[:-2000])
    for path in (flight, cut):
        assert describe(path).drones == ("alpha",)
