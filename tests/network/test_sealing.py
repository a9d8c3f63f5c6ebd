"""Sealed packets: opened once, only by their receiver, and only unchanged."""

from __future__ import annotations

import contextlib
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.network.sealing import (
    GENERATIONS,
    PLAIN,
    SWITCH_S,
    TAG,
    TRAILER,
    WIDTH,
    Open,
    ReplayWindow,
    Seal,
    TopicSeal,
)

KEY = bytes(range(32))
WHERE = "skyloop/1/alpha/command/jane/0123456789abcdef"


@given(data=st.binary(max_size=300), attachment=st.binary(max_size=40))
def test_a_sealed_packet_opens_once(data: bytes, attachment: bytes) -> None:
    seal, opener = Seal(KEY), Open().use(KEY)
    payload, longer = seal.seal(WHERE, attachment, data)
    assert len(payload) == len(data) + TAG
    assert len(longer) == len(attachment) + TRAILER
    assert opener.open(WHERE, longer, payload) == (data, attachment)
    assert opener.open(WHERE, longer, payload) is None


@pytest.mark.parametrize("part", ["where", "attachment", "payload", "key", "moved"])
def test_a_packet_changed_on_the_way_does_not_open(part: str) -> None:
    payload, attachment = Seal(KEY).seal(WHERE, bytes(8), b"take off")
    where, key = WHERE, KEY
    if part == "where":
        where = WHERE.replace("command", "order")
    elif part == "attachment":
        attachment = b"\1" + attachment[1:]
    elif part == "payload":
        payload = payload[:-1] + bytes([payload[-1] ^ 1])
    elif part == "key":
        key = bytes(32)
    else:  # between the key expression and the attachment
        where, attachment = WHERE[:-1], WHERE[-1:].encode() + attachment
    with pytest.raises(DecodeError):
        Open().use(key).open(where, attachment, payload)


@given(st.binary(max_size=60), st.binary(max_size=60))
def test_garbage_does_not_open(attachment: bytes, payload: bytes) -> None:
    with contextlib.suppress(DecodeError):
        assert Open().use(KEY).open(WHERE, attachment, payload) is None  # of a generation that has not arrived yet


@given(st.lists(st.integers(1, 3 * WIDTH), max_size=80))
def test_a_number_is_new_once_and_never_when_too_far_behind(numbers: list[int]) -> None:
    window, seen, newest = ReplayWindow(), set[int](), 0
    for number in numbers:
        expected = number not in seen and number > newest - WIDTH
        assert window.is_new(number) is expected
        seen.add(number)
        newest = max(newest, number)


def test_each_key_expression_has_its_own_window() -> None:
    """An image may arrive long after feedback that was sent later."""
    seal, opener = Seal(KEY), Open().use(KEY)
    slow = seal.seal("skyloop/1/alpha/video/front/-", b"", b"a picture")
    for _ in range(2 * WIDTH):
        payload, attachment = seal.seal(WHERE, b"", b"")
    assert opener.open(WHERE, attachment, payload) is not None
    assert opener.open("skyloop/1/alpha/video/front/-", slow[1], slow[0]) == (b"a picture", b"")


def test_a_new_topic_key_is_used_once_it_has_had_time_to_arrive() -> None:
    now = [0.0]
    topics = TopicSeal(clock=lambda: now[0])
    before = Open().use(topics.newest.key, topics.newest.generation)
    topics.renew()
    payload, attachment = topics.seal(WHERE, b"", b"still with the old one")
    assert before.open(WHERE, attachment, payload) is not None
    now[0] = SWITCH_S
    payload, attachment = topics.seal(WHERE, b"", b"with the new one")
    assert before.open(WHERE, attachment, payload) is None, "the key has not arrived"
    assert before.use(topics.newest.key, topics.newest.generation).open(WHERE, attachment, payload) is not None


def test_further_revocations_do_not_delay_the_first_switch() -> None:
    now = [0.0]
    topics = TopicSeal(clock=lambda: now[0])
    revoked = Open().use(topics.newest.key, topics.newest.generation)
    topics.renew()
    now[0] = SWITCH_S / 2
    topics.renew()
    now[0] = SWITCH_S
    payload, attachment = topics.seal(WHERE, b"", b"not for who was revoked")
    assert revoked.open(WHERE, attachment, payload) is None
    assert revoked.use(topics.newest.key, topics.newest.generation).open(WHERE, attachment, payload) is not None


def test_old_generations_are_forgotten() -> None:
    seals = [Seal(os.urandom(32), number) for number in range(1, GENERATIONS + 2)]
    opener = Open()
    for seal in seals:
        opener.use(seal.key, seal.generation)
    payload, attachment = seals[-1].seal(WHERE, b"", b"x")
    assert opener.open(WHERE, attachment, payload) is not None
    payload, attachment = seals[0].seal(WHERE, b"", b"x")
    with pytest.raises(DecodeError, match="an outdated key"):
        opener.open(WHERE, attachment, payload)


def test_without_keys_nothing_is_sealed() -> None:
    assert PLAIN.seal(WHERE, b"a", b"b") == (b"b", b"a")
    assert PLAIN.use(KEY).open(WHERE, b"a", b"b") == (b"b", b"a")
