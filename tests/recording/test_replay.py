"""Replays through proxy and client: in step with one application, and served like any vehicle."""

from __future__ import annotations

import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

import skyloop
from skyloop.client import Drone
from skyloop.client.drone import open_drone
from skyloop.clock import NS_PER_S
from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import parse_uri
from skyloop.errors import LinkError, NoAnswerError, UnsupportedError, UsageError
from skyloop.messages import Applied, Event, EventKind, Feedback, Hover, Velocity
from skyloop.proxy.proxy import Proxy
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.recording.review.compare import compare
from skyloop.stepping.replay import SteppedReplay, connector
from skyloop.transport.memory import MemoryServer
from skyloop.vehicles.replay.driver import ReplayDriver
from tests.support.recorded_flights import BEGIN_NS, CAPABILITIES, MS, Plan, write_flight

WAIT_S = 10.0


class Steering(skyloop.Controller):
    """Flies by the frames; records its calls and the fate of its commands."""

    gain = 1.0

    def __init__(self, drone: Drone) -> None:
        super().__init__(drone)
        self.frames: list[int] = []
        self.ages_ms: list[float] = []
        self.feedback: list[int] = []
        self.applied: list[Applied] = []
        drone.on_command(self.applied.append)

    def on_feedback(self, feedback: Feedback) -> None:
        self.feedback.append(feedback.captured_ns)

    def on_frame(self, frame: skyloop.Frame) -> None:
        self.frames.append(frame.seq)
        self.ages_ms.append(frame.age_s * 1e3)
        state = frame.feedback
        assert state is not None
        assert state.yaw_rad is not None
        if state.state == "flying":
            self.drone.velocity(forward=self.gain * float(frame.mean()) / 100, yaw_rate=-0.1 * state.yaw_rad)


class Bolder(Steering):
    gain = 2.0


def flown(path: Path, controller: type[Steering] = Steering) -> Steering:
    with skyloop.connect(f"replay://{path}?speed=max", on_exit="hover") as drone:
        made = controller(drone)
        summary = made.run()
        assert summary.reason == "closed"
        assert (summary.frames_dropped, summary.feedback_dropped) == (0, 0)
        assert summary.seconds == pytest.approx(2.0, abs=0.05)
    return made


# In step -----------------------------------------------------------------------------------------------------------


def test_every_frame_is_delivered_and_two_runs_give_the_same_commands(flight: Path) -> None:
    begun = time.monotonic()
    runs = [flown(flight) for _ in range(3)]
    assert time.monotonic() - begun < 3.0  # of six seconds of flight
    assert runs[0].frames == list(range(1, 21))
    assert len(set(runs[0].feedback)) >= 96
    assert len(runs[0].applied) > 50
    assert any(isinstance(one.applied, Velocity) and one.applied.forward > 0.3 for one in runs[0].applied)
    assert runs[0].applied == runs[1].applied == runs[2].applied
    assert flown(flight, Bolder).applied != runs[0].applied


def test_the_time_is_the_recordings(flight: Path) -> None:
    controller = flown(flight)
    assert controller.ages_ms == pytest.approx([30.0] * 20, abs=0.1)
    assert controller.feedback[0] <= BEGIN_NS
    assert controller.feedback[-1] == BEGIN_NS + 1976 * MS
    times = [one.applied_ns for one in controller.applied]
    assert times == sorted(times)
    assert BEGIN_NS <= times[0] < times[-1] <= BEGIN_NS + 2000 * MS
    # A set-point repeats at 32 Hz between the frames that change it, and nothing delays a command.
    assert all(one.applied_ns == one.sent_ns for one in controller.applied)


def test_waiting_advances_the_time(flight: Path) -> None:
    with skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone:
        assert drone.feedback().state == "landed"
        assert drone.wait("flying", timeout_s=5.0).captured_ns == BEGIN_NS + 496 * MS
        before = drone.feedback().captured_ns
        first = drone.next_frame()
        assert 0 < first.captured_ns - before + 30 * MS <= 100 * MS
        frames = drone.frames()
        assert [next(frames).seq - first.seq for _ in range(3)] == [1, 2, 3]
        assert drone.next_feedback().captured_ns > before
        time.sleep(0.05)  # no time passes meanwhile
        assert drone.next_frame().seq == first.seq + 3  # the newest one not read yet
        assert drone.next_frame().seq == first.seq + 4
        with pytest.raises(NoAnswerError, match=r"not emergency within 0\.2 s"):
            drone.wait("emergency", timeout_s=0.2)
        drone.land()
        assert drone.feedback().state == "landed"
        assert drone.link.vehicle == "up"
        drone.wait(lambda feedback: feedback.vehicle_link == "closed", timeout_s=5.0)
        drone.frame()
        drone.next_frame()  # the last one
        with pytest.raises(NoAnswerError):
            drone.next_frame(timeout_s=3600.0)  # none arrives after the end, and the call does not wait an hour
        assert drone.link.vehicle == "closed"
        assert "end of the recording" in drone.link.reason


