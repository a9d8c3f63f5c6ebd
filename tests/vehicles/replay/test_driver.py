"""A replay's samples, their times, and its reaction to commands."""

from __future__ import annotations

import heapq
import re
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from skyloop.clock import ManualClock
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.errors import ParameterError, UnknownNameError, UsageError
from skyloop.messages import (
    CameraInfo,
    Encoding,
    EventKind,
    Feedback,
    FlightState,
    Hover,
    Land,
    LinkState,
    Severity,
    Velocity,
)
from skyloop.recording.layout import (
    META_CLOCK,
    META_RECORDING,
    PROFILE,
    VERSION,
    ClockPair,
    DroneRecord,
    Start,
    to_metadata,
    to_plain,
)
from skyloop.recording.reader import Recording
from skyloop.vehicles.replay.driver import KNOWN, ReplayDriver
from skyloop.vehicles.replay.player import ReplayPublisher
from skyloop.vehicles.replay.source import ReplaySource, Timeline
from tests.support.pages import rows, section
from tests.support.recorded_flights import BEGIN_NS, CAPABILITIES, MS, UNIX_NS, Plan, feedback_at, write_flight

WAIT_S = 10.0


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Don't change it."""
    return write_flight(tmp_path_factory.mktemp("flights") / "flight.mcap")


def driver_of(path: Path, query: str = "") -> ReplayDriver:
    driver = make_driver(f"replay://{path}{query}")
    assert isinstance(driver, ReplayDriver)
    return driver


@contextmanager
def played(path: Path, query: str = "?speed=20", keep: int = 4096) -> Iterator[tuple[ReplayDriver, RecordingSink]]:
    driver, sink = driver_of(path, query), RecordingSink(keep=keep)
    driver.open(sink)
    try:
        yield driver, sink
    finally:
        driver.close()
    assert not sink.problems, sink.problems


def test_all_samples_are_published_again(flight: Path) -> None:
    with played(flight) as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        assert sink.links[0] == (LinkState.UP, "")
        assert "end of the recording after 20 frames" in sink.links[-1][1]
        assert sink.frame_counts == {"front": 20}
        assert sink.feedback_count == 96
        frame = sink.frames[0]
        assert (frame.width, frame.height, frame.encoding) == (64, 48, Encoding.BGR8)
        assert frame.intrinsics is not None
        assert frame.intrinsics.fx == 60.0
        states = [feedback.state for feedback in sink.feedbacks]
        assert {FlightState.LANDED, FlightState.TAKING_OFF, FlightState.FLYING, FlightState.LANDING} == set(states)
        told = sink.feedbacks[30]
        assert told.altitude_m is not None
        assert told.owner is None
        assert told.seq == 0


def test_the_recorded_commands_are_in_the_native_telemetry(flight: Path) -> None:
    with played(flight) as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        natives = [feedback.native or {} for feedback in sink.feedbacks]
    assert "replay.asked" not in natives[0]
    assert {native.get("replay.asked") for native in natives[2:]} == {"takeoff", "velocity", "land"}
    flying = next(native for native in natives if native.get("replay.asked") == "velocity")
    values = flying["replay.applied.values"]
    assert isinstance(values, tuple)
    assert values[0] == pytest.approx(0.4)
    assert flying["replay.owner"] == "pilot.py"
    assert flying["motor"] == 0.5
    positions = [float(native["replay.position_s"]) for native in natives]  # type: ignore[arg-type]
    assert positions == sorted(positions)
    assert positions[-1] == pytest.approx(1.98, abs=0.03)


def test_an_internal_error_is_reported_in_words(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise TypeError("float() argument must be a string or a real number, not 'NoneType'")

    monkeypatch.setattr(ReplayPublisher, "feedback", fail)
    with played(flight) as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.LOST, WAIT_S)
        (event,) = [event for event in sink.events if event.severity is Severity.ERROR]
    assert event.text == sink.links[-1][1]
    assert "can't be played beyond 0.0 s: an error in Skyloop (see the proxy's output)" in event.text


