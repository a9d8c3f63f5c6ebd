"""The writing thread's steps: rotation, disks that fill up, hang or vanish, and its reports."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skyloop.clock import NS_PER_S
from skyloop.errors import UsageError
from skyloop.messages import (
    Applied,
    Capabilities,
    Encoding,
    Feedback,
    FrameHeader,
    Idle,
    Parameter,
    ParameterType,
    Severity,
)
from skyloop.recording import layout
from skyloop.recording.backlog import Backlog, Item, Rank
from skyloop.recording.layout import META_END, META_RECORDING, ClockPair, DroneRecord, End, FrameRecord, Start
from skyloop.recording.options import MB, DiskRoom, Options, judge_room
from skyloop.recording.translation import TranslatedImage, Translator
from skyloop.recording.writer import FileWriter
from tests.recording.disks import Disk
from tests.support import recording_files as files

CLOCK = ClockPair(0, 1_000_000_000_000_000_000, 1)
ABLE = Capabilities("test")


class Bench:
    """A writer whose thread is this test."""

    def __init__(self, folder: Path, disk: Disk, **options: Any) -> None:
        self.path = folder / "flight.mcap"
        self.disk = disk
        self.backlog = Backlog(options.pop("buffer", 10 * MB))
        self.told: list[tuple[str, Severity]] = []
        self.now_ns = 0
        self.writer = FileWriter(
            self.path,
            Options(**{"min_free_mb": 0.0, **options}),
            self.backlog,
            [DroneRecord("alpha")],
            [Translator("alpha", ABLE, CLOCK)],
            CLOCK,
            lambda text, severity: self.told.append((text, severity)),
            opener=disk.open,
            free=disk.free,
        )
        self.writer._open()  # as start() does, without the thread

    def commands(self, *numbers: int) -> None:
        for number in numbers:
            applied = Applied(number, 1, 1, number, number, Idle(), Idle())
            self.backlog.put(Item(0, "commands", Rank.KEPT, number, applied, 400))

    def frames(self, *numbers: int, size: int = 1000) -> None:
        for number in numbers:
            header = FrameHeader("front", number, number, number, 4, 3, Encoding.BGR8, 36)
            picture = TranslatedImage(FrameRecord(header, number, "jpeg"), bytes(range(256)) * (size // 256 + 1))
            self.backlog.put(Item(0, "video.front", Rank.FRAME, number, picture, size))

    def pictures(self, *numbers: int, size: int = 1000, group: int = 10) -> None:
        """Put H.264 frames into the backlog; every tenth is a key frame."""
        for number in numbers:
            header = FrameHeader("front", number, number, number, 4, 3, Encoding.BGR8, 36)
            record = FrameRecord(header, number, "h264", number % group == 0)
            self.backlog.put(Item(0, "video.front", Rank.FRAME, number, TranslatedImage(record, bytes(size)), size))

    def step(self, seconds: float = 1.0) -> None:
        """Advance by a second, after which everything is due."""
        self.now_ns += round(seconds * NS_PER_S)
        self.writer.step(self.now_ns)

    def texts(self) -> str:
        return "\n".join(text for text, _ in self.told)


Make = Callable[..., Bench]


@pytest.fixture
def make() -> Iterator[Make]:
    """Creates benches and closes their files."""
    made: list[Bench] = []

    def one(folder: Path, disk: Disk, **options: Any) -> Bench:
        made.append(Bench(folder, disk, **options))
        return made[-1]

    yield one
    for bench in made:
        bench.writer._end()


def written(*paths: Path, topic: str = "/alpha/commands") -> list[int]:
    return [one.sequence for path in paths for one in files.of(path, topic)]


def test_a_writer_with_its_thread(tmp_path: Path) -> None:
    backlog = Backlog(MB)
    options = Options(min_free_mb=0.0)
    drones, translators = [DroneRecord("alpha")], [Translator("alpha", ABLE, CLOCK)]
    writer = FileWriter(tmp_path / "f.mcap", options, backlog, drones, translators, CLOCK, lambda *_: None)
    writer.start()
    backlog.put(Item(0, "commands", Rank.KEPT, 1, Applied(1, 1, 1, 1, 1, Idle(), Idle()), 400))
    writer.stop()
    writer.stop()
    assert writer.state.value == "closed"
    assert written(tmp_path / "f.mcap") == [1]
    assert files.is_complete(tmp_path / "f.mcap")
    assert writer.bytes == (tmp_path / "f.mcap").stat().st_size


def test_written_data_can_be_read_before_the_file_is_closed(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk())
    bench.commands(1, 2)
    bench.step()
    assert written(bench.path) == [1, 2]
    assert bench.writer.messages == 2


def test_rotation_by_size_with_self_contained_files(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), rotate_mb=1)
    tilt = Parameter("limits.tilt", ParameterType.FLOAT, 0.2)
    bench.backlog.put(Item(0, "parameters", Rank.KEPT, 1, tilt, 400))
    for number in range(4):
        bench.frames(number, size=400_000)
        bench.commands(number)
        bench.step()
    bench.writer._end()
    paths = sorted(tmp_path.iterdir())
    assert [path.name for path in paths] == [f"flight-{number:04d}.mcap" for number in range(1, len(paths) + 1)]
    assert bench.writer.files == paths
    assert len(paths) >= 2 or bench.writer.bytes < MB
    assert written(*paths) == [0, 1, 2, 3]
    for number, path in enumerate(paths, 1):
        assert files.is_complete(path)
        found = files.metadata(path)
        assert layout.from_metadata(found[META_RECORDING], Start).file == number
        reason = layout.from_metadata(found[META_END], End).reason
        assert reason == ("closed" if path == paths[-1] else "rotated")
        (parameter,) = files.of(path, "/alpha/parameters")
        assert layout.decode(parameter.data, Parameter) == tilt


def test_rotation_by_time(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), rotate_s=10)
    for second in range(1, 26):
        bench.commands(second)
        bench.step()
    bench.writer._end()
    assert [written(path)[-1] for path in bench.writer.files] == [10, 20, 25]
    assert written(*bench.writer.files) == list(range(1, 26))


def test_each_file_of_a_rotation_starts_with_a_key_frame(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), rotate_s=2)
    for second in range(6):
        bench.pictures(*range(7 * second, 7 * second + 7))
        bench.commands(second)
        bench.step()
    bench.writer._end()
    found = [written(path, topic="/alpha/camera/front/video") for path in bench.writer.files]
    assert [number for numbers in found for number in numbers] == list(range(42))
    assert [numbers[0] for numbers in found] == [0, 10, 30]
    assert written(*bench.writer.files) == list(range(6))
    assert bench.backlog.dropped == {}


def test_a_rotation_waits_for_the_rare_key_frames_of_a_camera(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), rotate_s=2)
    for second in range(22):  # a key frame every ten seconds
        bench.pictures(second)
        bench.step()
    bench.writer._end()
    found = [written(path, topic="/alpha/camera/front/video") for path in bench.writer.files]
    assert found == [[*range(10)], [*range(10, 20)], [20, 21]]
    assert bench.backlog.dropped == {}


def test_a_rotation_does_not_wait_for_a_key_frame_without_a_stream(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), rotate_s=10)
    for second in range(26):
        bench.pictures(second, group=1000)
        bench.step()
    assert len(bench.writer.files) == 2


def test_a_rotation_does_not_wait_for_a_key_frame_forever(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), rotate_s=10)
    bench.pictures(0, 1)
    for _ in range(14):
        bench.step()
    assert len(bench.writer.files) == 2
    bench.pictures(2, 3, 10, 11)
    bench.step()
    bench.writer._end()
    assert written(*bench.writer.files, topic="/alpha/frames/front") == [0, 1, 10, 11]
    assert bench.backlog.dropped == {(0, "video.front"): 2}


def test_after_dropped_frames_it_waits_for_the_next_key_frame(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), buffer=6500)
    bench.pictures(*range(12), *range(20, 23))  # ten and five are too many: 0 to 8 are dropped, and 9 depends on them
    bench.step()
    bench.pictures(23, 25, 26, 30)  # 24 never arrived
    bench.step()
    bench.writer._end()
    assert written(bench.path, topic="/alpha/frames/front") == [10, 11, 20, 21, 22, 23, 30]
    assert bench.backlog.dropped == {(0, "video.front"): 12}


def test_a_disk_full_at_the_end_of_a_file_loses_no_frame(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), rotate_s=2)
    bench.pictures(0, 1)
    bench.step()
    bench.disk.room = 0
    bench.pictures(2, 10, 11)
    bench.commands(1)
    bench.step()
    assert bench.writer.state.value == "paused"
    bench.disk.room = 10**9
    bench.step()
    bench.step()
    bench.writer._end()
    assert written(*bench.writer.files, topic="/alpha/frames/front") == [0, 1, 10, 11]
    assert bench.backlog.dropped == {(0, "video.front"): 1}  # 2 was not in the file that broke off
    assert written(*bench.writer.files) == [1]


@pytest.mark.parametrize("room", [0, 300, 2500])
def test_a_full_disk_pauses_and_no_essential_sample_is_lost(make: Make, tmp_path: Path, room: int) -> None:
    bench = make(tmp_path, Disk())
    bench.commands(1, 2, 3)
    bench.step()
    bench.disk.room = room
    bench.commands(*range(4, 60))
    bench.step()
    assert bench.writer.state.value == "paused"
    assert "No space left" in bench.writer.reason
    assert written(bench.path) == [1, 2, 3]
    bench.step()  # retried without success, and reported once
    bench.commands(60)
    bench.step()
    assert bench.texts().count("No space left") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["flight.mcap"]
    bench.disk.room = 10**9
    bench.step()
    assert bench.writer.state.value == "recording"
    bench.writer._end()
    assert [path.name for path in bench.writer.files] == ["flight.mcap", "flight-0002.mcap"]
    assert written(*bench.writer.files) == list(range(1, 61))
    assert bench.backlog.dropped == {}


def test_the_reason_for_left_out_frames_is_shown(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), min_free_mb=100.0)
    assert bench.writer.shown_reason == ""
    bench.writer._judge_room(bench.writer._floor - 1)
    assert bench.writer.state.value == "recording"
    assert "no frames are recorded" in bench.writer.shown_reason
    bench.writer._judge_room(2 * bench.writer._floor)
    assert bench.writer.shown_reason == ""


def test_a_file_after_a_pause_overwrites_nothing(make: Make, tmp_path: Path) -> None:
    (tmp_path / "flight-0002.mcap").write_text("precious")
    bench = make(tmp_path, Disk(), overwrite=True)
    bench.disk.room = 0
    bench.commands(1)
    bench.step()
    bench.disk.room = 10**9
    bench.step()
    assert [path.name for path in bench.writer.files] == ["flight.mcap", "flight-0003.mcap"]
    assert (tmp_path / "flight-0002.mcap").read_text() == "precious"


def test_a_disk_full_to_the_end(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk())
    bench.commands(1)
    bench.step()
    bench.disk.room = 0
    bench.commands(2)
    bench.step()
    bench.writer._end()
    assert bench.writer.state.value == "failed"
    assert "No space left" in bench.writer.reason
    assert written(bench.path) == [1]


def test_a_disk_that_fills_up_while_closing(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk())
    bench.commands(1)
    bench.step()
    bench.disk.room = 20
    bench.writer._end()
    assert bench.writer.state.value == "failed"
    assert written(bench.path) == [1]


def test_the_floor_stops_frames_first_then_all_until_there_is_room(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(100 * MB), min_free_mb=40)
    bench.frames(1)
    bench.step()
    bench.disk.room = 30 * MB
    bench.step()
    bench.frames(2)
    bench.commands(2)
    bench.step()
    assert bench.backlog.dropped == {(0, "video.front"): 1}
    assert written(bench.path) == [2]
    bench.disk.room = 9 * MB
    bench.commands(3)
    bench.step()
    assert bench.writer.state.value == "paused"
    assert files.is_complete(bench.path), "there was room to close the file"
    bench.disk.room = 45 * MB  # above the floor, but not by the margin
    bench.step()
    assert bench.writer.room is DiskRoom.NO_FRAMES
    bench.disk.room = 60 * MB
    bench.step()
    bench.frames(4)
    bench.step()
    bench.writer._end()
    assert written(*bench.writer.files) == [2, 3]
    assert written(*bench.writer.files, topic="/alpha/frames/front") == [1, 4]
    assert [severity for _, severity in bench.told] == [
        Severity.INFO,
        Severity.WARNING,
        Severity.ERROR,
        Severity.WARNING,
        Severity.INFO,
        Severity.INFO,
    ]


@pytest.mark.parametrize(
    ("free", "before", "after"),
    [
        (100, DiskRoom.ALL, DiskRoom.ALL),
        (99, DiskRoom.ALL, DiskRoom.NO_FRAMES),
        (24, DiskRoom.ALL, DiskRoom.NOTHING),
        (124, DiskRoom.NO_FRAMES, DiskRoom.NO_FRAMES),
        (125, DiskRoom.NO_FRAMES, DiskRoom.ALL),
        (24, DiskRoom.NO_FRAMES, DiskRoom.NOTHING),
        (31, DiskRoom.NOTHING, DiskRoom.NOTHING),
        (32, DiskRoom.NOTHING, DiskRoom.NO_FRAMES),
        (200, DiskRoom.NOTHING, DiskRoom.ALL),
    ],
)
def test_room_is_judged_with_a_margin(free: int, before: DiskRoom, after: DiskRoom) -> None:
    assert judge_room(free, 100, before) is after


def test_a_removed_folder_is_reported_and_recording_continues_when_it_is_back(make: Make, tmp_path: Path) -> None:
    folder = tmp_path / "flights"
    folder.mkdir()
    bench = make(folder, Disk())
    bench.commands(1)
    bench.step()
    shutil.rmtree(folder)
    bench.commands(2)
    bench.step()
    assert bench.writer.state.value == "paused"
    assert "was removed" in bench.texts()
    bench.step()
    assert str(folder) in bench.writer.reason
    folder.mkdir()
    bench.commands(3)
    bench.step()
    bench.writer._end()
    assert bench.writer.state.value == "closed"
    assert written(folder / "flight-0002.mcap") == [2, 3]


def test_a_moved_file_is_still_written(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk())
    bench.path.rename(tmp_path / "moved.mcap")
    bench.commands(1)
    bench.step()
    bench.writer._end()
    assert written(tmp_path / "moved.mcap") == [1]


def test_a_disk_slower_than_the_data_costs_frames_and_no_command(make: Make, tmp_path: Path) -> None:
    bench = make(tmp_path, Disk(), buffer=60_000)
    bench.commands(0)
    bench.step()
    bench.disk.moving.clear()
    bench.disk.writing.clear()
    bench.commands(1)
    stuck = threading.Thread(target=bench.step)
    stuck.start()
    assert bench.disk.writing.wait(10.0)
    for number in range(2, 42):
        bench.commands(number)
        bench.frames(number)
        bench.backlog.put(Item(0, "feedback", Rank.STATE, number, Feedback(captured_ns=number, seq=number), 400))
    assert bench.backlog.size <= 60_000
    bench.disk.moving.set()
    stuck.join(10.0)
    bench.step()
    bench.writer._end()
    assert written(bench.path) == list(range(42))
    frames = written(bench.path, topic="/alpha/frames/front")
    dropped = bench.backlog.dropped
    assert 0 < len(frames) < 40
    assert dropped[0, "video.front"] == 40 - len(frames)
    assert dropped[0, "feedback"] == 0


@pytest.mark.parametrize(
    ("prepare", "match"),
    [
        (lambda path: path.write_text("x"), "File exists"),
        (lambda path: path.parent.rmdir(), "No such file"),
    ],
)
def test_recordings_that_can_not_start(tmp_path: Path, prepare: Callable[[Path], object], match: str) -> None:
    path = tmp_path / "folder" / "f.mcap"
    path.parent.mkdir()
    prepare(path)
    options = Options(min_free_mb=0.0)
    writer = FileWriter(path, options, Backlog(MB), [], [], CLOCK, lambda *_: None)
    with pytest.raises(UsageError, match=match):
        writer.start()
    writer.stop()


def test_a_disk_without_room_is_refused_at_the_start(tmp_path: Path) -> None:
    disk = Disk(9 * MB)
    options = Options(min_free_mb=40)
    path = tmp_path / "f.mcap"
    writer = FileWriter(path, options, Backlog(MB), [], [], CLOCK, lambda *_: None, opener=disk.open, free=disk.free)
    with pytest.raises(UsageError, match="has 9 MB left, but recording keeps 40 MB free"):
        writer.start()
