"""Recordings are read whole, truncated and damaged; other files are refused with a reason."""

from __future__ import annotations

import contextlib
from collections import Counter
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.messages import Encoding, Feedback, LogEntry, Parameter, ParameterType
from skyloop.recording.layout import Channel, image_topic
from skyloop.recording.pictures import RecordedImage, decode_image
from skyloop.recording.plain import TimeCourse, reported_ns, shifted
from skyloop.recording.reader import Item, Recording
from skyloop.recording.review.tables import tables
from skyloop.vehicles.replay.source import ReplaySource
from tests.support.recorded_flights import (
    BEGIN_NS,
    HEIGHT,
    MS,
    UNIX_NS,
    WIDTH,
    Plan,
    feedback_at,
    picture_at,
    write_flight,
)


def counts(path: Path) -> Counter[str]:
    recording = Recording.open(path)
    return Counter(item.channel.value for item in recording.items(recording.drones[0].name))


def test_properties(flight: Path) -> None:
    recording = Recording.open(flight)
    assert [drone.name for drone in recording.drones] == ["alpha"]
    assert recording.drone().described.vehicle == "sim"
    assert recording.cameras("alpha") == ["front"]
    assert recording.seconds == pytest.approx(1.98, abs=0.01)
    assert (recording.cut, recording.damaged) == ("", [])
    assert recording.end is not None
    assert recording.end.reason == "closed"
    own = {series.own.channel for series in recording.series if series.own is not None}
    assert own == set(Channel) - {Channel.ANNOTATIONS}
    assert {series.schema for series in recording.series if series.own is None} == {"foxglove.CompressedImage"}


def test_samples_are_in_order_and_typed(flight: Path) -> None:
    recording = Recording.open(flight)
    items = list(recording.items("alpha"))
    times = [item.entry.log_ns for item in items]
    assert times == sorted(times)
    assert Counter(item.channel for item in items)[Channel.COMMANDS] == 40
    feedback = next(item.value for item in items if item.channel is Channel.FEEDBACK)
    assert isinstance(feedback, Feedback)
    assert feedback.native == {"motor": 0.5, "note": "fine"}
    later = list(recording.items("alpha", (Channel.FEEDBACK,), from_ns=UNIX_NS + 1_500_000_000))
    assert len(later) == 25
    assert list(recording.items("beta")) == []


def test_progress_is_reported(flight: Path) -> None:
    told: list[float] = []
    for _ in Recording.open(flight).entries(progress=told.append):
        pass
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize("png", [True, False])
def test_images_are_decoded(tmp_path: Path, png: bool) -> None:
    path = write_flight(tmp_path / "flight.mcap", Plan(png=png, seconds=0.5))
    pictures = list(Recording.open(path).pictures("alpha", "front"))
    assert [picture.header.seq for picture in pictures] == [1, 2, 3, 4, 5]
    for picture in pictures:
        pixels, encoding = picture.as_recorded()
        assert encoding is Encoding.BGR8
        assert pixels.shape == (HEIGHT, WIDTH, 3)
        difference = np.abs(pixels.astype(int) - picture_at(picture.header.seq))
        assert difference.max() == 0 if png else difference.mean() < 6
        assert np.array_equal(picture.pixels(), pixels)


def test_images_and_samples_together(flight: Path) -> None:
    found = list(Recording.open(flight).items_and_pictures("alpha", (Channel.FRAMES, Channel.EVENTS)))
    assert sum(isinstance(one, RecordedImage) for one in found) == 20
    assert {one.channel for one in found if isinstance(one, Item)} == {Channel.EVENTS}


def test_unknown_names_are_reported(flight: Path) -> None:
    recording = Recording.open(flight)
    with pytest.raises(UnknownNameError, match="did you mean 'alpha'"):
        recording.drone("alfa")
    with pytest.raises(UnknownNameError, match="known: front"):
        next(recording.pictures("alpha", "sideways"))


