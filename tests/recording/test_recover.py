"""``skyloop log recover``: readable data is saved with an index; the damaged file stays unchanged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from skyloop.errors import UsageError
from skyloop.recording.reader import Recording
from skyloop.recording.review.summary import problems, recover
from tests.support.commands import Ended
from tests.support.recorded_flights import Plan, write_flight

Log = Callable[..., Ended]


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """Two thirds of a recording, up to the middle of a chunk."""
    path = write_flight(tmp_path / "flight.mcap", Plan(chunk_size=4096))
    pieces = Recording.open(path).found.pieces
    last = pieces[len(pieces) * 2 // 3]
    path.write_bytes(path.read_bytes()[: last.offset + last.size // 2])
    return path


def samples(path: Path) -> list[tuple[str, int, bytes]]:
    return [(entry.topic, entry.log_ns, entry.data) for entry in Recording.open(path).entries()]


def test_everything_readable_is_saved(log: Log, cut: Path) -> None:
    before = cut.read_bytes()
    readable = samples(cut)
    ended = log("recover", cut)
    mended = cut.with_name("flight-recovered.mcap")
    assert ended.code == 0
    assert "it ends within a record" in ended.err
    assert f"{mended}: {len(readable)} messages" in ended.err
    assert "at most" in ended.err
    assert "/alpha/feedback" in ended.out
    assert cut.read_bytes() == before
    recording = Recording.open(mended)
    assert recording.cut == ""
    assert sorted(samples(mended)) == sorted(readable)
    assert len(list(recording.pictures("alpha", "front"))) >= 10
    with mended.open("rb") as file:  # other programs navigate by its index
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(readable)
    assert summary.chunk_indexes


def test_damage_in_the_middle_is_left_out(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "flight.mcap", Plan(chunk_size=4096))
    whole = len(samples(path))
    piece = Recording.open(path).found.pieces[1]
    data = bytearray(path.read_bytes())
    data[piece.offset + 40] ^= 0x55
    path.write_bytes(data)
    recording = Recording.open(path)
    assert len(problems(recording)) == 1
    saved = recover(Recording.open(path), tmp_path / "mended.mcap")
    assert 0.5 * whole < sum(saved.messages.values()) < whole
    assert saved.lost == piece.size
    assert len(saved.why) == 1
    assert problems(Recording.open(saved.path)) == ()


def test_a_whole_file_needs_nothing(log: Log, flight: Path) -> None:
    ended = log("recover", flight)
    assert (ended.code, ended.err) == (0, f"{flight} is complete: there is nothing to repair\n")
    assert not flight.with_name("flight-recovered.mcap").exists()


def test_programs_get_it_as_json(log: Log, cut: Path, flight: Path) -> None:
    ended = log("recover", cut, "--json")
    assert (ended.code, ended.err) == (0, "")
    told = json.loads(ended.out)
    saved = told["saved"]
    mended = cut.with_name("flight-recovered.mcap")
    assert (told["file"], saved["path"]) == (str(cut), str(mended))
    assert sum(saved["messages"].values()) == len(samples(mended))
    assert saved["size"] == mended.stat().st_size
    assert "it ends within a record" in saved["why"][0]
    assert json.loads(log("recover", flight, "--json").out) == {"file": str(flight), "saved": None}


def test_nothing_is_overwritten(log: Log, cut: Path, tmp_path: Path) -> None:
    target = tmp_path / "other.mcap"
    target.write_text("mine")
    ended = log("recover", cut, "-o", target)
    assert ended.code == 2
    assert "already exists: choose another name" in ended.err
    assert target.read_text() == "mine"
    assert not list(tmp_path.glob("*.part"))


def test_an_unwritable_target_is_reported(cut: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file or directory"):
        recover(Recording.open(cut), tmp_path / "nowhere" / "x.mcap")
