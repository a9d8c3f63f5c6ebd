"""H.264 from subscription to file: units of any size, gaps, new sizes, streams that stop and return."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import EncodedFrame
from skyloop.recording.backlog import Backlog, Item, Rank
from skyloop.recording.layout import ClockPair, DroneRecord, FrameRecord, to_plain
from skyloop.recording.options import MB, Options
from skyloop.recording.reader import Recording
from skyloop.recording.taps import Stream
from skyloop.recording.translation import TranslatedImage, Translator
from skyloop.recording.writer import FileWriter
from tests.recording.streams import CAPABILITIES, Unit, film


class Rig:
    """A subscription whose stream is this test."""

    def __init__(self) -> None:
        self.items: list[Item] = []
        self.sink: Callable[[EncodedFrame], None] | None = None
        topic = SimpleNamespace(add=self._add, remove=self._remove, report=lambda seq, *, wants_key: None)
        drone = SimpleNamespace(_state=SimpleNamespace(video=SimpleNamespace(stream=lambda name, *, subscriber: topic)))
        self.stream = Stream(self._put, cast(Any, drone), "front")
        self.stream.start()

    def _add(self, sink: Callable[[EncodedFrame], None], count: Callable[[], int]) -> None:
        self.sink = sink

    def _remove(self, sink: Callable[[EncodedFrame], None]) -> None:
        assert sink is self.sink
        self.sink = None

    def _put(self, channel: str, rank: Rank, sample: Any, size: int, now_ns: int) -> None:
        self.items.append(Item(0, channel, rank, now_ns, sample, size))

    def send(self, *units: Unit, codec: str = "h264") -> None:
        for unit in units:
            assert self.sink is not None
            at_ns = unit.captured_ns
            size = (unit.width, unit.height)
            self.sink(EncodedFrame("front", unit.number, at_ns, at_ns, *size, codec, unit.key, unit.data))

    @property
    def numbers(self) -> list[int]:
        return [item.sample.record.header.seq for item in self.items]

    def written(self, path: Path) -> list[Any]:
        """Write the received samples and read them again."""
        clock = ClockPair(0, 1_760_000_000_000_000_000, 1)
        backlog = Backlog(64 * MB)
        translators = [Translator("alpha", CAPABILITIES, clock)]
        drones = [DroneRecord("alpha", "sim://", to_plain(CAPABILITIES))]
        options = Options(min_free_mb=0.0)
        writer = FileWriter(path, options, backlog, drones, translators, clock, lambda *_: None)
        for item in self.items:
            backlog.put(item)
        writer.start()
        writer.stop()
        assert backlog.dropped == {}
        return list(Recording.open(path).pictures("alpha", "front"))


def padded(unit: Unit, size: int) -> Unit:
    """Return the same image in a unit of this size, with filler data like constant-rate encoders."""
    return unit.with_data(unit.data + b"\0\0\1\x0c" + b"\xff" * (size - len(unit.data) - 5) + b"\x80")


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.mark.parametrize("size", [70_000, 2_000_000])
def test_units_of_any_size_are_kept_unchanged(rig: Rig, tmp_path: Path, size: int) -> None:
    sent = [padded(unit, size) if unit.key else unit for unit in film(10)]
    rig.send(*sent)
    found = rig.written(tmp_path / "flight.mcap")
    assert [picture.compressed for picture in found] == [unit.data for unit in sent]
    assert all(item.size >= len(unit.data) for item, unit in zip(rig.items, sent, strict=True))
    assert [picture.pixels().shape for picture in found] == [(48, 64, 3)] * 10


def test_another_size_in_mid_stream_is_kept_and_shown(rig: Rig, tmp_path: Path) -> None:
    sent = [*film(10), *film(10, 96, 64, 11), *film(5, first=21)]
    rig.send(*sent)
    found = rig.written(tmp_path / "flight.mcap")
    assert [picture.compressed for picture in found] == [unit.data for unit in sent]
    assert [picture.pixels().shape[:2] for picture in found] == [(unit.height, unit.width) for unit in sent]
    assert np.array_equal(found[20].pixels(), found[0].pixels())
    assert (rig.stream.gaps.missed, rig.stream.dropped) == (0, 0)


def test_after_a_gap_it_continues_with_the_next_key_frame(rig: Rig, tmp_path: Path) -> None:
    rig.send(*(unit for unit in film() if unit.number not in (8, 9)))
    assert rig.numbers == [*range(1, 8), *range(11, 21)]
    assert (rig.stream.gaps.missed, rig.stream.dropped) == (2, 1)
    assert all(picture.can_be_decoded for picture in rig.written(tmp_path / "flight.mcap"))


def test_frames_before_the_first_key_frame_do_not_count_as_lost(rig: Rig) -> None:
    rig.send(*film()[3:])
    assert rig.numbers == list(range(6, 21))
    assert (rig.stream.gaps.missed, rig.stream.dropped) == (0, 0)


@pytest.mark.parametrize("first", [1, 9, 8, 500])
def test_a_returning_stream_starts_with_a_key_frame(rig: Rig, tmp_path: Path, first: int) -> None:
    """Whatever its numbers: a driver that found its vehicle again may restart its count."""
    again = film(10, first=first)
    rig.send(*film(8), *again[2:])  # its key frame and one more were not received
    if first + 2 == 9 + 2:
        assert rig.stream.gaps.missed == 2
    assert rig.numbers[:8] == list(range(1, 9))
    assert rig.numbers[8:] == [first + n for n in range(5, 10)]
    found = rig.written(tmp_path / "flight.mcap")
    assert np.array_equal(found[8].pixels(), found[5].pixels())  # both are the sixth image of the film


def test_another_codec_than_announced_is_not_kept(rig: Rig) -> None:
    before_ns = rig.stream.newest_ns
    rig.send(*film(5), codec="h265")
    assert rig.items == []
    assert rig.stream.newest_ns == before_ns  # so decoded frames are recorded soon
    rig.stream.stop()
    assert rig.sink is None


@given(st.lists(st.integers(0, 19), max_size=40))
def test_any_kept_frames_can_be_decoded(order: list[int]) -> None:
    rig = Rig()
    rig.send(*(film()[n] for n in order))
    last: int | None = None
    for item in rig.items:
        assert isinstance(item.sample, TranslatedImage)
        record: FrameRecord = item.sample.record
        assert record.key or (last is not None and record.header.seq == last + 1)
        last = record.header.seq
