"""Links that fail and return, with a scripted proxy."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from skyloop import extend
from skyloop.client import Drone, LinkStatus, RedialPolicy
from skyloop.client.channels import Listener
from skyloop.client.drone import open_drone
from skyloop.errors import AuthorityError, ClosedError, LinkError, NoAnswerError, RefusedError, UnknownNameError
from skyloop.messages import (
    Command,
    Done,
    Event,
    EventKind,
    GetParameter,
    Hello,
    Hover,
    Idle,
    JoinProcessor,
    Land,
    LinkState,
    Ping,
    Refusal,
    Refused,
    RequestAuthority,
    SetParameter,
    Takeoff,
    Velocity,
    VideoRequest,
    encode,
)
from skyloop.messages.frame import EncodedFrame
from skyloop.transport.base import EVENTS, FEEDBACK, ClientHandler, TransportClient, video
from skyloop.transport.memory import Faults
from tests.support.scripted_proxy import QUICK, WAIT_S, ScriptedProxy, background, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


class Told:
    """The calls of a drone's on_link listener."""

    def __init__(self, drone: Drone) -> None:
        self.states: list[LinkState] = []
        self.reasons: list[str] = []
        self._came = threading.Condition()
        drone.on_link(self._add)

    def _add(self, status: LinkStatus) -> None:
        with self._came:
            self.states.append(status.application)
            self.reasons.append(status.reason)
            self._came.notify_all()

    def until(self, state: LinkState, after: int = 0) -> int:
        with self._came:
            assert self._came.wait_for(lambda: state in self.states[after:], WAIT_S), (state, self.states)
            return after + self.states[after:].index(state) + 1


def restarted(proxy: ScriptedProxy) -> None:
    proxy.stop()
    proxy.start()


