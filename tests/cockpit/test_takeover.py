"""Asking for control before it is taken: pages on both sides, over a real proxy; and pure decisions."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skyloop.client import Authority, AuthorityStatus, Drone
from skyloop.client.drone import open_drone
from skyloop.cockpit import takeover
from skyloop.cockpit.access import Person
from skyloop.cockpit.commands import decode_command
from skyloop.cockpit.station import PilotConnection
from skyloop.cockpit.takeover import QueuePosition, QueueTracker, TakeoverQuestions
from skyloop.errors import DecodeError
from skyloop.messages import Event, EventKind, FlightState, Role
from tests.support.cockpit import Node, until
from tests.support.cockpit_page import Page, page
from tests.support.testclient import TestClient

S = 1_000_000_000


@contextmanager
def asks(node: Node, app: str = "survey.py", priority: int = 4, **options: Any) -> Iterator[Drone]:
    """A program that asks for the drone and waits in the queue."""
    asking = Authority(priority=priority, takeover="ask", stay=True, **options)
    drone = open_drone(node.dial, app=app, authority=asking)
    try:
        yield drone
    finally:
        drone.close()


def question(pilot: Page) -> dict[str, Any]:
    """Return the page's only open question."""
    [asked] = pilot.wait("asked")["questions"]
    return dict(asked)


def waits(pilot: Page, **values: Any) -> dict[str, Any]:
    """Return the page's next message about its place in the queue with these values."""
    while True:
        line = pilot.wait("authority")["line"] or {}
        if values.items() <= line.items():
            return dict(line)


# Being asked -----------------------------------------------------------------------------------------------------


