"""Nothing old is executed: a page's command is carried out in time, or never."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from skyloop.clock import monotonic_ns, seconds
from skyloop.cockpit.commands import (
    AHEAD_S,
    LATE_S,
    STOP_LATE_S,
    Alive,
    AnyCommand,
    Fly,
    GoTo,
    HoverHere,
    LandAll,
    LandHere,
    Release,
    Reset,
    Stop,
    StopAll,
    Take,
    TakeOff,
    Write,
    untimely,
)
from skyloop.cockpit.control_session import ControlSession
from skyloop.cockpit.station import PilotConnection
from skyloop.cockpit.stream import PageSocket
from skyloop.messages import (
    EmergencyStop,
    Event,
    EventKind,
    FlightState,
    Land,
    Refusal,
    Takeoff,
    Value,
    Velocity,
)
from tests.support.cockpit import Node, until
from tests.support.cockpit_page import count, page
from tests.support.testclient import TestClient

NOW_S = 1000.0
ORDERS: list[tuple[Callable[..., AnyCommand], tuple[object, ...]]] = [
    (Take, (4,)),
    (Release, ()),
    (TakeOff, ()),
    (HoverHere, ()),
    (LandHere, ()),
    (Reset, ()),
    (Fly, (0.5,)),
    (GoTo, (1.0, 2.0, 3.0)),
    (Write, ("limits.tilt", 0.2)),
]


@pytest.mark.parametrize(("kind", "values"), [*ORDERS, (LandAll, ())], ids=lambda one: getattr(one, "__name__", ""))
def test_a_command_that_may_be_older_than_half_a_second_is_refused(
    kind: Callable[..., AnyCommand], values: tuple[object, ...]
) -> None:
    def why(age_s: float, unsure_s: float = 0.0) -> str:
        return untimely(kind(*values, at_s=NOW_S - age_s, unsure_s=unsure_s), NOW_S)

    assert LATE_S == 0.5
    assert why(0.0) == why(0.49) == why(0.3, 0.19) == ""
    assert "0.5 s" in why(0.51)
    assert "12.0 s after it was requested" in why(12.0)
    assert why(0.3, 0.21), "no benefit of the doubt"
    assert "known to within 0.6 s" in why(0.0, 0.6)
    assert why(-AHEAD_S) == why(-0.2, 0.2) == ""
    assert "ahead" in why(-0.2), "from the future: one of the clocks is wrong"
    assert "ping first" in untimely(kind(*values), NOW_S), "an order says when it was asked for"


@pytest.mark.parametrize("kind", [Stop, StopAll])
def test_an_emergency_stop_may_be_two_seconds_late_and_no_more(kind: type[Stop | StopAll]) -> None:
    assert STOP_LATE_S == 2.0
    assert untimely(kind(at_s=NOW_S - 1.9), NOW_S) == ""
    assert untimely(kind(at_s=NOW_S - 2.1), NOW_S)
    assert untimely(kind(at_s=NOW_S - 1.9, unsure_s=0.2), NOW_S)
    assert untimely(kind(), NOW_S)


def test_a_take_off_from_before_a_stall_does_not_happen(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().say("takeoff", at_s=time.monotonic() - 8.0, n=7)
        told = pilot.wait("refused", do="takeoff")
        assert "8.0 s after it was requested" in told["why"]
        assert told["n"] == 7
        pilot.say("ping")
        pilot.wait("pong")
        assert not count(node, Takeoff())
        assert node.flyer.state is FlightState.LANDED
        pilot.take_off()


def test_old_key_presses_do_not_cut_the_motors(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("stop", at_s=time.monotonic() - 12.0)
        assert "12.0 s after" in pilot.wait("refused", do="stop")["why"]
        pilot.say("ping")
        pilot.wait("pong")
        assert not count(node, EmergencyStop())
        pilot.say("stop", at_s=time.monotonic() - 1.5, n=9)
        assert pilot.wait("sent", do="stop")["n"] == 9
        until(lambda: node.flyer.state is FlightState.EMERGENCY)


def test_old_stick_commands_are_ignored_and_not_signs_of_life(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("fly", forward=0.3)
        until(lambda: node.flyer.state is FlightState.FLYING)
        begin_s = time.monotonic()
        for _ in range(40):  # messages held back by an 8 s stall arrive all at once, and more follow
            pilot.say("fly", left=0.4, at_s=time.monotonic() - 8.0)
            pilot.say("ping", at_s=time.monotonic() - 8.0, seen_s=time.monotonic() - 8.0)
            time.sleep(0.02)
        until(lambda: node.flyer.state is FlightState.HOVERING)
        assert time.monotonic() - begin_s < 5.0, "the page counts as silent all the same"
        assert not count(node, Velocity(left=0.4))
        pilot.wait("refused", do="fly")


def test_queued_messages_are_handled_together() -> None:
    """The sockets of a cockpit that gets too little processor time."""
    coming = [{"type": "websocket.receive", "text": text} for text in "abc"]

    class Socket:
        async def receive(self) -> dict[str, str]:
            return coming.pop(0) if coming else {"type": "websocket.disconnect"}

    handled: list[tuple[str | bytes, ...]] = []
    asyncio.run(PageSocket(Socket()).serve(lambda messages: handled.append(tuple(messages))))  # type: ignore[arg-type]
    assert handled == [("a", "b", "c")]


def test_only_the_newest_of_queued_stick_commands_flies(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of them flew, one after another, each up to 0.5 s old, even those from before an emergency stop."""
    handle = ControlSession._on_messages

    def handle_all(session: ControlSession, messages: Sequence[str | bytes]) -> None:
        at_s = time.monotonic()
        waited = [json.dumps({"do": "fly", "left": tenths / 10, "at_s": at_s}) for tenths in range(1, 9)]
        handle(session, [*(waited if '"hover"' in str(messages) else ()), *messages])

    monkeypatch.setattr(ControlSession, "_on_messages", handle_all)
    with page(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.say("hover")
            until(lambda: count(node, Velocity(left=0.8)))
        assert not any(count(node, Velocity(left=tenths / 10)) for tenths in range(1, 8))


def test_released_sticks_hover_however_late_the_message_arrives(client: TestClient, node: Node) -> None:
    """It was refused as too old, and newer sticks kept the previous velocity: a page sends it only once."""
    with page(client) as pilot:
        pilot.take().take_off()
        with pilot.staying():
            pilot.say("fly", forward=0.3)
            until(lambda: node.flyer.state is FlightState.FLYING)
            pilot.say("hover", automatic=True, at_s=time.monotonic() - LATE_S - 0.1)
            until(lambda: node.flyer.state is FlightState.HOVERING)
            pilot.wait("sent", do="hover")


def test_each_command_is_answered_with_its_number(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.say("take", priority=4, n=1)
        assert pilot.wait("sent", do="take")["n"] == 1
        pilot.wait("authority", mine=True)
        pilot.say("takeoff", n=2)
        assert pilot.wait("sent", do="takeoff")["n"] == 2
        pilot.wait("done", do="takeoff")
        pilot.say("set", name="limits.tilt", value=0.2, n=3)
        assert pilot.wait("sent", do="set")["n"] == 3
        pilot.say("land", n=4)
        assert pilot.wait("sent", do="land")["n"] == 4
        until(lambda: count(node, Land()))


def test_a_command_queued_behind_a_slow_one_becomes_too_old(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    with page(client) as pilot:
        pilot.take()
        acquire = PilotConnection.acquire

        def slow(pilot: PilotConnection, *arguments: Any, **options: Any) -> Any:
            time.sleep(LATE_S + 0.2)
            return acquire(pilot, *arguments, **options)

        monkeypatch.setattr(PilotConnection, "acquire", slow)
        pilot.say("take", priority=3)
        pilot.say("set", name="limits.tilt", value=0.2)
        assert "after it was requested" in pilot.wait("refused", do="set")["why"]


def test_a_command_reported_as_not_sent_never_happens_later(client: TestClient, node: Node) -> None:
    with node.connect("watcher", access="observe") as watcher, page(client) as pilot:
        until(lambda: any("cockpit stop connected" in event.text for event in watcher.recent_events()))
        node.stop()
        pilot.say("stop", at_s=time.monotonic() - 1.5)
        assert "not sent" in pilot.wait("refused", do="stop")["why"]
        node.restart()
        watcher.wait(lambda feedback: feedback.state is FlightState.LANDED, 5)
        for _ in range(20):
            assert watcher.next_feedback().state is FlightState.LANDED
        assert not count(node, EmergencyStop())


def test_a_pong_carries_the_cockpits_clock(client: TestClient) -> None:
    with page(client) as pilot:
        before_ns = monotonic_ns()
        pilot.socket.send_json({"do": "ping", "n": 3})
        told = pilot.wait("pong", n=3)
        assert seconds(before_ns) <= told["now_s"] <= seconds(monotonic_ns())


def test_a_ping_is_answered_whatever_its_time() -> None:
    assert untimely(Alive(), NOW_S), "it is no sign of life"


def test_a_failed_take_off_is_not_repeated_forever(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skyloop.cockpit.control_session._BEGUN_NS", 1_000_000_000)
    with page(client) as pilot:
        node.flyer.deaf = True  # as if all packets were lost on the way
        pilot.take().say("takeoff")
        pilot.wait("sent", do="takeoff")
        with pilot.staying():
            until(lambda: count(node, Takeoff()), "it is asked for")
            time.sleep(1.2)
            asked = count(node, Takeoff())
            time.sleep(0.3)
            assert count(node, Takeoff()) == asked, "and then no more"


def test_a_late_packet_does_not_refuse_its_repeats(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_event = ControlSession._on_event

    def late(session: ControlSession, event: Event) -> None:
        data: dict[str, Value] = {"reason": Refusal.STALE.value}
        on_event(
            session, Event(EventKind.COMMAND_REFUSED, "land refused: it is 0.257 s old", 0, app=session.app, data=data)
        )
        on_event(session, event)

    monkeypatch.setattr(ControlSession, "_on_event", late)
    with page(client) as pilot:
        pilot.take().take_off()
        pilot.say("land")
        pilot.wait("done", do="land")
        assert not [told for told in pilot.told if told["type"] == "refused"]
