"""One file: committed data stays readable."""

from __future__ import annotations

import errno
import random
from pathlib import Path

import pytest

from skyloop.messages import Feedback
from skyloop.recording import foxglove, layout
from skyloop.recording.layout import META_CLOCK, META_END, META_RECORDING, ClockPair, DroneRecord, End, Start
from skyloop.recording.translation import Message
from skyloop.recording.writer import RecordingFile
from tests.recording.disks import Disk
from tests.support import recording_files as files

START = Start(1, "0.1", (DroneRecord("alpha"),), 5)
CLOCK = ClockPair(0, 1_000_000_000_000_000_000, 1, "boot")
TOPIC = "/alpha/feedback"


def message(number: int, padding: int = 0) -> Message:
    data = layout.encode(Feedback(captured_ns=number, owner=random.Random(number).randbytes(padding).hex()))
    return Message(TOPIC, Feedback, data, CLOCK.unix(number + 7), CLOCK.unix(number), number)


def opened(folder: Path, disk: Disk) -> RecordingFile:
    return RecordingFile(folder / "f.mcap", START, CLOCK, opener=disk.open)


def test_a_file_has_its_metadata_schemas_times_and_summary(tmp_path: Path) -> None:
    file = opened(tmp_path, Disk())
    picture = Message("/log", foxglove.Log, b"", 3, 3)
    for one in (message(1), picture, message(2)):
        file.write(one)
    file.close(End("closed", 9, dict(file.written)))
    assert file.size == file.path.stat().st_size
    first, log, second = files.read(file.path)
    assert (first.topic, first.schema, first.encoding) == (TOPIC, "skyloop.Feedback", "json")
    assert (first.log_ns, first.publish_ns, first.sequence) == (CLOCK.unix(8), CLOCK.unix(1), 1)
    assert layout.decode(second.data, Feedback) == Feedback(captured_ns=2, owner="")
    assert (log.schema, log.encoding) == ("foxglove.Log", "protobuf")
    assert files.is_complete(file.path)
    found = files.metadata(file.path)
    assert layout.from_metadata(found[META_CLOCK], ClockPair) == CLOCK
    assert layout.from_metadata(found[META_RECORDING], Start) == START
    assert layout.from_metadata(found[META_END], End).written == {TOPIC: 2, "/log": 1}


@pytest.mark.parametrize("room", [0, 1, 900, 5000])
def test_a_full_disk_leaves_the_committed_data(tmp_path: Path, room: int) -> None:
    disk = Disk()
    file = opened(tmp_path, disk)
    for number in range(3):
        file.write(message(number))
    file.commit()
    committed = file.path.stat().st_size
    disk.room = room
    for number in range(3, 40):
        file.write(message(number, padding=number * 40))
    with pytest.raises(OSError, match="No space") as error:
        file.commit()
    assert error.value.errno == errno.ENOSPC
    file.abandon()
    assert file.path.stat().st_size == committed
    assert [one.sequence for one in files.read(file.path)] == [0, 1, 2]
    assert not files.is_complete(file.path)


def test_a_disk_that_is_full_at_once_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space"):
        opened(tmp_path, Disk(10))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_without_permission(tmp_path: Path) -> None:
    (tmp_path / "f.mcap").write_text("precious")
    with pytest.raises(FileExistsError):
        opened(tmp_path, Disk())
    assert (tmp_path / "f.mcap").read_text() == "precious"


def test_a_deleted_file_is_lost_and_a_moved_one_is_not(tmp_path: Path) -> None:
    file = opened(tmp_path, Disk())
    file.path.rename(tmp_path / "moved.mcap")
    assert not file.lost
    (tmp_path / "moved.mcap").unlink()
    assert file.lost
    file.abandon()
