"""The vehicle's reports (feedback, frames, events) and their recipients."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UsageError
from skyloop.messages import (
    Annotation,
    CameraInfo,
    Capabilities,
    EncodedFrame,
    Encoding,
    EventKind,
    FlightState,
    GetStatistics,
    Hover,
    Intrinsics,
    LinkState,
    LogEntry,
    Role,
    Severity,
    Statistics,
    Takeoff,
    Text,
    Velocity,
    encode,
)
from skyloop.messages.frame import MAX_ENCODED
from skyloop.proxy import Proxy
from skyloop.transport.memory import MemoryServer
from tests.support.proxy_bench import WAIT_S, App, Bench, FakeDriver

PIXELS = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)


def sink_of(bench: Bench) -> Sink:
    assert bench.driver.sink is not None
    return bench.driver.sink


def test_feedback_is_stamped_with_the_proxys_own_fields(bench: Bench) -> None:
    pilot = bench.pilot("alice", 9)
    bench.clock.advance(0.01)
    bench.driver.report(altitude_m=2.5, native={"temperature": 21})
    feedback = pilot.last_feedback()
    assert (feedback.altitude_m, feedback.native) == (2.5, {"temperature": 21})
    assert feedback.captured_ns == feedback.published_ns == bench.clock()
    assert (feedback.owner, feedback.owner_id, feedback.owner_priority, feedback.lease) == ("alice", 1, 9, 1)
    assert feedback.vehicle_link is LinkState.UP
    bench.driver.report()
    assert pilot.last_feedback().seq == feedback.seq + 1


def test_a_silent_vehicle_leaves_the_proxys_own_feedback(bench: Bench) -> None:
    app = bench.join("me")
    app.sync()
    seen = len(app.feedback)
    captured = bench.driver.now.captured_ns
    bench.run(2.0)
    app.sync()
    news = app.feedback[seen:]
    assert 4 <= len(news) <= 10
    assert {feedback.captured_ns for feedback in news} == {captured}  # not newer than its capture time
    bench.driver.link(LinkState.LOST, "gone")
    bench.tick()
    assert app.last_feedback().vehicle_link is LinkState.LOST


def test_feedback_before_any_report_has_no_invented_data() -> None:
    with Bench() as bench:
        app = bench.join("me")
        bench.proxy.publisher._raw = None
        bench.run(0.3)
        feedback = app.last_feedback()
        assert (feedback.state, feedback.altitude_m, feedback.battery) == (FlightState.UNKNOWN, None, None)


def test_changes_of_the_flight_state_are_reported(bench: Bench) -> None:
    app = bench.join("me")
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.report(state=FlightState.FLYING)
    bench.driver.report(state=FlightState.EMERGENCY)
    flying, emergency = app.told(EventKind.STATE_CHANGED)[-2:]
    assert flying.data == {"before": "landed", "after": "flying"}
    assert emergency.severity is Severity.ERROR


def test_native_telemetry_that_is_too_large_is_dropped_and_reported(bench: Bench) -> None:
    app = bench.join("me")
    bench.driver.report(altitude_m=3.0, native={"text": "x" * 70_000})
    feedback = app.last_feedback()
    assert (feedback.altitude_m, feedback.native) == (3.0, None)
    assert len(app.told(EventKind.DRIVER_ERROR)) == 1


def test_frames_carry_their_number_time_and_intrinsics(bench: Bench) -> None:
    app = bench.join("me")
    sink = sink_of(bench)
    assert not sink.wants("front")
    sink.frame("front", PIXELS, 5, width=4, height=3)  # no viewers: still counted
    app.end.subscribe("video/front")
    assert sink.wants("front")
    intrinsics = Intrinsics(1.0, 1.0, 2.0, 1.5)
    sink.frame("front", PIXELS, 6, width=4, height=3, intrinsics=intrinsics)
    app.sync()
    ((header, pixels),) = app.frames
    assert pixels == PIXELS.tobytes()
    assert (header.camera, header.seq, header.captured_ns, header.published_ns) == ("front", 2, 6, bench.clock())
    assert (header.width, header.height, header.size, header.encoding) == (4, 3, 36, Encoding.BGR8)
    assert header.intrinsics == intrinsics


def test_undecoded_pictures_reach_their_subscribers(bench: Bench) -> None:
    app = bench.join("me")
    sink = sink_of(bench)
    assert not sink.wants_stream("front")
    app.end.subscribe("video/front")
    assert not sink.wants_stream("front")
    app.end.subscribe("stream/front")
    assert sink.wants_stream("front")
    assert not sink.wants_stream("bottom")
    intrinsics = Intrinsics(1.0, 1.0, 2.0, 1.5)
    sink.stream("front", b"key", 5, width=4, height=3, key=True, intrinsics=intrinsics)
    sink.stream("front", bytes(MAX_ENCODED + 1), 6, width=4, height=3, key=False)
    sink.stream("front", b"next", 7, width=4, height=3, key=False)
    app.sync()
    first, second = [sample for sample in app.others if isinstance(sample, EncodedFrame)]
    assert first == EncodedFrame("front", 1, 5, bench.clock(), 4, 3, "h264", True, b"key", intrinsics)
    assert (second.seq, second.captured_ns, second.data) == (3, 7, b"next")  # a gap for its subscribers
    (told,) = app.told(EventKind.DRIVER_ERROR)
    assert f"{MAX_ENCODED + 1} bytes" in told.text
    statistics = app.ask(GetStatistics())
    assert isinstance(statistics, Statistics)
    names = ("received", "too_large", "published")
    assert [statistics.counters[f"streams.front.{name}"] for name in names] == [3, 1, 2]
    app.end.subscribe("stream/front", False)
    app.sync()
    assert not sink.wants_stream("front")


def test_a_cameras_nominal_intrinsics_are_used_for_frames_of_its_size() -> None:
    nominal = Intrinsics(2.0, 2.0, 2.0, 1.5)

    class Driver(FakeDriver):
        def capabilities(self) -> Capabilities:
            return Capabilities("fake", cameras=(CameraInfo("front", 4, 3, 15.0, intrinsics=nominal),))

    bench = Bench()
    bench.driver = Driver(bench.clock)
    bench.proxy = Proxy(bench.driver, bench.server, name="bench", clock=bench.clock, ticker=False)
    with bench:
        app = bench.join("me")
        app.end.subscribe("video/front")
        sink_of(bench).frame("front", PIXELS, 1, width=4, height=3)
        sink_of(bench).frame("front", PIXELS[:1], 1, width=4, height=1)
        app.sync()
        assert [header.intrinsics for header, _ in app.frames] == [nominal, None]


def test_a_frame_of_the_wrong_size_is_reported_and_not_shown(bench: Bench) -> None:
    app = bench.join("me")
    app.end.subscribe("video/front")
    sink_of(bench).frame("front", PIXELS, 1, width=4, height=4)
    (event,) = app.told(EventKind.DRIVER_ERROR)
    assert "36 bytes" in event.text
    assert "48 bytes" in event.text
    assert app.frames == []


def test_unsendable_pixels_are_reported(bench: Bench) -> None:
    app = bench.join("me")
    app.end.subscribe("video/front")
    sink_of(bench).frame("front", PIXELS[:, ::-1], 1, width=4, height=3)
    assert len(app.told(EventKind.DRIVER_ERROR)) == 1
    assert app.frames == []


def test_the_vehicles_own_events_are_passed_on(bench: Bench) -> None:
    app = bench.join("me")
    sink_of(bench).event(EventKind.COLLISION, "touched a wall", Severity.WARNING, speed_m_s=0.4)
    (event,) = app.told(EventKind.COLLISION)
    assert (event.text, event.data) == ("touched a wall", {"speed_m_s": 0.4})


def test_an_event_with_unsendable_data_is_published_without_them(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    app = bench.join("me")
    sink_of(bench).event(EventKind.VEHICLE_MESSAGE, "m" * 5000, detail="x" * 70_000)
    (event,) = app.told(EventKind.VEHICLE_MESSAGE)
    assert len(event.text) == 1000
    assert event.data == {}
    assert "cannot be sent" in caplog.text


def test_events_are_numbered_without_gaps(bench: Bench) -> None:
    app = bench.join("me")
    for _ in range(20):
        bench.driver.link(LinkState.LOST)
        bench.driver.link(LinkState.UP)
    app.sync()
    numbers = [event.seq for event in app.events]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_undelivered_events_are_reported(bench: Bench) -> None:
    witness = bench.join("witness")
    refusing = 3

    def publish(topic: str, packet: bytes) -> int:
        nonlocal refusing
        refusing -= 1
        return bench.server.publish(topic, packet) + (refusing >= 0)

    bench.proxy.events._publish = publish
    for number in range(5):
        bench.proxy.events.publish(EventKind.VEHICLE_MESSAGE, str(number))
    bench.run(1.0)
    (event,) = witness.told(EventKind.SAMPLES_LOST)
    assert event.data == {"count": 3}
    statistics = witness.ask(GetStatistics())
    assert isinstance(statistics, Statistics)
    assert statistics.counters["events.missed"] == 3


def test_annotations_reach_their_subscribers_from_any_role(bench: Bench) -> None:
    observer, viewer = bench.join("tracker", Role.OBSERVER), bench.join("viewer")
    small = Annotation("tracker", "front", 1, 4, 3, (Text("here", (1.0, 2.0)),))
    large = Annotation("tracker", "front", 1, 4, 3, tuple(Text("x" * 256, (1.0, 2.0)) for _ in range(200)))
    observer.end.send(encode(small))
    observer.end.send(encode(large))
    observer.sync()
    viewer.sync()
    assert viewer.others == [small]
    (event,) = viewer.told(EventKind.PACKET_MALFORMED)
    assert "32768" in event.text


def test_logs_reach_their_subscribers_from_any_role(bench: Bench) -> None:
    observer, viewer = bench.join("tracker", Role.OBSERVER), bench.join("viewer")
    viewer.end.subscribe("logs")
    entry = LogEntry("tracker", "error", 1, number=0.5)
    observer.end.send(encode(entry))
    observer.sync()
    viewer.sync()
    assert viewer.others == [entry]
    statistics = viewer.ask(GetStatistics())
    assert isinstance(statistics, Statistics)
    assert statistics.counters["logs.relayed"] == 1


def test_the_software_autopilots_state_is_shown() -> None:
    with Bench(actions={"attitude"}) as bench:
        bench.driver.report(state=FlightState.UNKNOWN, altitude_m=0.0, velocity_m_s=(0.0, 0.0, 0.0))
        bench.tick()
        pilot = bench.pilot()
        pilot.command(Takeoff())

        def rise() -> None:
            altitude = (bench.driver.now.altitude_m or 0.0) + 0.02
            bench.driver.report(altitude_m=min(1.0, altitude), state=FlightState.UNKNOWN)
            pilot.command(Takeoff(), repeat=True)

        bench.run(0.5, rise)
        assert pilot.last_feedback().state is FlightState.TAKING_OFF
        assert {type(action).__name__ for action in bench.driver.told} == {"Attitude"}
        bench.run(1.0, rise)
        assert pilot.last_feedback().state is FlightState.HOVERING
        assert any(echo.app_id == 0 for echo in pilot.applied)
        pilot.command(Velocity(0.5))
        bench.run(0.1)
        assert pilot.last_feedback().state is FlightState.FLYING
        bench.run(0.5)  # silent: the ladder uses the autopilot, too
        assert pilot.last_feedback().state is FlightState.HOVERING
        bench.driver.fail = {"apply"}
        bench.run(0.1)
        assert "autopilot" in pilot.told(EventKind.DRIVER_ERROR)[-1].text


def test_a_name_must_fit() -> None:
    driver = FakeDriver(Bench().clock)
    for name in ("", "x" * 65):
        with pytest.raises(UsageError, match="1 to 64"):
            Proxy(driver, MemoryServer("m"), name=name)


def test_a_proxy_is_started_once_and_stops_twice(bench: Bench) -> None:
    with pytest.raises(UsageError, match="started before"):
        bench.proxy.start()
    bench.proxy.end()
    bench.proxy.end()


def test_a_driver_that_cannot_be_opened_leaves_nothing_behind() -> None:
    bench = Bench()
    bench.driver.fail = {"open"}
    before = threading.active_count()
    with pytest.raises(RuntimeError, match="open is broken"):
        bench.proxy.start()
    assert threading.active_count() == before


def test_a_server_end_that_cannot_be_started_opens_no_driver() -> None:
    first = Bench()
    with first:
        second = Proxy(FakeDriver(first.clock), first.server, name="bench", clock=first.clock, ticker=False)
        with pytest.raises(UsageError):
            second.start()
        second.end()
        assert isinstance(second.driver, FakeDriver)
        assert second.driver.sink is None


def test_the_ticker_takes_the_ladders_step() -> None:
    class Clocked(FakeDriver):
        hovered = threading.Event()

        def _apply(self, action: object) -> object:  # type: ignore[override]
            if isinstance(action, Hover):
                self.hovered.set()
            return action

    server = MemoryServer("real")
    driver = Clocked(monotonic_ns)
    assert driver.uri == VehicleUri("fake", text="fake://")
    with Proxy(driver, server, name="real"):
        pilot = App(server.dial, monotonic_ns)
        pilot.hello("pilot")
        pilot.take_authority()
        pilot.command(Takeoff())
        driver.report(state=FlightState.FLYING)
        assert driver.hovered.wait(WAIT_S)
        pilot.end.close()
    assert not any(thread.name == "skyloop-ticker" for thread in threading.enumerate())
