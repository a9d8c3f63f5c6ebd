"""A drone with a scripted proxy: reading, listening, waiting, statistics, closing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from skyloop.client import Drone, Frame, LinkStatus, Listener
from skyloop.client.video import IDLE_KEPT
from skyloop.errors import ClosedError, NoAnswerError, UnknownNameError, UsageError
from skyloop.messages import (
    Annotation,
    Applied,
    Encoding,
    Event,
    EventKind,
    Feedback,
    FeedbackRequest,
    FlightState,
    GetStatistics,
    Hover,
    Land,
    LinkState,
    Polyline,
    ReleaseAuthority,
    RequestAuthority,
    Statistics,
    Takeoff,
    Text,
    VehiclePose,
)
from skyloop.transport.base import ANNOTATIONS, COMMANDS, video
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, background, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


def subscribed(proxy: ScriptedProxy, topic: str) -> bool:
    return proxy.server.subscribers(topic) > 0


def test_properties(drone: Drone) -> None:
    assert (drone.name, drone.uri, drone.app_id) == ("scripted", "scripted://", 1)
    assert [camera.name for camera in drone.capabilities.cameras] == ["front", "bottom"]
    assert drone.link == LinkStatus(LinkState.UP, LinkState.UP)
    assert repr(drone) == "<Drone scripted (up, authority held)>"


def test_feedback_newest_next_and_aged(proxy: ScriptedProxy, drone: Drone) -> None:
    first = drone.next_feedback()
    second = drone.next_feedback()
    assert second.seq > first.seq
    proxy.beating.clear()
    sample = proxy.feedback(captured_ns=time.monotonic_ns() - 10**9, battery=0.5)
    drone.wait(lambda feedback: feedback.battery == 0.5, WAIT_S)
    assert drone.feedback() == sample
    assert drone.feedback(max_age_s=60.0) == sample
    with pytest.raises(NoAnswerError, match=r"s old, 0\.5 s were allowed"):
        drone.feedback(max_age_s=0.5)
    with pytest.raises(NoAnswerError, match="no feedback arrived within"):
        drone.next_feedback(timeout_s=0.02)


def test_frames_newest_and_next(proxy: ScriptedProxy, drone: Drone) -> None:
    assert drone.frame() is None
    proxy.frame(1, value=11)
    first = drone.next_frame(timeout_s=WAIT_S)
    assert isinstance(first, Frame)
    assert (first.camera, first.seq, first.shape) == ("front", 1, (6, 8, 3))
    assert np.all(first == 11)
    assert first.feedback is not None
    newest = drone.frame()
    assert newest is not None
    assert newest.seq == 1
    with pytest.raises(NoAnswerError, match="no frame of front"):
        drone.next_frame(timeout_s=0.02)
    proxy.frame(2)
    assert drone.next_frame(timeout_s=WAIT_S).seq == 2
    assert drone.frame(max_age_s=60.0) is not None
    assert drone.frame(max_age_s=0.0) is None


def test_an_unknown_camera(drone: Drone) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'bottom'"):
        drone.frame("botom")
    with pytest.raises(UnknownNameError):
        drone.next_frame("left")
    with pytest.raises(UnknownNameError):
        drone.on_frame(lambda frame: None, "left")


@pytest.mark.parametrize("misspelt", [{"max_age": 0.2}, {"max_fp": 5}, {"scal": 0.5}])
def test_a_misspelt_option_of_frames_is_an_error(drone: Drone, misspelt: dict[str, Any]) -> None:
    """A program that believes that it refuses old frames would fly by them."""
    with pytest.raises(TypeError, match=next(iter(misspelt))):
        next(drone.frames(**misspelt))
    with pytest.raises(TypeError, match=next(iter(misspelt))):
        drone.on_frame(lambda frame: None, **misspelt)


def test_no_encoding_is_not_jpeg(drone: Drone) -> None:
    with pytest.raises(UsageError, match="encoding"):
        next(drone.frames(encoding=""))  # type: ignore[arg-type]


def test_frames_as_an_iterator(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    waiting = threading.Event()

    def look() -> None:
        for frame in drone.frames("bottom", timeout_s=WAIT_S):
            got.append(frame.seq)
            waiting.set()
            if frame.seq == 3:
                return

    thread = threading.Thread(target=look)
    thread.start()
    drone.wait(lambda _: subscribed(proxy, video("bottom")), WAIT_S)
    for seq in (1, 2, 3):
        proxy.frame(seq, "bottom")
        assert waiting.wait(WAIT_S)
        waiting.clear()
    thread.join(WAIT_S)
    assert got == [1, 2, 3]
    drone.wait(lambda _: not subscribed(proxy, video("bottom")), WAIT_S)


def test_an_iterator_without_frames_raises(drone: Drone) -> None:
    with pytest.raises(NoAnswerError, match=r"no frame of front arrived within 0\.02 s"):
        next(iter(drone.frames(timeout_s=0.02)))


def test_frames_that_are_too_old_are_skipped_and_counted(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    with drone.on_frame(lambda frame: got.append(frame.seq), inline=True, max_age_s=0.0):
        drone.wait(lambda _: subscribed(proxy, video("front")), WAIT_S)
        proxy.frame(1)
        drone.wait(lambda _: drone.stats["video/front"].dropped == 1, WAIT_S)
    frames = drone.frames(timeout_s=0.1, max_age_s=0.0)
    feeding = threading.Timer(0.02, proxy.frame, [2])
    feeding.start()
    with pytest.raises(NoAnswerError, match="no frame of front"):
        next(frames)
    feeding.join()
    assert not got
    with pytest.raises(UsageError, match="max_age_s is -1"):
        next(drone.frames(max_age_s=-1))


def test_a_missing_frame_has_the_vehicles_reason(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.more = {"vehicle_link": "lost", "link_reason": "no camera there", "link_remedy": "plug it in"}
    drone.wait(lambda _: drone.link.vehicle is LinkState.LOST, WAIT_S)
    with pytest.raises(NoAnswerError, match=r"0\.02 s: the vehicle's link is lost: no camera there: plug it in$"):
        drone.next_frame(timeout_s=0.02)


def test_in_a_fork_a_drone_neither_lands_nor_releases_its_parents_flight(proxy: ScriptedProxy) -> None:
    with flown(proxy) as drone:
        proxy.state = FlightState.HOVERING
        drone.wait("hovering", WAIT_S)
        drone._piloting.forked()
        asked, commanded = list(proxy.requests), proxy.actions()
        with pytest.raises(
            ClosedError, match=r"belongs to process \d+, of which this one is a fork: connect again here"
        ):
            drone.velocity(forward=1.0)
        drone._piloting.end_flight()
        drone.close()
        assert proxy.requests == asked
        assert Land() not in proxy.actions()[len(commanded) :]
        assert drone.link.application is not LinkState.LOST


def test_closing_ends_iterators_and_waits(proxy: ScriptedProxy, drone: Drone) -> None:
    ends: list[object] = []

    def iterate() -> None:
        ends.append(list(drone.frames()))

    def wait() -> None:
        with pytest.raises(ClosedError):
            drone.wait("flying", WAIT_S)
        with pytest.raises(ClosedError):
            drone.next_frame()
        ends.append("closed")

    threads = [threading.Thread(target=iterate), threading.Thread(target=wait)]
    for thread in threads:
        thread.start()
    drone.wait(lambda _: subscribed(proxy, video("front")), WAIT_S)
    drone.close()
    for thread in threads:
        thread.join(WAIT_S)
    assert len(ends) == 2
    assert [] in ends
    for use in (drone.feedback, drone.frame, drone.hover, drone.release_authority, drone.__enter__):
        with pytest.raises(ClosedError, match="connect again"):
            use()
    drone.close()


def test_processors_each_at_their_own_pace(proxy: ScriptedProxy, drone: Drone) -> None:
    entered, go_on = threading.Event(), threading.Event()
    slow: list[int] = []
    quick: list[int] = []

    def think(frame: Frame) -> None:
        slow.append(frame.seq)
        entered.set()
        go_on.wait(WAIT_S)

    thinker = drone.on_frame(think)
    shown = threading.Semaphore(0)

    def watch(frame: Frame) -> None:
        quick.append(frame.seq)
        shown.release()

    watcher = drone.on_frame(watch, depth=20)
    proxy.frame(1)
    assert entered.wait(WAIT_S)
    assert shown.acquire(timeout=WAIT_S)
    for seq in range(2, 9):
        proxy.frame(seq)
        assert shown.acquire(timeout=WAIT_S)
    entered.clear()
    go_on.set()
    assert entered.wait(WAIT_S)
    assert slow == [1, 8]
    assert (thinker.delivered, thinker.dropped, watcher.dropped) == (2, 6, 0)
    assert quick == list(range(1, 9))
    assert drone.stats["video/front"].dropped == 6
    thinker.cancel()
    watcher.cancel()
    with pytest.raises(UsageError, match="depth"):
        drone.on_frame(think, depth=0)


def test_frame_callbacks_are_listeners_like_the_others(proxy: ScriptedProxy, drone: Drone) -> None:
    events: list[Event] = []
    drone.on_event(events.append, inline=True)
    raising = drone.on_frame(lambda frame: 1 // 0, "bottom", inline=True)
    assert isinstance(raising, Listener)
    with pytest.raises(UsageError, match="'frame' can't be called"):
        drone.on_frame("frame")  # type: ignore[arg-type]
    proxy.frame(1, "bottom")
    drone.wait(lambda _: raising.errors == 1, WAIT_S)
    assert [event.data["where"] for event in events if event.kind is EventKind.CALLBACK_ERROR] == ["frames of bottom"]


def test_an_external_pose_reaches_the_proxy_unchanged(proxy: ScriptedProxy, drone: Drone) -> None:
    quaternion = (0.1, 0.3, 0.5, 0.8062257748298549)
    assert drone.send_external_pose((1.0, 2.0, 3.0), quaternion, at_ns=7, position_std_m=0.01)
    proxy.until(lambda: bool(proxy.others))
    assert proxy.others == [VehiclePose(7, (1.0, 2.0, 3.0), quaternion, 0.01)]
    with pytest.raises(UsageError, match=r"quaternion must have 4 finite numbers \(x, y, z, w\), got \(0, 0, 1\)"):
        drone.send_external_pose((1.0, 2.0, 3.0), (0, 0, 1))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"must have length 1, got 0\.5"):
        drone.send_external_pose((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 0.5))


def test_undecodable_frames(proxy: ScriptedProxy, drone: Drone) -> None:
    pytest.importorskip("cv2")
    got: list[int] = []
    with drone.on_frame(lambda frame: got.append(frame.seq), inline=True):
        proxy.frame(1, encoding=Encoding.JPEG)
        proxy.frame(2)
        drone.wait(lambda _: got == [2], WAIT_S)
        assert drone.stats["video/front"].malformed == 1


def test_a_repeated_or_overtaken_frame_is_not_shown_again(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    with drone.on_frame(lambda frame: got.append(frame.seq), inline=True):
        for seq in (1, 2, 2, 1, 5):
            proxy.frame(seq)
        drone.wait(lambda _: 5 in got, WAIT_S)
        assert got == [1, 2, 5]
        assert drone.stats["video/front"].lost == 2


def test_listeners(proxy: ScriptedProxy, drone: Drone) -> None:
    feedback: list[Feedback] = []
    inline: list[str] = []
    events: list[Event] = []
    applied: list[Applied] = []
    with (
        drone.on_feedback(feedback.append),
        drone.on_feedback(lambda _: inline.append(threading.current_thread().name), inline=True),
        drone.on_event(events.append),
        drone.on_command(applied.append),
    ):
        drone.wait(lambda _: subscribed(proxy, COMMANDS), WAIT_S)
        now_ns = time.monotonic_ns()
        proxy.event(EventKind.BATTERY_LOW, "low", battery=0.1)
        echo = Applied(1, 1, drone.app_id, now_ns - 2_000_000, now_ns, Hover(), Hover())
        proxy.publish(echo, COMMANDS)
        drone.wait(lambda _: bool(feedback and inline and events and applied), WAIT_S)
    assert events[0].kind is EventKind.BATTERY_LOW
    assert applied == [echo]
    assert inline[0].startswith("skyloop-memory-client")
    assert drone.recent_events()[-1].text == "low"
    delay = drone.stats["command"].delay_s
    assert delay is not None
    assert delay.median == pytest.approx(0.002)


def test_link_listeners_and_the_vehicle_s_hop(proxy: ScriptedProxy, drone: Drone) -> None:
    told: list[LinkStatus] = []
    with drone.on_link(told.append):
        proxy.event(EventKind.VEHICLE_LINK, "no answer", state="lost", reason="no navdata")
        proxy.more["vehicle_link"] = LinkState.LOST
        drone.wait(lambda feedback: feedback.vehicle_link is LinkState.LOST and bool(told), WAIT_S)
    assert told[0] == LinkStatus(LinkState.UP, LinkState.LOST, "no navdata")
    assert drone.link == told[0]


def test_a_raising_listener_is_an_event(proxy: ScriptedProxy, drone: Drone) -> None:
    def raising(feedback: Feedback) -> None:
        raise RuntimeError("boo")

    events: list[Event] = []
    with drone.on_event(events.append), drone.on_feedback(raising) as listener:
        drone.wait(lambda _: bool(events) and listener.errors > 2, WAIT_S)
    assert events[0].kind is EventKind.CALLBACK_ERROR
    assert (events[0].seq, events[0].data, events[0].app) == (0, {"where": "feedback"}, "me")
    assert "RuntimeError: boo" in events[0].text


def test_a_raising_event_listener_does_not_trigger_itself(proxy: ScriptedProxy, drone: Drone) -> None:
    def raising(event: Event) -> None:
        raise RuntimeError("boo")

    with drone.on_event(raising) as listener:
        proxy.event(EventKind.BATTERY_LOW)
        drone.wait(lambda _: listener.errors == 2, WAIT_S)
        seq = drone.feedback().seq
        drone.wait(lambda feedback: feedback.seq > seq + 10, WAIT_S)
        assert listener.errors == 2


def test_inline_listeners_must_not_wait(proxy: ScriptedProxy, drone: Drone) -> None:
    problems: list[str] = []

    def waiting(feedback: Feedback) -> None:
        waits: list[Callable[[], object]] = [drone.takeoff, drone.next_feedback, drone.next_frame]
        waits += [lambda: drone.wait("flying"), lambda: next(drone.frames())]
        for call in waits:
            try:
                call()
            except UsageError as error:
                problems.append(str(error))
        try:
            _ = drone.config["limits.tilt"]
        except Exception as error:  # noqa: BLE001
            problems.append(str(error))

    with drone.on_feedback(waiting, inline=True):
        drone.wait(lambda _: len(problems) >= 6, WAIT_S)
    assert all("inline callback can't wait" in problem for problem in problems)
    assert Takeoff() not in proxy.actions()


def test_not_callable(drone: Drone) -> None:
    with pytest.raises(UsageError, match="can't be called"):
        drone.on_event("print")  # type: ignore[arg-type]


def test_wait_for_states_and_predicates(proxy: ScriptedProxy, drone: Drone) -> None:
    assert drone.wait("landed", WAIT_S).state is FlightState.LANDED
    proxy.state = FlightState.FLYING
    assert drone.wait(["hovering", FlightState.FLYING], WAIT_S).state is FlightState.FLYING
    with pytest.raises(NoAnswerError, match=r"not hovering or landed within 0\.02 s: it is flying"):
        drone.wait(("hovering", "landed"), 0.02)
    with pytest.raises(UnknownNameError, match="did you mean 'hovering'"):
        drone.wait("hoovering")


def test_annotations_both_ways(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[Annotation] = []
    proxy.frame(1)
    drone.frame()
    drone.wait(lambda _: subscribed(proxy, video("front")), WAIT_S)
    proxy.frame(2)
    frame = drone.next_frame(timeout_s=WAIT_S)
    shape = Polyline(((0.0, 0.0), (1.0, 1.0)))
    with drone.on_annotation(got.append):
        assert drone.annotate(frame, [shape], source="tracker")
        proxy.until(lambda: bool(proxy.others))
        sent = proxy.others[0]
        assert sent == Annotation("tracker", "front", frame.captured_ns, 8, 6, (shape,))
        drone.wait(lambda _: subscribed(proxy, ANNOTATIONS), WAIT_S)
        proxy.publish(sent, ANNOTATIONS)  # type: ignore[arg-type]
        drone.wait(lambda _: bool(got), WAIT_S)
    assert got == [sent]


def test_drawings_may_come_from_numpy_and_are_checked(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.frame()
    drone.wait(lambda _: subscribed(proxy, video("front")), WAIT_S)
    proxy.frame(1)
    frame = drone.next_frame(timeout_s=WAIT_S)
    corners: Any = np.array([[0.0, 0.5], [1.0, 1.0]], np.float32)
    assert drone.annotate(frame, [Polyline(corners), Text("it", (np.float64(1.5), 2.0))])
    proxy.until(lambda: bool(proxy.others))
    sent = proxy.others[0]
    assert isinstance(sent, Annotation)
    assert sent.shapes == (Polyline(((0.0, 0.5), (1.0, 1.0))), Text("it", (1.5, 2.0)))
    wrong: Any
    for wrong in ([3], [Polyline((("a", "b"),))], [object()], [Text("x" * 300, (0.0, 0.0))]):  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="can't be drawn"):
            drone.annotate(frame, wrong)
    with pytest.raises(UsageError):
        drone.annotate(frame, [], source="x" * 65)


def test_statistics(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.answers[GetStatistics] = Statistics(
        {"commands.delay.count": 9.0, "commands.delay.median_s": 0.0001, "commands.delay.p99_s": 0.0002}
    )
    drone.hover()
    start = drone.stats["feedback"].count
    drone.wait(lambda _: drone.stats["feedback"].count > start + 20, WAIT_S)
    proxy.feedback(skip=3)
    drone.wait(lambda _: drone.stats["feedback"].lost >= 3, WAIT_S)
    stats = drone.stats
    assert set(stats) == {"command", "feedback", "video/front", "video/bottom"}
    assert stats["command"].count >= 1
    assert stats["command"].delay_s is not None
    assert (stats["command"].delay_s.median, stats["command"].delay_s.count) == (0.0001, 9)
    assert stats["feedback"].lost >= 3
    assert 30.0 < stats["feedback"].rate_hz < 130.0
    assert stats["feedback"].delay_s is not None
    assert 0.0 < stats["feedback"].delay_s.median < 0.05
    assert stats["feedback"].age_s is not None
    assert stats["video/front"].count == 0
    assert stats["video/front"].age_s is None
    proxy.answers[GetStatistics] = None  # without an answer, it takes a moment and lacks the figure
    assert drone.stats["command"].delay_s is None


def test_the_end_of_the_block_lands(proxy: ScriptedProxy) -> None:
    with flown(proxy) as drone:
        proxy.state = FlightState.FLYING
        drone.wait("flying", WAIT_S)
        with drone:
            landing = background(
                lambda: proxy.until(lambda: "land" in [action.name for action in proxy.actions()]),
                lambda: setattr(proxy, "state", FlightState.LANDED),
            )
        landing.join(WAIT_S)
        assert "land" in [action.name for action in proxy.actions()]
        assert isinstance(proxy.requests[-1], ReleaseAuthority)
        assert drone.closed


def test_the_end_of_the_block_hovers_if_requested(proxy: ScriptedProxy) -> None:
    with flown(proxy, on_exit="hover") as drone:
        proxy.state = FlightState.FLYING
        drone.wait("flying", WAIT_S)
        with drone:
            pass
    assert Hover() in proxy.actions()
    assert "land" not in [action.name for action in proxy.actions()]


def test_an_error_in_the_block_propagates_and_a_failed_landing_is_logged(
    proxy: ScriptedProxy, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_landing(*_: object, **__: object) -> bool:
        raise NoAnswerError("it did not land")

    with flown(proxy) as drone:
        drone.command(Hover())
        monkeypatch.setattr(drone._piloting, "complete", no_landing)
        with pytest.raises(RuntimeError, match="mine"), drone:
            raise RuntimeError("mine")
    assert "it did not land" in caplog.text


def test_a_landed_drone_is_just_closed(proxy: ScriptedProxy) -> None:
    with flown(proxy) as drone, drone:
        pass
    assert {action.name for action in proxy.actions()} <= {"idle"}


@pytest.mark.parametrize("options", [{"access": "fly"}, {"on_exit": "crash"}, {"app": ""}, {"app": "x" * 65}])
def test_unusable_options(proxy: ScriptedProxy, options: dict[str, str]) -> None:
    with pytest.raises(UsageError):
        Drone(proxy.server.dial, **{"app": "me", **options})  # type: ignore[arg-type]


def test_closing_waits_for_all_listeners_together_and_wakes_requests_for_the_authority(
    proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It took 2 s for each listener in turn, and 8 s, with a different error, for a request for the authority."""
    monkeypatch.setattr("skyloop.client.drone.JOIN_S", 0.4)
    go_on, asked = threading.Event(), threading.Event()
    errors: list[Exception] = []
    drone = Drone(proxy.server.dial, app="closing")
    drone._connect(acquire=False)
    listeners = [drone.on_feedback(lambda _: go_on.wait(WAIT_S)) for _ in range(4)]
    proxy.answers[RequestAuthority] = None

    def ask() -> None:
        asked.set()
        try:
            drone.request_authority(wait_s=WAIT_S)
        except ClosedError as error:
            errors.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    assert asked.wait(WAIT_S)
    proxy.until(lambda: all(listener.delivered for listener in listeners))
    begun_s = time.monotonic()
    drone.close()
    asking.join(WAIT_S)
    assert time.monotonic() - begun_s < 1.5
    assert "closed while" in str(errors[0])
    go_on.set()


