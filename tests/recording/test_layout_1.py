"""Recordings of layout 1, from before feedback's fields had units in their names: they open, replay and export."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer

import skyloop
from skyloop.errors import FileFormatError
from skyloop.messages import Feedback
from skyloop.recording.layout import (
    META_CLOCK,
    META_RECORDING,
    PROFILE,
    VERSION,
    Channel,
    ClockPair,
    Start,
    decode,
    encode,
    to_metadata,
)
from skyloop.recording.reader import Recording
from skyloop.recording.review.tables import tables
from tests.support.commands import Ended
from tests.support.recorded_flights import Plan, feedback_at

OLD = Path(__file__).parents[1] / "data" / "recordings" / "layout-1.mcap"
PLAN = Plan(seconds=1.0, frame_ms=250, lossy=False)


def expected(at_ms: int) -> Feedback:
    sample = feedback_at(PLAN, at_ms, at_ms // 20 + 1)
    fields = {name: getattr(sample, name) for name in sample.__struct_fields__}
    return Feedback(**fields | {"angular_velocity_rad_s": (0.01, 0.02, 0.03), "acceleration_m_s2": (0.1, 0.2, 9.8)})


def test_it_has_the_previous_layout() -> None:
    start = Recording.open(OLD).start
    assert start.layout == 1 < VERSION
    assert "position" in start.drones[0].capabilities["cameras"][0]


def test_every_number_of_feedback_is_read() -> None:
    recording = Recording.open(OLD)
    samples = [item.value for item in recording.items("alpha", (Channel.FEEDBACK,))]
    assert samples == [expected(20 * number) for number in range(50)]
    assert recording.damaged == []


def test_the_cameras_position_is_read() -> None:
    (camera,) = Recording.open(OLD).drone().described.cameras
    assert camera.position_m == (0.1, 0.02, 0.03)


def test_current_names_take_precedence_over_those_of_layout_1() -> None:
    assert decode(b'{"captured_ns": 1, "yaw": 0.5, "yaw_rad": 0.25}', Feedback).yaw_rad == 0.25
    assert decode(b'{"captured_ns": 1, "yaw": 0.5}', Feedback).yaw_rad == 0.5
    assert decode(encode(expected(500)), Feedback) == expected(500)


def test_it_is_replayed() -> None:
    seen: list[Feedback] = []

    class Look(skyloop.Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            seen.append(feedback)

    with skyloop.connect(f"replay://{OLD}?speed=max", on_exit="hover") as drone:
        Look(drone).run()
    highest = max(sample.altitude_m or 0.0 for sample in seen)
    assert highest == pytest.approx(1.2, abs=0.01)
    assert all(sample.position_m is not None and sample.yaw_rad is not None for sample in seen)


def test_it_is_exported_and_reported(log: Callable[..., Ended], tmp_path: Path) -> None:
    feedback = tables(Recording.open(OLD), "alpha")["feedback"]
    assert feedback.numbers("altitude_m").max() == pytest.approx(1.2)
    assert feedback.numbers("velocity_forward_m_s")[0] == 0.4
    assert feedback.numbers("angular_velocity_z_rad_s")[0] == 0.03
    assert feedback.numbers("acceleration_z_m_s2")[0] == 9.8
    assert math.isclose(feedback.numbers("position_x_m")[0], 2.0)
    assert log("export", OLD, "--to", "csv", "-o", tmp_path / "csv").code == 0
    assert log("report", OLD, "-o", tmp_path / "flight.html").code == 0
    page = (tmp_path / "flight.html").read_text()
    for title in ("Altitude", "Roll and pitch", "Yaw", "Velocity"):
        assert title in page


@pytest.mark.parametrize("layout", [0, VERSION + 1])
def test_another_layout_is_refused_with_both_numbers(tmp_path: Path, layout: int) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(PROFILE, "tests")
        writer.add_metadata(META_CLOCK, to_metadata(ClockPair(1, 2, 3)))
        writer.add_metadata(META_RECORDING, to_metadata(Start(layout, "9.9", (), 2)))
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(FileFormatError, match=f"has layout {layout}, but .* reads layouts 1 to {VERSION}"):
        Recording.open(path)
