"""The matching of answers to commands."""

from __future__ import annotations

from skyloop.clock import nanoseconds
from skyloop.vehicles.tello.protocol import MOTION_NS, PATIENCE_NS, TRIES, Conversation, TelloRequest

STEP = PATIENCE_NS + 1


def asked(conversation: Conversation, text: str) -> list[str | None]:
    replies: list[str | None] = []
    conversation.ask(TelloRequest(text, replies.append))
    return replies


def test_one_request_at_a_time() -> None:
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


def test_an_unanswered_request_is_repeated_and_then_fails() -> None:
    talk = Conversation()
    replies = asked(talk, "wifi?")
    said = [talk.messages(n * STEP) for n in range(TRIES + 1)]
    assert said == [["wifi?"]] * TRIES + [[]]
    assert replies == [None]
    assert talk.counts["unanswered"] == 1


def test_a_late_answer_to_another_request_is_ignored() -> None:
    talk = Conversation()
    asked(talk, "wifi?")
    talk.messages(0)
    talk.on_reply("ok")
    assert talk.counts["stray"] == 1
    assert not talk.idle


def test_requests_with_the_same_answers_wait_for_an_unanswered_take_off() -> None:
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


def test_an_error_during_a_motion_belongs_to_the_motion() -> None:
    talk = Conversation()
    talk.moved("takeoff", 0)
    replies = asked(talk, "wifi?")
    talk.messages(1)
    assert talk.on_reply("error") == "takeoff"
    assert replies == []


def test_an_unanswered_motion_expires() -> None:
    talk = Conversation()
    talk.moved("land", 0)
    replies = asked(talk, "mon")
    assert talk.messages(MOTION_NS - 1) == []
    assert talk.messages(MOTION_NS) == ["mon"]
    talk.on_reply("ok")
    assert replies == ["ok"]


def test_a_lost_drone_fails_all_requests() -> None:
    talk = Conversation()
    first, second = asked(talk, "sdk?"), asked(talk, "sn?")
    talk.messages(nanoseconds(1))
    talk.abandon()
    assert (first, second) == ([None], [None])
    assert talk.idle