def test_unread_channels_are_forgotten(proxy: ScriptedProxy, drone: Drone) -> None:
    """Each rate and size ever requested was kept for good."""
    state = drone._state
    watched = drone._state.video.channel(scale=0.5)
    with drone.on_frame(lambda _: None, scale=0.5), drone.on_feedback(lambda _: None, max_hz=7.0):
        for number in range(1, 100):
            drone._state.video.channel(max_fps=float(number))
            drone._state.video.stream(max_fps=float(number))
            state.feedback_channel(FeedbackRequest(max_hz=1.0 + number / 10))
        assert drone._state.video.channel(scale=0.5) is watched
        assert {id(channel) for channel in state.video.channels.values()} <= {
            id(one) for one in state.video.by_topic.values()
        }
        assert 1.0 < len(state.selected) <= IDLE_KEPT
        assert any(channel.subscribed for channel in state.selected)
    assert len(state.video.by_topic) <= IDLE_KEPT
    assert len(state.video.streams) <= IDLE_KEPT


def test_two_threads_that_request_the_same_channel_get_the_same(drone: Drone) -> None:
    start, found = threading.Barrier(8), set()

    def ask() -> None:
        start.wait(WAIT_S)
        for number in range(1, 20):
            found.add((number, id(drone._state.video.channel(max_fps=float(number)))))

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert len(found) == 19