def test_a_restarted_proxy_gets_everything_back(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    events: list[Event] = []
    frames: list[int] = []
    drone.on_event(events.append)
    drone.on_frame(lambda frame: frames.append(frame.seq))
    drone.config["limits.tilt"] = 0.2
    proxy.parameters["limits.tilt"] = 0.35  # as after a restart
    drone.velocity(forward=1.0)
    proxy.until_commanded(Velocity(forward=1.0))
    proxy.stop()
    at = told.until(LinkState.LOST)
    assert "stopped" in told.reasons[at - 1]
    assert drone.authority.state == "none"
    assert drone.velocity(forward=0.3) is False, "nothing is raised, the packet was just not sent"
    proxy.commands.clear()
    proxy.requests.clear()
    started_s = time.monotonic()
    proxy.start()
    told.until(LinkState.UP, at)
    assert time.monotonic() - started_s < 5.0
    drone.wait(lambda _: drone.authority.state == "held" and proxy.parameters["limits.tilt"] == 0.2, WAIT_S)
    assert RequestAuthority(16) in proxy.requests
    assert any(isinstance(request, SetParameter) for request in proxy.requests)
    for topic in (EVENTS, FEEDBACK, video("front")):
        assert proxy.server.subscribers(topic) == 1
    proxy.until(lambda: len(proxy.commands) > 3)
    assert Velocity(forward=1.0) not in proxy.actions()
    proxy.frame(1)
    drone.wait(lambda _: frames == [1], WAIT_S)
    states = [event.data["state"] for event in events if event.kind is EventKind.APPLICATION_LINK]
    assert states == ["lost", "up"]
    assert drone.velocity(forward=0.5)


def test_old_set_points_are_not_resumed(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.velocity(forward=1.0)
    proxy.until_commanded(Velocity(forward=1.0))
    told = Told(drone)
    proxy.stop()
    proxy.commands.clear()
    at = told.until(LinkState.LOST)
    proxy.start()
    told.until(LinkState.UP, at)
    proxy.until(lambda: len(proxy.commands) > 3)
    assert set(proxy.actions()) == {Idle()}


def test_a_command_just_before_the_return_of_the_link_is_sent(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.stop()
    told.until(LinkState.LOST)
    assert drone.velocity(forward=0.4) is False
    assert drone.velocity(forward=0.5) is False
    proxy.start()
    command = proxy.until_commanded(Velocity(forward=0.5))
    assert command.lease == 1
    assert Velocity(forward=0.4) not in proxy.actions()


def test_repeated_losses(proxy: ScriptedProxy, drone: Drone) -> None:
    told, at = Told(drone), 0
    for _ in range(5):
        restarted(proxy)
        at = told.until(LinkState.LOST, at)
        at = told.until(LinkState.UP, at)
    assert drone.link.application is LinkState.UP


def test_a_silent_proxy_is_degraded_then_lost_then_back(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.answers[Ping] = None
    proxy.answers[Hello] = None
    proxy.beating.clear()
    at = told.until(LinkState.DEGRADED)
    at = told.until(LinkState.LOST, at)
    assert "no data" in told.reasons[at - 1]
    assert sum(isinstance(request, Ping) for request in proxy.requests) == 1, "more would wait on the way"
    proxy.answers.clear()
    proxy.beating.set()
    told.until(LinkState.UP, at)
    drone.wait(lambda _: drone.authority.state == "held", WAIT_S)


def test_a_proxy_without_feedback_is_pinged_and_resubscribed(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.beating.clear()
    at = told.until(LinkState.DEGRADED)
    assert "no feedback" in told.reasons[at - 1]
    proxy.until(lambda: any(isinstance(request, Ping) for request in proxy.requests))
    time_out = time.monotonic() + 0.6  # twice the time of a silent one
    proxy.notifier.wait_for(lambda: time.monotonic() > time_out, 0.7)
    assert LinkState.LOST not in told.states
    proxy.beating.set()
    told.until(LinkState.UP, at)


def test_readers_follow_a_proxy_that_restarts_with_another_camera(proxy: ScriptedProxy, drone: Drone) -> None:
    """The reader waited for the old camera forever."""
    found: list[str] = []
    reads = background(lambda: found.append(next(drone.frames(timeout_s=WAIT_S)).camera))
    proxy.until(lambda: proxy.server.subscribers("video/front") == 1, "the first subscription")
    top = msgspec.structs.replace(proxy.capabilities.cameras[0], name="top")
    proxy.capabilities = msgspec.structs.replace(proxy.capabilities, cameras=(top,))
    restarted(proxy)
    proxy.until(lambda: proxy.server.subscribers("video/top") >= 1, "the new camera's subscription")
    end_s = time.monotonic() + WAIT_S
    for seq in itertools.count(1):
        proxy.frame(seq, "top")
        if not reads.is_alive() or time.monotonic() > end_s:
            break
        time.sleep(0.01)
    reads.join(WAIT_S)
    assert found == ["top"]
    with pytest.raises(UnknownNameError, match="front"):
        drone.next_frame("front")


@pytest.mark.parametrize("kept", [False, True], ids=["another one", "another one first"])
def test_callbacks_follow_a_proxy_that_restarts_with_another_camera(
    proxy: ScriptedProxy, drone: Drone, kept: bool
) -> None:
    """If they named no camera; readers already did so."""
    frames: list[str] = []
    inline: list[str] = []
    named: list[str] = []
    pictures: list[EncodedFrame] = []
    listeners: list[Listener[Any]] = [
        drone.on_frame(lambda frame: frames.append(frame.camera)),
        drone.on_frame(lambda frame: inline.append(frame.camera), inline=True),
        drone.on_frame(lambda frame: named.append(frame.camera), "front"),
        drone.on_encoded(pictures.append, kbit_s=100),
    ]
    mailboxes = extend.inbox(drone, frames=True)
    front = proxy.capabilities.cameras[0]
    cameras = (msgspec.structs.replace(front, name="top"), *((front,) if kept else ()))
    with mailboxes:
        proxy.until(lambda: proxy.server.subscribers("video/front") == 1, "the first subscription")
        proxy.capabilities = msgspec.structs.replace(proxy.capabilities, cameras=cameras)
        restarted(proxy)
        proxy.until(lambda: proxy.server.subscribers("video/top") >= 1, "the new camera's subscription")
        for seq in itertools.count(1):
            proxy.frame(seq, "top")
            frame = mailboxes.frame()
            if frame is not None and frames and inline:
                break
            assert seq < 100 * WAIT_S, "no frame arrived"
            time.sleep(0.01)
        assert frame is not None
        assert frame.camera == "top"
        assert set(frames) == set(inline) == {"top"}
        assert named == []
        stream = VideoRequest("top", encoding="h264", kbit_s=100).stream_topic
        assert drone._state.video.streams[stream].consumed
    for listener in listeners:
        listener.cancel()
    assert not any(channel.consumed for channel in drone._state.video.by_topic.values())
    assert not any(channel.consumed for channel in drone._state.video.streams.values())
    assert not drone._state.on_welcome.consumed


def test_a_processor_follows_a_proxy_that_restarts_with_another_camera(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.answers[JoinProcessor] = Done()
    membership = extend.join_processor(drone, "found", code="1")
    top = msgspec.structs.replace(proxy.capabilities.cameras[0], name="top")
    proxy.capabilities = msgspec.structs.replace(proxy.capabilities, cameras=(top,))
    restarted(proxy)
    proxy.until(
        lambda: any(isinstance(one, JoinProcessor) and one.camera == "top" for one in proxy.requests), "it joins again"
    )
    assert membership.camera == "top"
    membership.close()


def test_garbage_restarts_the_connection(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    app_id = drone.app_id
    for _ in range(6):
        proxy.garbage()
    at = told.until(LinkState.LOST)
    assert "malformed" in told.reasons[at - 1]
    told.until(LinkState.UP, at)
    assert drone.app_id == app_id + 1
    assert drone.stats["feedback"].malformed >= 5


def test_kinds_that_proxies_never_send_are_malformed(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.server.publish(EVENTS, encode(Command(1, 1, 1, 0, Hover())))
    drone.wait(lambda _: drone.stats["feedback"].malformed == 1, WAIT_S)
    assert drone.link.application in (LinkState.UP, LinkState.DEGRADED)


def test_a_stalled_camera_is_resubscribed(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.frame()
    drone.wait(lambda _: proxy.server.subscribers(video("front")) == 1, WAIT_S)
    client = next(iter(proxy.server._clients.values()))
    client.topics.discard(video("front"))  # the proxy forgot
    drone.wait(lambda _: proxy.server.subscribers(video("front")) == 1, WAIT_S)


def test_loss_and_disorder(caplog: pytest.LogCaptureFixture) -> None:
    faults = Faults(seed=5, drop=0.05, duplicate=0.05, reorder=0.05, corrupt=0.01)
    with scripted(faults=faults) as proxy, flown(proxy, policy=RedialPolicy(hello_s=0.2)) as drone:
        seqs: list[int] = []
        drone.on_feedback(lambda feedback: seqs.append(feedback.seq), inline=True)
        drone.wait(lambda _: len(seqs) > 100, WAIT_S)
        assert drone.config["limits.tilt"] == 0.35
        assert drone.stats["feedback"].lost > 0
        assert drone.velocity(forward=0.5) or drone.authority.state != "held"
    assert "Traceback" not in caplog.text


def test_no_proxy_at_first() -> None:
    proxy = ScriptedProxy()
    with pytest.raises(LinkError, match="has no server"):
        open_drone(proxy.server.dial, app="me")


def test_a_proxy_that_does_not_answer(proxy: ScriptedProxy) -> None:
    proxy.answers[Hello] = None
    with pytest.raises(NoAnswerError, match="was reached but did not answer"):
        open_drone(proxy.server.dial, app="me", policy=RedialPolicy(hello_s=0.05), timeout_s=0.05)


def test_a_proxy_that_refuses(proxy: ScriptedProxy) -> None:
    proxy.answers[Hello] = Refused(Refusal.PROTOCOL, "another version")
    with pytest.raises(RefusedError, match="another version"):
        open_drone(proxy.server.dial, app="me")


def test_a_proxy_without_feedback(proxy: ScriptedProxy) -> None:
    proxy.beating.clear()
    proxy._ended.set()
    with pytest.raises(NoAnswerError, match="scripted answered but reported no vehicle state"):
        open_drone(proxy.server.dial, app="me", timeout_s=0.1)


def test_take_off_over_a_lost_link(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.stop()
    told.until(LinkState.LOST)
    with pytest.raises(NoAnswerError, match="and the link is lost"):
        drone.takeoff(timeout_s=0.05)
    proxy.start()
    proxy.until(lambda: proxy.actions().count(Idle()) > 3, "the drone commands nothing")
    assert Takeoff() not in proxy.actions(), "the call has ended: no take-off follows"


def test_an_unsent_take_off_raises_and_is_not_executed_later(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.stop()
    told.until(LinkState.LOST)
    assert drone.command(Takeoff()) is False  # it would be sent if the link returned soon
    with pytest.raises(LinkError, match=r"takeoff was not sent: the link to the proxy is lost \("):
        drone.takeoff(wait=False)
    proxy.start()
    proxy.until(lambda: proxy.actions().count(Idle()) > 3, "the drone commands nothing")
    assert Takeoff() not in proxy.actions()


def test_an_unsent_landing_raises_and_is_sent_if_the_link_returns_soon(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.stop()
    told.until(LinkState.LOST)
    with pytest.raises(LinkError, match=r"land was not sent: .* sent if that changes within half a second"):
        drone.land(wait=False)
    proxy.start()
    proxy.until_commanded(Land())


def test_a_take_off_before_the_authority_is_confirmed_raises(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.answers[RequestAuthority] = None
    proxy.stop()
    at = told.until(LinkState.LOST)
    proxy.start()
    told.until(LinkState.UP, at)
    with pytest.raises(AuthorityError, match="takeoff was not sent: the proxy has not confirmed the authority yet"):
        drone.takeoff(wait=False)


def test_requests_over_a_lost_link_wait_for_its_return(proxy: ScriptedProxy, drone: Drone) -> None:
    told = Told(drone)
    proxy.stop()
    told.until(LinkState.LOST)
    got: list[object] = []
    thread = threading.Thread(target=lambda: got.append(drone.config["limits.tilt"]))
    thread.start()
    proxy.start()
    thread.join(WAIT_S)
    assert got == [0.35]


def test_requests_end_with_the_time_out_or_the_drone(proxy: ScriptedProxy, drone: Drone) -> None:
    proxy.answers[GetParameter] = None
    with pytest.raises(NoAnswerError, match=r"GetParameter.*0\.1 s"):
        drone._connection.call(lambda: GetParameter("x"), 0.1)
    ended: list[BaseException] = []

    def ask() -> None:
        try:
            drone._connection.call(lambda: GetParameter("x"), WAIT_S)
        except ClosedError as error:
            ended.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    proxy.until(lambda: sum(isinstance(request, GetParameter) for request in proxy.requests) >= 2)
    drone.close()
    thread.join(WAIT_S)
    assert len(ended) == 1


def test_an_internal_error_in_the_link_s_thread_does_not_end_it(
    proxy: ScriptedProxy, drone: Drone, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told = Told(drone)
    failing = iter([True])
    tick = drone._commands.tick

    def fail_once(now_ns: int) -> int:
        if next(failing, False):
            raise RuntimeError("a mistake")
        return tick(now_ns)

    monkeypatch.setattr(drone._commands, "tick", fail_once)
    at = told.until(LinkState.LOST)
    told.until(LinkState.UP, at)
    assert "a mistake" in caplog.text


def test_a_connection_that_ends_during_hello(proxy: ScriptedProxy) -> None:
    class Ending:
        def __init__(self, handler: ClientHandler) -> None:
            self._end = proxy.server.dial(handler)
            proxy.server.end(self._end, "no room", muted=True)

        def __getattr__(self, name: str) -> object:
            return getattr(self._end, name)

    with pytest.raises(LinkError, match="no room"):
        open_drone(Ending, app="me")  # type: ignore[arg-type]


class OtherClock:
    """An end whose proxy's clock appears to be an hour ahead."""

    same_clock = False

    def __init__(self, end: TransportClient, handler: ClientHandler) -> None:
        self._end = end

    def __getattr__(self, name: str) -> object:
        return getattr(self._end, name)


def test_the_offset_between_clocks(proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    ahead_ns = 3600 * 10**9
    real = time.monotonic_ns

    def dial(handler: ClientHandler) -> TransportClient:
        return OtherClock(proxy.server.dial(handler), handler)  # type: ignore[return-value]

    class ProxyTime:
        monotonic_ns = staticmethod(lambda: real() + ahead_ns)

    monkeypatch.setattr("tests.support.scripted_proxy.time", ProxyTime)
    drone = open_drone(dial, app="me", policy=QUICK)
    try:
        assert abs(drone._connection.offset_ns - ahead_ns) < 50_000_000
        drone.hover()
        proxy.until(lambda: len(proxy.commands) > 2)
        assert abs(proxy.commands[-1].sent_ns - ProxyTime.monotonic_ns()) < 2 * 10**9
        drone.next_feedback()
        stats = drone.stats["feedback"]
        assert stats.age_s is not None
        assert -0.05 < stats.age_s < 1.0
        drone.feedback(max_age_s=1.0)
    finally:
        drone.close()


def test_policy() -> None:
    policy = RedialPolicy()
    pauses = [policy.pause_s(failures) for failures in range(50)]
    assert pauses[0] == pytest.approx(0.02)
    assert pauses == sorted(pauses)
    assert pauses[-1] == pytest.approx(0.3)


def test_closing_from_an_inline_listener(proxy: ScriptedProxy) -> None:
    closed = threading.Event()
    with flown(proxy) as drone:

        def close(feedback: object) -> None:
            if not drone.closed:
                drone.close()
                closed.set()

        drone.on_feedback(close, inline=True)
        assert closed.wait(WAIT_S)
        assert drone.link.application is LinkState.CLOSED
        thread = drone._supervisor._thread
        thread.join(WAIT_S)
        assert not thread.is_alive()