def test_takeoff_returns_at_the_recorded_take_off(flight: Path) -> None:
    with skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone:
        drone.takeoff()
        assert drone.feedback().state == "flying"
        controller = Steering(drone)
        controller.run(seconds=0.5)
        assert len(controller.frames) == 5


def test_listeners_and_processors_are_in_step_too(flight: Path) -> None:
    seen: list[int] = []
    events: list[Event] = []
    waits: list[Exception] = []
    with skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone:

        def process(frame: skyloop.Frame) -> None:
            seen.append(frame.seq)
            try:
                drone.next_frame()
            except UsageError as error:
                waits.append(error)

        drone.on_frame(process)
        drone.on_event(events.append)
        Steering(drone).run()
    assert seen == list(range(1, 21))
    assert len(waits) == 20
    assert any(event.text == "touched a chair" for event in events)
    assert any(event.text.startswith("recorded: ") for event in events)


def test_parameters_can_be_requested_as_usual(flight: Path) -> None:
    with skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone:
        drone.config["limits.speed"] = 0.1
        drone.wait("flying", timeout_s=5.0)
        echoes: list[Applied] = []
        drone.on_command(echoes.append)
        drone.velocity(forward=1.0)
        drone.next_frame()
        assert drone.config["recorded.limits.tilt"] == 0.35
        assert echoes[0].asked == Velocity(forward=1.0)
        assert isinstance(echoes[0].applied, Velocity)
        assert echoes[0].applied.forward == pytest.approx(0.1)


def test_a_set_point_decays_in_the_recordings_time(flight: Path) -> None:
    with skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover", stall_s=0.3) as drone:
        asked: list[Applied] = []
        drone.on_command(asked.append)
        drone.wait("flying", timeout_s=5.0)
        drone.velocity(forward=0.2)
        begun_ns = drone.feedback().captured_ns
        drone.wait(lambda feedback: feedback.captured_ns > begun_ns + 600 * MS, timeout_s=5.0)
    hover_ns = next(one.applied_ns for one in asked if one.asked == Hover())
    assert 0.3 <= (hover_ns - begun_ns) / 1e9 < 0.36


def test_it_belongs_to_one_application(flight: Path) -> None:
    way = connector(f"replay://{flight}?speed=max")
    assert isinstance(way, SteppedReplay)
    dial = way.dialer(0.0)
    try:
        with (
            open_drone(dial, app="first", scheduler=way.scheduler, on_exit="hover"),
            pytest.raises(LinkError, match="in step with one application, which is already connected"),
        ):
            open_drone(dial, app="second", timeout_s=0.5)
    finally:
        way.close()
        way.close()
    with pytest.raises(LinkError, match="ended"):
        open_drone(dial, app="late", timeout_s=0.5)


def test_other_speeds_use_an_ordinary_proxy(flight: Path) -> None:
    assert connector(f"replay://{flight}?speed=3") is None


def test_errors_are_reported_when_connecting(tmp_path: Path, flight: Path) -> None:
    before = threading.active_count()
    with pytest.raises(UsageError, match="No such file"):
        skyloop.connect(f"replay://{tmp_path}/none.mcap?speed=max")
    with pytest.raises(UsageError, match="start is 99 s"):
        skyloop.connect(f"replay://{flight}?speed=max&start=99")
    assert threading.active_count() == before


def test_an_exception_in_a_controller_propagates(flight: Path) -> None:
    class Wrong(skyloop.Controller):
        def on_frame(self, frame: skyloop.Frame) -> None:
            raise ZeroDivisionError("a mistake")

    before = threading.active_count()
    with (
        skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone,
        pytest.raises(ZeroDivisionError, match="a mistake"),
    ):
        Wrong(drone).run()
    assert threading.active_count() == before


def test_an_exception_in_a_predicate_propagates(flight: Path) -> None:
    def wrong(feedback: Feedback) -> bool:
        if feedback.state == "flying":
            raise ZeroDivisionError("a mistake")
        return False

    with (
        skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone,
        pytest.raises(ZeroDivisionError),
    ):
        drone.wait(wrong, timeout_s=5.0)


def test_another_thread_can_wait_too(flight: Path) -> None:
    with skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone:
        states: list[str] = []
        waiting = threading.Event()

        def look() -> None:
            def down(feedback: Feedback) -> bool:
                waiting.set()
                return feedback.state == "landing"

            states.append(drone.wait(down, timeout_s=WAIT_S).state.value)

        def until() -> bool:
            if not thread.is_alive() and not thread.ident:
                thread.start()
                waiting.wait(WAIT_S)
            return False

        thread = threading.Thread(target=look)
        Steering(drone).run(until=until)
        thread.join(WAIT_S)
    assert states == ["landing"]


