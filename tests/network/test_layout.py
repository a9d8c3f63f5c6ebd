"""The key by which a packet travels, and the answer where the right is missing."""

from __future__ import annotations

import pytest

from skyloop.messages import (
    AnyRequest,
    Command,
    Hover,
    Ping,
    Refusal,
    Refused,
    Reply,
    Request,
    RequestAuthority,
    StreamReport,
    decode,
    encode,
)
from skyloop.network import layout
from skyloop.network.client import refusal_reply
from skyloop.network.keys import Identity, KeyRole
from skyloop.network.layout import ASK, COMMAND, ORDER, way_of

OLGA = Identity("olga", KeyRole.OBSERVER)
HOVER = encode(Command(1, 1, 1, 1, Hover()))


@pytest.mark.parametrize(
    ("body", "way"), [(Ping(1), ASK), (RequestAuthority(3), ORDER)], ids=["a question", "an order"]
)
def test_questions_and_orders_have_separate_keys(body: AnyRequest, way: str) -> None:
    assert way_of(encode(Request(1, body))) == way


def test_a_command_has_its_own_and_garbage_is_left_to_the_proxy() -> None:
    assert way_of(HOVER) == COMMAND
    assert way_of(b"no packet") == ASK


def test_packets_useless_when_late_are_recognised() -> None:
    report = encode(StreamReport("stream/front?kbit_s=500", 3))
    assert layout.is_report(report)
    assert way_of(report) == ASK
    assert not layout.is_report(HOVER)
    assert not layout.is_report(encode(Request(1, Ping(1))))


def test_an_order_without_the_right_is_answered_with_the_keys_identity() -> None:
    packet = refusal_reply(encode(Request(7, RequestAuthority(3))), OLGA, "alpha")
    assert packet is not None
    answer = decode(packet)
    assert isinstance(answer, Reply)
    assert isinstance(answer.body, Refused)
    assert (answer.id, answer.body.code) == (7, Refusal.OBSERVER)
    assert "olga" in answer.body.message
    assert "'alpha'" in answer.body.message
    assert refusal_reply(HOVER, OLGA, "alpha") is None
    assert refusal_reply(HOVER[:-1], OLGA, "alpha") is None, "damaged"