def test_a_page_that_flies_is_asked_and_hands_over(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take(8).take_off()
        pilot.say("fly", forward=0.3)
        until(lambda: node.flyer.state is FlightState.FLYING)
        with asks(node, for_s=60.0) as drone:
            asked = question(pilot)
            assert 8.0 < asked.pop("left_s") <= 10.0
            assert asked == {
                "id": drone.app_id,
                "by": "survey.py",
                "priority": 4,
                "for_s": 60.0,
                "declined": False,
            }
            pilot.say("answer", id=drone.app_id, grant=True)
            told = pilot.wait("authority", state="preempted")
            assert (told["holder"], told["mine"]) == ("survey.py", False)
            assert told["given"], "it was not lost"
            assert told["app"].startswith("cockpit "), "pages have names"
            assert not [one for one in pilot.told if one["type"] == "refused"]
            assert {"type": "asked", "questions": []} in pilot.told
            until(lambda: drone.authority.state == "held")
            until(lambda: node.flyer.state is FlightState.HOVERING, "it hovers before it changes hands")
            assert told["line"]["position"] == 1 or waits(pilot, position=1)
        pilot.wait("authority", mine=True, line=None)  # the program has ended


def test_a_page_keeps_control_with_a_reason(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take(8)
        with asks(node) as drone:
            assert not question(pilot)["declined"]
            pilot.say("answer", id=drone.app_id, grant=False, reason="measuring")
            assert question(pilot)["declined"]
            pilot.wait("done", do="answer")
            until(lambda: any(event.kind is EventKind.AUTHORITY_DECLINED for event in drone.recent_events()))
            assert drone.recent_events()[-1].data["reason"] == "measuring"
            assert drone.authority.state == "queued"
        pilot.wait("asked", questions=[])  # it has left
        pilot.say("answer", id=drone.app_id, grant=True)
        assert "no longer open" in pilot.wait("refused", do="answer")["why"]
        pilot.say("hover")
        pilot.wait("done", do="hover")


@pytest.mark.parametrize("answers", [True, False])
def test_a_higher_priority_gets_control_when_the_time_is_up(client: TestClient, node: Node, answers: bool) -> None:
    with page(client) as pilot:
        pilot.take(8).say("set", name="authority.ask_s", value=0.5)
        pilot.wait("done", do="set")
        with asks(node) as drone:
            assert question(pilot)["left_s"] <= 0.5
            if answers:
                pilot.say("answer", id=drone.app_id, grant=False)
            pilot.wait("authority", mine=False, holder="survey.py")
            assert {"type": "asked", "questions": []} in pilot.told


def test_an_equal_priority_stops_asking_when_the_time_is_up(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take(8).say("set", name="authority.ask_s", value=0.2)
        pilot.wait("done", do="set")
        with asks(node, priority=8) as drone:
            question(pilot)
            pilot.wait("asked", questions=[])
            pilot.say("hover")
            pilot.wait("done", do="hover")
            assert drone.authority.state == "queued"


def test_the_first_of_several_in_line_gets_control(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take(4)
        with asks(node, "late.py", priority=10) as late:
            question(pilot)
            with asks(node, "early.py", priority=6) as early:
                assert [one["by"] for one in pilot.wait("asked")["questions"]] == ["early.py", "late.py"]
                pilot.say("answer", id=late.app_id, grant=True)
                pilot.wait("authority", holder="early.py")
                until(lambda: early.authority.state == "held")
                assert late.authority.state == "queued"


def test_only_the_holder_of_control_can_answer(client: TestClient, node: Node) -> None:
    with node.connect("demo"), page(client) as pilot, asks(node) as drone:
        pilot.say("answer", id=drone.app_id, grant=True)
        assert pilot.wait("refused", do="answer")["why"] == "take control first"
        assert drone.authority.state == "queued"


def test_a_release_withdraws_the_questions(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.take(8)
        with asks(node) as drone:
            question(pilot)
            pilot.say("release")
            pilot.wait("asked", questions=[])
            until(lambda: drone.authority.state == "held")


def test_control_taken_after_a_failed_handover_counts_as_lost(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pre-empted pilot's page reported, as a success, that it had handed control over."""
    monkeypatch.setattr(PilotConnection, "answer_takeover", lambda *_: None)
    monkeypatch.setattr(takeover, "GIVEN_S", 0.0)
    with page(client) as pilot:
        pilot.take(8)
        with asks(node) as drone:
            pilot.say("answer", id=question(pilot)["id"], grant=True)
            pilot.wait("done", do="answer")
            pilot.say("ping")
            pilot.wait("pong")
            drone.request_authority(priority=0, takeover="now")
            told = pilot.wait("authority", mine=False)
            assert "has control" in told["why"]
            assert not told["given"]


def test_control_that_leaves_before_the_answer_counts_as_handed_over(
    client: TestClient, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One time in four the page that gave control away reported that it had lost it."""
    answer, gone = PilotConnection.answer_takeover, threading.Event()

    def late(pilot: PilotConnection, lease: int, app_id: int, grant: bool, reason: str) -> None:
        answer(pilot, lease, app_id, grant, reason)
        assert gone.wait(10)

    monkeypatch.setattr(PilotConnection, "answer_takeover", late)
    with page(client) as pilot:
        pilot.take(8)
        with asks(node):
            pilot.say("answer", id=question(pilot)["id"], grant=True)
            told = pilot.wait("authority", mine=False)
            gone.set()
            assert told["given"]


# Asking ----------------------------------------------------------------------------------------------------------


def test_a_page_asks_first_and_gets_control(client: TestClient, node: Node) -> None:
    with node.connect("demo") as demo, page(client) as pilot:
        demo.on_takeover(lambda request: request.by.startswith("cockpit") and request.priority == 20)
        pilot.say("take", priority=20, ask=True)  # not higher than the holder's, which would be refused without asking
        assert pilot.wait("authority", mine=True)["line"] is None
        until(lambda: demo.authority.state == "preempted")
        pilot.say("release")
        until(lambda: demo.authority.state == "held")


def test_a_page_waits_in_line_and_leaves_it(client: TestClient, node: Node) -> None:
    with node.connect("demo") as demo, page(client) as pilot:
        demo.on_takeover(lambda _: "measuring")
        pilot.say("take", priority=8, ask=True)
        line = waits(pilot, declined="measuring", position=1)
        assert line["asked"]
        assert 8.0 < line["wait_s"] <= 10.0, "then the higher priority has it"
        pilot.say("fly", forward=0.3)
        assert "demo has control" in pilot.wait("refused", do="fly")["why"]
        pilot.say("release")
        pilot.wait("authority", state="none", line=None)
        until(lambda: any(event.kind is EventKind.AUTHORITY_WITHDRAWN for event in demo.recent_events()))
        assert demo.authority.state == "held"


def test_a_page_that_asked_takes_over_when_it_can_wait_no_longer(client: TestClient, node: Node) -> None:
    with node.connect("demo"), page(client) as pilot:
        pilot.say("take", priority=8, ask=True)
        waits(pilot, asked=True, position=1)
        pilot.take(8)


def test_pressing_take_control_in_line_keeps_the_place(client: TestClient, node: Node) -> None:
    """The page left the queue silently: the press was refused, and its connection closed with it."""
    with node.connect("demo", priority=4) as demo, page(client) as pilot:
        demo.on_takeover(lambda _: "measuring")
        pilot.say("take", priority=8, ask=True)
        waits(pilot, declined="measuring", position=1)
        pilot.say("take", priority=8)
        why = pilot.wait("refused", do="take")["why"]
        assert "demo has control with priority 4" in why
        assert "you stay in the queue" in why
        pilot.say("ping")
        pilot.wait("pong")
        assert [told["state"] for told in pilot.told if told["type"] == "authority"][-1] == "queued"
        demo.release_authority()
        pilot.wait("authority", mine=True)


def test_every_page_knows_which_pages_wait(client: TestClient, node: Node) -> None:
    with page(client) as first, page(client) as second, page(client) as third:
        mine = first.take(8).told[-1]
        assert mine["waiting"] == []
        second.say("take", priority=9, ask=True)
        app = first.wait("authority", waiting=[question(first)["by"]])["waiting"][0]
        assert third.wait("authority", waiting=[app])["holder"] == mine["app"]
        second.say("release")
        for one in (first, third):
            one.wait("authority", waiting=[])


def test_a_page_knows_which_program_goes_on_when_it_releases(client: TestClient, node: Node) -> None:
    with node.connect("demo") as demo, page(client) as pilot:
        pilot.take(8)
        pilot.wait("authority", waiting=["demo"])
        demo.release_authority()
        pilot.wait("authority", waiting=[])


def test_a_person_is_called_as_the_page_says_unless_the_login_has_a_name(client: TestClient, node: Node) -> None:
    with page(client, name="Anna\x1b[31m  Lee") as anna, page(client) as other:
        assert anna.take(8).told[-1]["app"].startswith("Anna[31m Lee (cockpit ")
        other.wait("authority", holder=anna.told[-1]["app"])
    assert Person(Role.PILOT, "ann").display_name("Boss") == "ann"
    assert Person(Role.PILOT).display_name("x" * 100) == "x" * 40


def test_a_closed_page_leaves_the_line(client: TestClient, node: Node) -> None:
    with page(client) as first:
        first.take(8)
        with page(client) as second:
            second.say("take", priority=8, ask=True)
            assert question(first)["by"].startswith("cockpit")
            waits(second, asked=True)
        first.wait("asked", questions=[])


def test_a_free_drone_is_taken_at_once(client: TestClient, node: Node) -> None:
    with page(client) as pilot:
        pilot.say("take", priority=8, ask=True)
        pilot.wait("authority", mine=True)


@pytest.mark.parametrize(
    "text",
    [
        '{"do":"take","priority":4,"ask":1}',
        '{"do":"answer","id":1}',
        '{"do":"answer","grant":true}',
        '{"do":"answer","id":1,"grant":"yes"}',
        '{"do":"answer","id":1,"grant":false,"reason":"' + "x" * 201 + '"}',
    ],
)
def test_nonsense_is_not_a_command(text: str) -> None:
    with pytest.raises(DecodeError, match="not understood"):
        decode_command(text)


# Without a proxy -------------------------------------------------------------------------------------------------


def asked(by_id: int, at_s: int = 0, **values: Any) -> Event:
    data = {"app_id": 1, "lease": 5, "by": f"app {by_id}", "by_id": by_id, "by_priority": 4, "within_s": 10.0, **values}
    return Event(EventKind.AUTHORITY_ASKED, "…", at_s * S, data=data)


def withdrawn(by_id: Any, app_id: int = 1) -> Event:
    return Event(EventKind.AUTHORITY_WITHDRAWN, "…", 0, data={"app_id": app_id, "by_id": by_id})


def test_questions_come_and_go() -> None:
    questions = TakeoverQuestions()
    assert not questions.on_event(asked(2), 9), "somebody else is asked"
    assert not questions.on_event(asked("x"), 1)  # type: ignore[arg-type]
    assert questions.on_event(asked(2), 1)
    assert questions.on_event(asked(3, at_s=4, by_priority=2), 1)
    told = questions.to_json(6 * S)["questions"]
    assert [(one["id"], one["left_s"]) for one in told] == [(3, 8.0), (2, 4.0)]
    assert not questions.update(5, 6 * S)
    assert questions.decline(2)
    assert not questions.decline(7)
    assert [one["declined"] for one in questions.to_json(6 * S)["questions"]] == [False, True]
    assert questions.update(5, 10 * S), "the time of one is over"
    assert questions.find(2) is None
    assert not questions.on_event(withdrawn(3, app_id=9), 1)
    assert not questions.on_event(withdrawn([3]), 1)
    assert questions.on_event(withdrawn(3), 1)
    assert not questions.on_event(withdrawn(3), 1)
    questions.on_event(asked(4, at_s=20), 1)
    assert questions.update(6, 20 * S), "it is held under another lease now"
    assert questions.to_json(20 * S) == {"type": "asked", "questions": []}


def test_a_place_in_line_is_stable_between_updates() -> None:
    line = QueueTracker()
    assert line.update(AuthorityStatus(), 0) is None
    line.request(ask=True)
    status = AuthorityStatus("queued", holder="demo", position=2, expected_wait_s=30.0)
    place = line.update(status, 1 * S)
    assert place == QueuePosition(2, 31 * S, asked=True, declined=None)
    assert line.update(status, 9 * S) == place
    assert place.to_json(11 * S) == {"position": 2, "wait_s": 20.0, "asked": True, "declined": None}
    line.on_event(Event(EventKind.AUTHORITY_DECLINED, "…", 0, data={"app_id": 8, "reason": "no"}), 1)
    assert line.update(status, 9 * S) == place, "somebody else was declined"
    line.on_event(Event(EventKind.AUTHORITY_DECLINED, "…", 0, data={"app_id": 1, "reason": "no"}), 1)
    assert line.update(status, 9 * S) == QueuePosition(2, 31 * S, asked=True, declined="no")
    moved = AuthorityStatus("queued", holder="demo", position=1)
    assert line.update(moved, 12 * S) == QueuePosition(1, None, asked=True, declined="no")
    assert line.update(AuthorityStatus("held", 3), 13 * S) is None
    assert line.update(AuthorityStatus("preempted", holder="safety"), 14 * S) == QueuePosition(None, None, False, None)