# Incomplete and damaged files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_truncated_file_is_read_to_its_end(tmp_path: Path, compression: CompressionType) -> None:
    whole = write_flight(tmp_path / "whole.mcap", Plan(compression=compression, chunk_size=4096))
    last = Recording.open(whole).found.pieces[-1]
    data = whole.read_bytes()[: last.offset + last.size]
    before = 0
    for share in (0.3, 0.6, 0.9):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(data[: round(share * len(data))])
        recording = Recording.open(cut)
        assert recording.cut
        seen = sum(1 for _ in recording.items("alpha"))
        assert before < seen < sum(counts(whole).values())
        assert recording.damaged == []
        assert recording.cameras("alpha") == ["front"]
        before = seen


def test_a_damaged_chunk_is_skipped(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "flight.mcap", Plan(chunk_size=4096))
    whole = sum(counts(path).values())
    piece = Recording.open(path).found.pieces[2]
    data = bytearray(path.read_bytes())
    data[piece.offset + piece.size // 2] ^= 0xFF
    path.write_bytes(data)
    recording = Recording.open(path)
    seen = sum(1 for _ in recording.items("alpha"))
    assert 0.5 * whole < seen < whole
    assert any(f"at byte {piece.offset}" in words for words in recording.damaged)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damage_only_removes_samples(
    tmp_path_factory: pytest.TempPathFactory, flight: Path, data: st.DataObject
) -> None:
    content = bytearray(flight.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "torn.mcap"
    path.write_bytes(content)
    with contextlib.suppress(FileFormatError):
        recording = Recording.open(path)
        for one in recording.items_and_pictures(recording.drone().name, tuple(Channel)):
            if isinstance(one, RecordedImage):
                one.pixels()


def test_other_files_are_refused_with_a_reason(tmp_path: Path, flight: Path) -> None:
    path = tmp_path / "x.mcap"
    with pytest.raises(UsageError, match="No such file"):
        Recording.open(path)
    path.touch()
    with pytest.raises(FileFormatError, match="is empty"):
        Recording.open(path)
    path.write_bytes(b"\x00\x00\x00\x18ftypmp42")
    with pytest.raises(FileFormatError, match="is not an MCAP file: it begins with"):
        Recording.open(path)
    path.write_bytes(flight.read_bytes()[:20])
    with pytest.raises(FileFormatError, match="ends before its first sample"):
        Recording.open(path)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.register_channel("/camera", "json", writer.register_schema("x", "jsonschema", b"{}"))
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(FileFormatError, match=r"not a Skyloop recording \(its topics: /camera\)"):
        Recording.open(path)
    with pytest.raises(UsageError, match="Is a directory"):
        Recording.open(tmp_path)


def test_messages_outside_chunks_are_read(tmp_path: Path, flight: Path) -> None:
    source = Recording.open(flight)
    path = tmp_path / "flat.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("skyloop")
        for record in source.found.metadata:
            writer.add_metadata(record.name, record.metadata)
        schema = writer.register_schema("skyloop.Feedback", "jsonschema", b"{}")
        channel = writer.register_channel("/alpha/feedback", "json", schema)
        for entry in source.entries({"/alpha/feedback"}):
            writer.add_message(channel, entry.log_ns, entry.data, entry.publish_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    assert counts(path) == {"feedback": counts(flight)["feedback"]}


def test_a_malformed_message_is_counted(tmp_path: Path, flight: Path) -> None:
    path = tmp_path / "flat.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("skyloop")
        for record in Recording.open(flight).found.metadata:
            writer.add_metadata(record.name, record.metadata)
        schema = writer.register_schema("skyloop.Feedback", "jsonschema", b"{}")
        channel = writer.register_channel("/alpha/feedback", "json", schema)
        for data in (b"not json", b'{"captured_ns": "yesterday"}', b'{"captured_ns": 5}'):
            writer.add_message(channel, 1, data, 1)
        writer.finish()  # type: ignore[no-untyped-call]
    recording = Recording.open(path)
    assert [item.value.captured_ns for item in recording.items("alpha")] == [5]
    assert len(recording.damaged) == 2


def test_invalid_images() -> None:
    with pytest.raises(FileFormatError, match="frame 3 can't be decoded"):
        decode_image(b"\xff\xd8nonsense", "frame 3", grey=False)
    with pytest.raises(FileFormatError, match="can't be decoded"):
        decode_image(b"", "frame 3", grey=True)


# Times -------------------------------------------------------------------------------------------------------------


def feedback(ms: int) -> Feedback:
    return Feedback(captured_ns=ms * 1_000_000 - 5, published_ns=ms * 1_000_000)


def test_a_course_never_runs_backwards_and_ignores_wrong_times() -> None:
    course = TimeCourse()
    parameter = Parameter("a", ParameterType.FLOAT, 1.0)
    assert reported_ns(parameter) is None
    assert course.follow(parameter) == 0
    steps = [feedback(1000), feedback(1020), feedback(1010), feedback(10**9), feedback(1040)]
    assert [course.follow(step) // 1_000_000 for step in steps] == [1000, 1020, 1020, 1020, 1040]
    assert course.follow(LogEntry("me", "x", 2_000_000_000, number=1.0)) == 2_000_000_000
    assert course.first_ns == 1_000_000_000


def test_a_course_continues_when_the_proxys_computer_reboots() -> None:
    """Its clock restarts: the rest of the flight had no time, and 60 s became a point."""
    course = TimeCourse()
    flight = [(10**8 + 20 * step, 20 * step) for step in range(100)]
    flight += [(30_000 + 20 * step, 62_000 + 20 * step) for step in range(100)]  # 60 s later by the recorder's clock
    times = [course.follow(feedback(own), log * 1_000_000 + 1) // 1_000_000 - 10**8 for own, log in flight]
    assert times[99] == 1980
    assert times[100] == 1980, "a single time may be wrong"
    assert times[101:] == [62_020 + 20 * step for step in range(99)]
    late = shifted(feedback(30_000 + 20 * 100), course.shift_ns)
    assert late.published_ns // 1_000_000 - 10**8 == 62_000 + 20 * 100
    assert late.captured_ns == late.published_ns - 5


def test_a_flight_whose_proxy_rebooted_is_replayed_and_exported_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.support.recorded_flights._events", lambda *_: iter(()))  # their clock is the first one

    def after(at_ms: int) -> Feedback | None:
        if at_ms < 1000:
            return None
        sample, begun_ns = feedback_at(plan, at_ms, 1), (30_000 - 1000) * MS - BEGIN_NS
        return msgspec.structs.replace(
            sample, captured_ns=sample.captured_ns + begun_ns, published_ns=sample.published_ns + begun_ns
        )

    plan = Plan(seconds=2.0, frame_ms=0, command_ms=0, lossy=False, chunk_size=2048, extra=after)
    recording = Recording.open(write_flight(tmp_path / "flight.mcap", plan))
    times = tables(recording, "alpha", (Channel.FEEDBACK,))["feedback"]["t_s"]
    assert times[-1] == pytest.approx(1.98, abs=0.03)
    source = ReplaySource(recording, recording.drone())
    assert source.seconds == pytest.approx(1.98, abs=0.03)
    moment = source.moment(source.first_ns + 1500 * MS)
    assert moment.state is not None
    assert moment.state.position_m == pytest.approx(feedback_at(plan, 1500, 1).position_m, abs=0.03)
    assert moment.state.published_ns == pytest.approx(source.first_ns + 1500 * MS, abs=25 * MS)
    played = [one.value.published_ns for one in source.samples() if isinstance(one.value, Feedback)]
    steps = [(after - before) / MS for before, after in pairwise(played)]
    assert sum(abs(step - 20) > 1 for step in steps) <= 2, "except for the one sample at the change"


def test_times_of_applications_do_not_restart_the_clock() -> None:
    course = TimeCourse()
    assert course.follow(feedback(10**6)) == 10**12
    for _ in range(5):
        assert course.follow(LogEntry("me", "x", 1000, number=1.0)) == 10**12
        assert course.follow(feedback(1000)) == 10**12, "old, and the next is right again"
        assert course.follow(feedback(10**6)) == 10**12


def test_a_course_continues_after_a_long_pause() -> None:
    course = TimeCourse()
    hours = 5 * 3600 * 1000
    steps = [feedback(1000), feedback(hours), feedback(hours + 20), feedback(hours + 40)]
    assert [course.follow(step) // 1_000_000 for step in steps] == [1000, 1000, hours + 20, hours + 40]


def test_image_topics_match_the_layout(flight: Path) -> None:
    entries = list(Recording.open(flight).entries({image_topic("alpha", "front")}))
    assert [entry.sequence for entry in entries] == list(range(1, 21))
