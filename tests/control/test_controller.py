"""The loop that runs a controller, against a proxy scripted by the test."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from skyloop.client import AuthorityStatus, Drone, Frame
from skyloop.control import Controller, RunSummary
from skyloop.control.controller import misspelt
from skyloop.errors import AuthorityError, UnknownNameError, UsageError
from skyloop.messages import EventKind, Feedback, FlightState, Hover, Velocity
from skyloop.transport.base import video
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, background, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


class Noting(Controller):
    """Records its calls and their threads."""

    def __init__(self, drone: Drone) -> None:
        super().__init__(drone)
        self.threads: set[int] = set()
        self.samples: list[int] = []
        self.frames: list[int] = []

    def on_feedback(self, feedback: Feedback) -> None:
        self.threads.add(threading.get_ident())
        self.samples.append(feedback.seq)

    def on_frame(self, frame: Frame) -> None:
        self.threads.add(threading.get_ident())
        self.frames.append(frame.seq)


class Looking(Controller):
    """Handles only frames."""

    def on_frame(self, frame: Frame) -> None: ...


def test_callbacks_run_on_the_thread_that_called_run(proxy: ScriptedProxy, drone: Drone) -> None:
    controller = Noting(drone)
    sending = background(
        lambda: drone.wait(lambda _: proxy.server.subscribers(video("front")) == 1, WAIT_S), lambda: proxy.frame(1)
    )
    summary = controller.run(seconds=WAIT_S, until=lambda: bool(controller.frames) and len(controller.samples) > 3)
    sending.join(WAIT_S)
    assert controller.threads == {threading.get_ident()}
    assert controller.frames == [1]
    assert controller.samples == sorted(set(controller.samples))
    assert summary.reason == "until"
    assert (summary.frames, summary.feedback) == (1, len(controller.samples))
    assert str(summary).startswith(f"{summary.seconds:.1f} s until until: 1 frames (0 dropped)")
    drone.wait(lambda _: proxy.server.subscribers(video("front")) == 0, WAIT_S)


def test_ends_after_the_time(drone: Drone) -> None:
    summary = Controller(drone).run(seconds=0.1)
    assert summary.reason == "time"
    assert 0.1 <= summary.seconds < 0.3
    assert Controller(drone).run(seconds=0).feedback == 0
    with pytest.raises(UsageError, match="seconds"):
        Controller(drone).run(seconds=-1.0)


def test_can_be_stopped_from_a_callback_and_from_a_thread_and_run_again(drone: Drone) -> None:
    class Once(Controller):
        calls = 0

        def on_feedback(self, feedback: Feedback) -> None:
            self.calls += 1
            self.stop()

    controller = Once(drone)
    assert controller.run(seconds=WAIT_S).reason == "stopped"
    assert controller.run(seconds=WAIT_S).reason == "stopped"
    assert controller.calls == 2
    looking = Looking(drone)
    running = threading.Event()
    stopping = background(lambda: running.wait(WAIT_S), looking.stop)

    def until() -> bool:
        running.set()
        return False

    assert looking.run(seconds=WAIT_S, until=until).reason == "stopped"
    stopping.join(WAIT_S)


def test_ends_with_the_drone(drone: Drone) -> None:
    looking = Looking(drone)
    running = threading.Event()
    closing = background(lambda: running.wait(WAIT_S), drone.close)

    def until() -> bool:
        running.set()
        return False

    assert looking.run(until=until).reason == "closed"
    closing.join(WAIT_S)


def test_a_slow_callback_gets_the_newest_and_is_an_overrun(proxy: ScriptedProxy, drone: Drone) -> None:
    class Slow(Noting):
        def on_frame(self, frame: Frame) -> None:
            super().on_frame(frame)
            if frame.seq == 1:
                drone.next_frame()
                for seq in range(2, 6):
                    proxy.frame(seq)
                    assert drone.next_frame(timeout_s=WAIT_S).seq == seq
            else:
                self.stop()

    drone.frame()
    sending = background(
        lambda: drone.wait(lambda _: len(drone._state.video.channels["front"]._drops) == 1, WAIT_S),
        lambda: proxy.frame(1),
    )
    controller = Slow(drone)
    summary = controller.run(seconds=WAIT_S)
    sending.join(WAIT_S)
    assert controller.frames == [1, 5]
    assert summary.frames_dropped == 3
    assert summary.overruns >= 1


@pytest.mark.parametrize("airborne", [True, False])
def test_an_exception_makes_it_hover_and_propagates(proxy: ScriptedProxy, drone: Drone, airborne: bool) -> None:
    class Wrong(Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            raise ZeroDivisionError("a mistake")

    proxy.state = FlightState.FLYING if airborne else FlightState.LANDED
    drone.wait(proxy.state, WAIT_S)
    controller = Wrong(drone)
    with pytest.raises(ZeroDivisionError, match="a mistake"):
        controller.run(seconds=WAIT_S)
    if airborne:
        proxy.until_commanded(Hover())
    else:
        assert Hover() not in proxy.actions()
    with pytest.raises(ZeroDivisionError):
        controller.run(seconds=WAIT_S)


def test_a_takeover_is_reported_once_and_the_run_continues(proxy: ScriptedProxy, drone: Drone) -> None:
    class Flying(Controller):
        def __init__(self, drone: Drone) -> None:
            super().__init__(drone)
            self.told: list[AuthorityStatus] = []
            self.refused = 0

        def on_feedback(self, feedback: Feedback) -> None:
            try:
                self.drone.velocity(forward=0.1)
            except AuthorityError:
                self.refused += 1
                raise
            if self.told and len(self.told) == 1 and self.drone.authority.state == "held":
                raise AssertionError("the return was not told")

        def on_authority(self, status: AuthorityStatus) -> None:
            self.told.append(status)

    controller = Flying(drone)
    events = background(
        lambda: proxy.until_commanded(Velocity(forward=0.1)),
        proxy.take_over,
        lambda: drone.wait(lambda _: controller.refused > 3, WAIT_S),
        lambda: proxy.give_back(drone.app_id, "me"),
    )
    summary = controller.run(seconds=WAIT_S, until=lambda: len(controller.told) == 2)
    events.join(WAIT_S)
    assert summary.reason == "until"
    assert [status.state for status in controller.told] == ["preempted", "held"]
    assert controller.told[0].holder == "boss"
    assert controller.refused > 3


def test_flying_without_ever_acquiring_authority_is_an_error(proxy: ScriptedProxy) -> None:
    class Flying(Controller):
        def on_feedback(self, feedback: Feedback) -> None:
            self.drone.hover()

    with flown(proxy, access="observe") as drone, pytest.raises(AuthorityError, match="observes"):
        Flying(drone).run(seconds=WAIT_S)


def test_a_chosen_camera(proxy: ScriptedProxy, drone: Drone) -> None:
    class Down(Noting):
        camera = "bottom"

    controller = Down(drone)
    sending = background(
        lambda: drone.wait(lambda _: proxy.server.subscribers(video("bottom")) == 1, WAIT_S),
        lambda: proxy.frame(7, "bottom"),
    )
    controller.run(seconds=WAIT_S, until=lambda: controller.frames == [7])
    sending.join(WAIT_S)
    controller.camera = "sideways"
    with pytest.raises(UnknownNameError):
        controller.run(seconds=WAIT_S)


def test_summary_in_words() -> None:
    summary = RunSummary(30, 64, 2, 1, 3, 2.04, "time")
    assert str(summary) == "2.0 s until time: 30 frames (2 dropped), 64 feedback samples (1 dropped), 3 overruns"


class Misspelt(Controller):
    def onframe(self, frame: Frame) -> None: ...

    def on_feedbacks(self, feedback: Feedback) -> None: ...


class Empty(Controller):
    def once(self) -> None: ...


class Steering(Controller):
    def on_feedback(self, feedback: Feedback) -> None:
        self.drone.velocity(forward=0.1)


def test_a_misspelt_callback_is_named(drone: Drone) -> None:
    summary = Misspelt(drone).run(seconds=0)
    assert summary.notes == (
        "Misspelt.onframe is never called: did you mean on_frame?",
        "Misspelt.on_feedbacks is never called: did you mean on_feedback?",
    )
    assert str(summary).splitlines()[1] == f"note: {summary.notes[0]}"
    nothing = "Empty has none of on_feedback, on_frame, on_result: nothing was called"
    assert Empty(drone).run(seconds=0).notes == (nothing,)
    assert list(misspelt(Controller)) == list(misspelt(Looking)) == list(misspelt(Noting)) == []


@pytest.mark.parametrize("state", [FlightState.LANDED, FlightState.FLYING])
def test_a_forgotten_take_off_is_reported(proxy: ScriptedProxy, drone: Drone, state: FlightState) -> None:
    proxy.state = state
    drone.wait(lambda feedback: feedback.state is state, WAIT_S)
    notes = Steering(drone).run(seconds=WAIT_S, until=lambda: Velocity(forward=0.1) in proxy.actions()).notes
    if state is FlightState.FLYING:
        assert notes == ()
    else:
        assert notes == ("the drone never took off, so its set-points had no effect: call drone.takeoff() first",)


def test_limited_set_points_are_reported_by_limit_and_number(proxy: ScriptedProxy, drone: Drone) -> None:
    def limited(asked: float, app: str = drone._state.app, limit: str = "limits.yaw_rate") -> None:
        proxy.event(EventKind.COMMAND_CLAMPED, "limited", app, limit=limit, asked=asked, applied=1.75)

    def known(asked: float) -> bool:
        return any(event.data.get("asked") == asked for event in drone.recent_events())

    limited(50.0)  # before the run, so not part of the summary
    drone.wait(lambda _: known(50.0), WAIT_S)

    class Turning(Controller):
        sent = False

        def on_feedback(self, feedback: Feedback) -> None:
            if not self.sent:
                self.sent = True
                limited(97.0)
                limited(7.0, "another")
                limited(99.0)
                limited(3.0, limit="limits.speed")

    assert Turning(drone).run(seconds=WAIT_S, until=lambda: known(3.0)).notes == (
        "limits.yaw_rate limited set-points 2 times: 1.75 instead of 99",
        "limits.speed limited set-points: 1.75 instead of 3",
    )


class Detector:
    def why_nothing(self) -> str:
        return "nothing was found"


def test_detectors_without_findings_explain_themselves_wherever_they_are(
    drone: Drone, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Own(Controller):
        detector = Detector()

        def __init__(self, drone: Drone) -> None:
            super().__init__(drone)
            self.another = Detector()

        def on_frame(self, frame: Frame) -> None: ...

    monkeypatch.setitem(globals(), "of_the_module", Own.detector)
    assert Looking(drone).run(seconds=0).notes == ("nothing was found",)
    assert Own(drone).run(seconds=0).notes == ("nothing was found",) * 2