def test_the_old_proxys_events_are_not_repeated(flight: Path) -> None:
    with played(flight) as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        events = list(sink.events)
    assert [event.text for event in events if event.kind is EventKind.COLLISION] == ["touched a chair"]
    recorded = {event.data["recorded_kind"]: event for event in events if "recorded_kind" in event.data}
    assert set(recorded) == {"authority_granted", "failsafe"}
    assert {event.kind for event in recorded.values()} == {EventKind.VEHICLE_MESSAGE}
    assert recorded["failsafe"].text == "recorded: failsafe: hover"
    assert not any(event.kind is EventKind.STATE_CHANGED for event in events)


def test_the_recorded_parameters_can_be_read(flight: Path) -> None:
    with played(flight) as (driver, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        found = {parameter.name: parameter for parameter in driver.parameters()}
        assert found["recorded.limits.tilt"].value == 0.2  # it was changed half way
        assert all(parameter.read_only for name, parameter in found.items() if name.startswith("recorded."))
        with pytest.raises(ParameterError):
            driver.set_parameter("recorded.limits.tilt", 0.1)


def test_it_is_paced_by_the_recording(flight: Path) -> None:
    with played(flight, "?speed=4") as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        captured = [feedback.captured_ns for feedback in sink.feedbacks]
        frames = [frame.captured_ns for frame in sink.frames]
        ages = sorted(frame.arrived_ns - frame.captured_ns for frame in sink.frames)
    assert (captured[-1] - captured[0]) / 1e9 == pytest.approx(1.98 / 4, rel=0.03)
    assert (frames[-1] - frames[0]) / 1e9 == pytest.approx(1.9 / 4, rel=0.03)
    assert 7 * MS < ages[len(ages) // 2] < 30 * MS  # captured 30 ms before it was published, at four times the speed


def test_it_starts_where_requested(flight: Path) -> None:
    with played(flight, "?speed=20&start=1.5") as (driver, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        assert sink.feedback_count == 25
        assert {parameter.name for parameter in driver.parameters()} >= {"recorded.sim.battery"}


def test_it_starts_over(flight: Path) -> None:
    with played(flight, "?speed=50&loop=1") as (_, sink):
        assert sink.wait(lambda: sink.feedback_count > 250, WAIT_S)
        newest = sink.newest
        assert newest is not None
        assert newest.native is not None
        assert newest.native["replay.loops"] in (2, 3)
        assert sink.link_state is LinkState.UP


def test_it_waits_for_a_viewer(flight: Path) -> None:
    driver, sink = driver_of(flight, "?speed=20&wait=1"), RecordingSink(watch=set())
    driver.open(sink)
    try:
        assert sink.wait(lambda: sink.feedback_count >= 3, WAIT_S)
        assert {feedback.state for feedback in sink.feedbacks} == {FlightState.LANDED}
        sink.watch = {"front"}
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        assert sink.frame_counts["front"] == 20
    finally:
        driver.close()


def test_unwanted_frames_are_not_decoded(flight: Path) -> None:
    driver, sink = driver_of(flight, "?speed=50"), RecordingSink(watch=set())
    driver.open(sink)
    try:
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
    finally:
        driver.close()
    assert sink.frame_counts == {}
    assert "20 frames" in sink.links[-1][1]


def test_a_lost_link_is_lost_again(tmp_path: Path) -> None:
    def lost(at_ms: int) -> Feedback | None:
        if not 400 <= at_ms < 600:
            return None
        return msgspec.structs.replace(feedback_at(Plan(), at_ms, at_ms // 20 + 1), vehicle_link=LinkState.LOST)

    path = write_flight(tmp_path / "flight.mcap", Plan(seconds=1.0, extra=lost))
    with played(path) as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        assert [state for state, _ in sink.links] == [LinkState.UP, LinkState.LOST, LinkState.UP, LinkState.CLOSED]


def test_a_cut_file_is_played_to_its_end_and_reported(tmp_path: Path, flight: Path) -> None:
    path = tmp_path / "cut.mcap"
    data = flight.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with played(path) as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        assert 0 < sink.feedback_count < 96
        assert any("the file was cut off" in event.text for event in sink.events)


def test_commands_are_accepted_without_effect(flight: Path) -> None:
    with played(flight) as (driver, _):
        assert driver.apply(Velocity(forward=0.5)) == Velocity(forward=0.5)
        assert driver.failsafe(Land())
        assert driver.failsafe(Hover())


def merged(path: Path, plans: list[Plan]) -> Path:
    """Merge several drones' flights into one recording, by time."""
    with ExitStack() as stack:
        parts = []
        for plan in plans:
            part = write_flight(path.with_name(f"{plan.drone}.mcap"), plan)
            parts.append(make_reader(stack.enter_context(part.open("rb"))))
        writer = Writer(stack.enter_context(path.open("wb")))
        writer.start(PROFILE, "tests")
        drones = tuple(DroneRecord(plan.drone, "sim://", to_plain(plan.capabilities)) for plan in plans)
        writer.add_metadata(META_CLOCK, to_metadata(ClockPair(BEGIN_NS, UNIX_NS, 77)))
        writer.add_metadata(META_RECORDING, to_metadata(Start(VERSION, "0.1.0", drones, UNIX_NS)))
        channels: dict[str, int] = {}
        in_turn = heapq.merge(*(part.iter_messages() for part in parts), key=lambda found: found[2].log_time)
        for kind, channel, message in in_turn:
            if channel.topic not in channels:
                assert kind is not None
                number = writer.register_schema(kind.name, kind.encoding, kind.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_each_drone_of_a_recording_has_its_own_samples(tmp_path: Path) -> None:
    """They flew at the same time: one a circle; the other hovered, with slower feedback, another camera and battery."""
    camera = CameraInfo("bottom", 64, 48, 5.0)
    standing = msgspec.structs.replace(CAPABILITIES, cameras=(camera,), description="the second one")

    def stands(at_ms: int) -> Feedback:
        flying = feedback_at(Plan(), at_ms, at_ms // 40 + 1)
        return msgspec.structs.replace(flying, state=FlightState.LANDED, battery=0.25, position_m=(7.0, 8.0, 0.0))

    beta = Plan(drone="beta", seconds=1.6, feedback_ms=40, frame_ms=0, command_ms=0, lossy=False, capabilities=standing)
    beta.extra = stands
    path = merged(tmp_path / "both.mcap", [Plan(lossy=False), beta])
    seen = {}
    for name in ("alpha", "beta"):
        with played(path, f"?drone={name}&speed=20") as (driver, sink):
            assert sink.wait(lambda sink=sink: sink.link_state is LinkState.CLOSED, WAIT_S)  # type: ignore[misc]
            seen[name] = (driver.capabilities(), sink)
    described, sink = seen["alpha"]
    assert described.description == "recording of alpha: a simulated quadrotor"
    assert (sink.feedback_count, sink.frame_counts) == (100, {"front": 20})
    assert FlightState.FLYING in {feedback.state for feedback in sink.feedbacks}
    assert all((feedback.battery or 0.0) >= 0.9 for feedback in sink.feedbacks)
    assert "land" in {(feedback.native or {}).get("replay.asked") for feedback in sink.feedbacks}
    described, sink = seen["beta"]
    assert described.description == "recording of beta: the second one"
    assert (sink.feedback_count, sink.frame_counts) == (40, {})
    states = {(feedback.state, feedback.battery, feedback.position_m) for feedback in sink.feedbacks}
    assert states == {(FlightState.LANDED, 0.25, (7.0, 8.0, 0.0))}
    assert not any("replay.asked" in (feedback.native or {}) for feedback in sink.feedbacks), "commands are alpha's"
    with played(path) as (driver, _):
        assert driver.capabilities() == seen["alpha"][0], "the first one, if none is named"


def test_a_path_that_looks_like_a_secret_is_opened_and_not_shown(flight: Path, tmp_path: Path) -> None:
    folder = tmp_path / "key=front"
    folder.mkdir()
    path = folder / "flight.mcap"
    path.write_bytes(flight.read_bytes())
    driver = driver_of(path)
    assert driver.options.path == path
    assert driver.capabilities().vehicle == "replay"
    assert "front" not in str(driver.uri)


def test_capabilities(flight: Path, tmp_path: Path) -> None:
    found = driver_of(flight).capabilities()
    assert found.vehicle == "replay"
    assert found.actions == CAPABILITIES.actions - {"return_to_start"}, "of which the proxy makes places"
    assert [(camera.name, camera.width, camera.fps) for camera in found.cameras] == [("front", 64, 10.0)]
    assert "a simulated quadrotor" in found.description
    plain = msgspec.structs.replace(CAPABILITIES, cameras=(), actions=frozenset(), why_not="it is a picture only")
    path = write_flight(tmp_path / "plain.mcap", Plan(capabilities=plain, seconds=0.3))
    found = driver_of(path).capabilities()
    assert (found.actions, found.why_not) == (frozenset(), "it is a picture only")
    assert [camera.name for camera in found.cameras] == ["front"]  # frames were recorded, though not announced


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("?speed=0", "speed"),
        ("?speed=fast", "speed"),
        ("?start=-1", "start"),
        ("?speed=max&loop=1", "combined with loop"),
    ],
)
def test_invalid_options(flight: Path, query: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        driver_of(flight, query)


def test_an_unplayable_recording_is_reported(flight: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="names no file"):
        make_driver("replay://")
    missing = driver_of(tmp_path / "none.mcap")
    assert "No such file" in missing.capabilities().why_not
    with pytest.raises(UsageError, match="No such file"):
        missing.open(RecordingSink())
    with pytest.raises(UnknownNameError, match="drone"):
        driver_of(flight, "?drone=beta").open(RecordingSink())
    with pytest.raises(UsageError, match=r"lasts 2\.0 s, but start is 7 s"):
        driver_of(flight, "?start=7").open(RecordingSink())
    with pytest.raises(UsageError, match=r"in step with one application: call skyloop\.connect"):
        driver_of(flight, "?speed=max").open(RecordingSink())


# Step by step ------------------------------------------------------------------------------------------------------


def test_each_step_publishes_one_moment_and_skips_none(flight: Path) -> None:
    driver, sink, clock = driver_of(flight, "?speed=max"), RecordingSink(keep=4096), ManualClock(BEGIN_NS)
    driver.clock = clock
    driver.open(sink)
    steps = driver.steps
    assert steps is not None
    assert sink.feedback_count == 1  # the first state, for new subscribers
    while (due_ns := steps.due_ns) is not None:
        assert due_ns >= clock.now_ns
        clock.now_ns = due_ns
        calls = sink.calls
        steps.step()
        assert sink.calls <= calls + 2
    driver.close()
    assert sink.frame_counts == {"front": 20}
    assert sink.feedback_count == 97
    assert sink.link_state is LinkState.CLOSED
    assert [feedback.captured_ns for feedback in list(sink.feedbacks)[1:3]] == [BEGIN_NS - 4 * MS, BEGIN_NS + 16 * MS]
    with pytest.raises(UsageError, match="over"):
        steps.step()


def test_a_timeline() -> None:
    timeline = Timeline(2.0, 1000, 50_000)
    assert [timeline.at(time) for time in (1000, 3000, 0)] == [50_000, 51_000, 49_500]
    timeline.put_off(100)
    assert timeline.at(1000) == 50_100


def test_a_source_knows_its_start(flight: Path) -> None:
    recording = Recording.open(flight)
    source = ReplaySource(recording, recording.drone())
    assert source.begin_ns == BEGIN_NS
    assert not source.empty
    assert ReplaySource(recording, recording.drone(), 1e4).empty
    first = source.first_feedback()
    assert first is not None
    assert first.seq == 1


def test_closing_ends_the_thread(flight: Path) -> None:
    before = threading.active_count()
    with played(flight, "?speed=1") as (_, sink):
        assert sink.wait(lambda: sink.feedback_count > 0, WAIT_S)
    assert threading.active_count() == before


def test_the_page_lists_the_options_and_the_added_telemetry(flight: Path) -> None:
    text = section("docs/replay.md", "## `replay://`")
    options, _, rest = text.partition("The vehicle's data is published again")
    assert {row[0].strip("`") for row in rows(options)} == KNOWN
    with played(flight) as (_, sink):
        assert sink.wait(lambda: sink.link_state is LinkState.CLOSED, WAIT_S)
        newest = sink.newest
    assert newest is not None
    added = {name for name in newest.native or {} if name.startswith("replay.")}
    assert set(re.findall(r"`(replay\.[\w.]+)`", rest)) == added
