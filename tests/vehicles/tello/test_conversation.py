"""Which answer belongs to which command."""

from __future__ import annotations

from skyloop.clock import nanoseconds
from skyloop.vehicles.tello.protocol import MOTION_NS, PATIENCE_NS, TRIES, Conversation, Request

STEP = PATIENCE_NS + 1


def asked(conversation: Conversation, text: str) -> list[str | None]:
    replies: list[str | None] = []
    conversation.ask(Request(text, replies.append))
    return replies


def test_one_question_at_a_time() -> None:
    talk = Conversation()
    first, second = asked(talk, "sdk?"), asked(talk, "sn?")
    assert talk.messages(0) == ["sdk?"]
    assert talk.messages(1) == []
    assert talk.on_reply("20") is None
    assert first == ["20"]
    assert talk.messages(2) == ["sn?"]
    talk.on_reply("0TQDG7REDB1X2Y")
    assert second == ["0TQDG7REDB1X2Y"]
    assert talk.idle
    assert talk.counts == {"answered": 2, "unanswered": 0, "stray": 0}


def test_what_is_not_answered_is_said_again_and_then_given_up() -> None:
    talk = Conversation()
    replies = asked(talk, "wifi?")
    said = [talk.messages(n * STEP) for n in range(TRIES + 1)]
    assert said == [["wifi?"]] * TRIES + [[]]
    assert replies == [None]
    assert talk.counts["unanswered"] == 1


def test_a_late_answer_to_something_else_is_not_taken() -> None:
    talk = Conversation()
    asked(talk, "wifi?")
    talk.messages(0)
    talk.on_reply("ok")
    assert talk.counts["stray"] == 1
    assert not talk.idle


def test_while_a_take_off_is_not_answered_nothing_is_asked_that_is_answered_alike() -> None:
    talk = Conversation()
    talk.moved("takeoff", 0)
    streamon, wifi = asked(talk, "streamon"), asked(talk, "wifi?")
    assert talk.messages(1) == ["wifi?"]
    assert talk.on_reply("90") is None
    assert wifi == ["90"]
    assert talk.messages(2) == []
    assert talk.on_reply("ok") == "takeoff"
    assert talk.messages(3) == ["streamon"]
    talk.on_reply("ok")
    assert streamon == ["ok"]


def test_an_error_while_something_is_moved_is_the_motions() -> None:
    talk = Conversation()
    talk.moved("takeoff", 0)
    replies = asked(talk, "wifi?")
    talk.messages(1)
    assert talk.on_reply("error") == "takeoff"
    assert replies == []


def test_a_motion_that_is_never_answered_is_forgotten() -> None:
    talk = Conversation()
    talk.moved("land", 0)
    replies = asked(talk, "mon")
    assert talk.messages(MOTION_NS - 1) == []
    assert talk.messages(MOTION_NS) == ["mon"]
    talk.on_reply("ok")
    assert replies == ["ok"]


def test_a_drone_that_is_gone_answers_nothing() -> None:
    talk = Conversation()
    first, second = asked(talk, "sdk?"), asked(talk, "sn?")
    talk.messages(nanoseconds(1))
    talk.abandon()
    assert (first, second) == ([None], [None])
    assert talk.idle