def test_ctrl_c_ends_the_waiting(flight: Path) -> None:
    with skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover") as drone:
        main = threading.main_thread().ident
        assert main is not None

        def interrupt(feedback: Feedback) -> bool:
            if not sent and feedback.state == "flying":
                sent.append(feedback)
                signal.pthread_kill(main, signal.SIGINT)
            time.sleep(0.001)
            return False

        sent: list[Feedback] = []
        with pytest.raises(KeyboardInterrupt):
            drone.wait(interrupt, timeout_s=1e6)
        assert drone.next_feedback()  # it continues


# Recording a replay ------------------------------------------------------------------------------------------------


def test_a_replay_is_recorded_beside_the_old_commands_and_compared(tmp_path: Path, flight: Path) -> None:
    recorded = []
    for number, controller in enumerate((Steering, Steering, Bolder)):
        path = tmp_path / f"{number}.mcap"
        with (
            skyloop.connect(f"replay://{flight}?speed=max", on_exit="hover", name="again") as drone,
            skyloop.record(drone, path),
        ):
            controller(drone).run()
        recorded.append(Recording.open(path))
    first, second, bolder = recorded
    events = [item.value for item in first.items("flight", (Channel.EVENTS,))]
    assert EventKind.RECORDING in {event.kind for event in events}
    assert all(abs(event.at_ns - BEGIN_NS) < 60 * NS_PER_S for event in events)  # the flight's time
    commands = [item.value for item in first.items("flight", (Channel.COMMANDS,))]
    assert any(isinstance(one.asked, Velocity) for one in commands)
    old = {item.value.native.get("replay.asked") for item in first.items("flight", (Channel.FEEDBACK,))}
    assert {"takeoff", "velocity", "land"} <= old
    same = compare(first, second)
    assert same.aligned.startswith("by their common clock")
    assert same.part_at_s is None
    assert same.same_action == 1.0
    assert all(field.rms == 0.0 for field in same.fields)
    other = compare(first, bolder)
    assert other.part_at_s == pytest.approx(0.5, abs=0.15)
    assert max(field.rms for field in other.fields) > 0.1
    assert compare(Recording.open(flight), first).aligned.startswith("by their common clock")
    # And a recording of a replay is a recording: it can be replayed itself.
    assert len(flown(tmp_path / "0.mcap").frames) >= 15


# Served to all applications ----------------------------------------------------------------------------------------


@pytest.fixture
def served(flight: Path) -> Iterator[MemoryServer]:
    server = MemoryServer("alpha")
    with Proxy(make_driver(f"replay://{flight}?speed=4&wait=1"), server, name="alpha"):
        yield server


def test_a_replay_is_a_vehicle_like_any_other(served: MemoryServer) -> None:
    with (
        open_drone(served.dial, app="me", on_exit="hover") as drone,
        open_drone(served.dial, app="eye", access="observe") as eye,
    ):
        echoes: list[Applied] = []
        events: list[Event] = []
        eye.on_command(echoes.append)
        eye.on_event(events.append)
        controller = Steering(drone)
        summary = controller.run()
        assert summary.reason == "closed"
        assert summary.frames + summary.frames_dropped == 20
        assert len(controller.frames) >= 10
        eye.wait(lambda _: any(isinstance(one.asked, Velocity) for one in list(echoes)), WAIT_S)
        eye.wait(lambda feedback: feedback.vehicle_link == "closed", WAIT_S)
        assert drone.authority.state == "held"
        assert any(event.text == "touched a chair" for event in events)
        assert drone.link.application != "lost"


def test_max_speed_is_only_for_one_application(flight: Path) -> None:
    driver = ReplayDriver(parse_uri(f"replay://{flight}?speed=max"))
    with pytest.raises(UsageError, match="in step with one application"):
        Proxy(driver, MemoryServer("alpha"), name="alpha").start()


def test_a_replay_of_a_vehicle_that_can_not_fly(tmp_path: Path) -> None:
    plain = msgspec.structs.replace(CAPABILITIES, actions=frozenset(), why_not="it is a picture only")
    path = write_flight(tmp_path / "plain.mcap", Plan(seconds=0.5, capabilities=plain))
    with skyloop.connect(f"replay://{path}?speed=max") as drone, pytest.raises(UnsupportedError, match="picture only"):
        drone.takeoff()


@pytest.mark.process
def test_connecting_starts_a_private_proxy(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", f"{folder}/run")
        with skyloop.connect(f"replay://{flight}?speed=2&wait=1", on_exit="hover") as drone:
            controller = Steering(drone)
            assert controller.run(seconds=WAIT_S).reason == "closed"
            assert controller.frames == sorted(set(controller.frames))
            assert len(controller.frames) >= 12
