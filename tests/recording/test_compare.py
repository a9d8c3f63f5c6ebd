"""``skyloop log compare``: differences of two recordings' commands."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from skyloop.errors import FileFormatError, UnknownNameError
from skyloop.messages import Feedback
from skyloop.recording.reader import Recording
from skyloop.recording.review.compare import compare
from skyloop.recording.review.tables import tables
from tests.support.commands import Ended
from tests.support.recorded_flights import MS, Plan, feedback_at, write_flight

Log = Callable[..., Ended]


def test_a_flight_against_itself(flight: Path) -> None:
    found = compare(Recording.open(flight), Recording.open(flight))
    assert found.part_at_s is None
    assert found.same_action == 1.0
    assert found.counts == (40, 40)
    assert all(field.rms == field.largest == 0.0 for field in found.fields)
    assert {field.name: field.unit for field in found.fields}["yaw_rate"] == "rad/s"


def test_a_timid_controller(flight: Path, other_flight: Path) -> None:
    found = compare(Recording.open(flight), Recording.open(other_flight))
    fields = {field.name: field for field in found.fields}
    assert fields["forward"].rms == pytest.approx(0.2)
    assert fields["forward"].largest == pytest.approx(0.2)
    assert fields["left"].rms == 0.0
    assert fields["forward"].seconds == pytest.approx(1.1, abs=0.06)
    assert found.same_action == 1.0
    assert found.part_at_s == pytest.approx(0.51, abs=0.02)  # with the first velocity
    assert found.aligned == "by their common clock"
    assert compare(Recording.open(flight), Recording.open(other_flight), part=0.3).part_at_s is None


def test_flights_to_a_position(tmp_path: Path) -> None:
    paths = [write_flight(tmp_path / f"{gain}.mcap", Plan(places=True, gain=gain)) for gain in (1.0, 2.0)]
    low, high = map(Recording.open, paths)
    fields = {field.name: field for field in compare(low, high, what="asked").fields}
    assert fields["z"].unit == "m"
    assert fields["z"].rms == pytest.approx(1.2)
    assert fields["x"].rms == 0.0
    assert "yaw" not in fields, "none was requested"
    commands = tables(low, "alpha")["commands"]
    flying = commands["asked"] == "position"
    assert commands["applied_y"][flying] == pytest.approx(2.0)
    assert not commands.known("applied_yaw")


def test_a_replay_knows_its_position(tmp_path: Path, flight: Path) -> None:
    """On another clock, 100 s later, started 0.4 s into the recording."""
    later = 100_000 * MS

    def replayed(at_ms: int) -> Feedback:
        sample = feedback_at(Plan(), at_ms, at_ms // 20 + 1)
        position_s = at_ms / 1000 + 0.4
        return Feedback(
            captured_ns=sample.captured_ns + later,
            published_ns=sample.published_ns + later,
            native={"replay.position_s": position_s},
        )

    path = write_flight(tmp_path / "again.mcap", Plan(extra=replayed, shift_ns=later))
    found = compare(Recording.open(flight), Recording.open(path))
    assert found.aligned == "the new one is a replay of the old one"
    assert found.new.times_s[0] - found.old.times_s[0] == pytest.approx(0.4, abs=0.001)


def test_unrelated_flights_start_at_their_first_command(tmp_path: Path, flight: Path) -> None:
    path = write_flight(tmp_path / "other.mcap", Plan(shift_ns=50_000 * MS, gain=0.5))
    found = compare(Recording.open(flight), Recording.open(path))
    assert found.aligned == "both start at their first command"
    assert found.new.times_s[0] == pytest.approx(found.old.times_s[0])
    assert found.same_action == 1.0


def test_commands_hold_until_the_next(flight: Path) -> None:
    commands = compare(Recording.open(flight), Recording.open(flight)).old
    held = commands.at(np.array([-1.0, 0.0105, 0.05, 0.0605]))
    assert held.names.tolist() == ["", "takeoff", "takeoff", "takeoff"]
    assert math.isnan(held.numbers["forward"][0])


def test_the_table_and_the_pictures(log: Log, flight: Path, other_flight: Path, tmp_path: Path) -> None:
    for name in ("both.html", "both.png"):
        ended = log("compare", flight, other_flight, "-o", tmp_path / name)
        assert ended.code == 0
        row = next(line for line in ended.out.splitlines() if line.strip().startswith("forward")).split()
        assert row[1:5] == ["0.2000", "m/s", "0.2000", "m/s"]
        assert "they diverge at 0.51 s" in ended.out
        assert f"{tmp_path / name}: " in ended.err
    page = (tmp_path / "both.html").read_text()
    assert "other.mcap against flight.mcap" in page
    assert "forward [m/s]" in page
    assert "http://" not in page
    assert (tmp_path / "both.png").read_bytes().startswith(b"\x89PNG")


def test_recordings_with_nothing_in_common_are_reported_in_unbroken_lines(
    log: Log, flight: Path, tmp_path: Path
) -> None:
    ended = log("compare", flight, write_flight(tmp_path / "places.mcap", Plan(places=True)))
    assert "no set-point occurs in both at the same time" in ended.out
    assert any("s compared, " in line and "they diverge at" in line for line in ended.out.splitlines())


def test_wrong_words(log: Log, flight: Path, tmp_path: Path) -> None:
    assert "its name must end in .html or .png" in log("compare", flight, flight, "-o", tmp_path / "x.gif").err
    assert "No such file" in log("compare", flight, tmp_path / "none.mcap").err
    quiet = write_flight(tmp_path / "quiet.mcap", Plan(seconds=0.2, command_ms=0))
    with pytest.raises(FileFormatError, match=r"quiet\.mcap contains no commands"):
        compare(Recording.open(flight), Recording.open(quiet))
    with pytest.raises(UnknownNameError, match="drone"):
        compare(Recording.open(flight), Recording.open(flight), drone="beta")
