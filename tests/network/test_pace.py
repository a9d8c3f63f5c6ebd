"""A silent subscriber gets few packets of a topic whose newest packet alone counts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

pytest.importorskip("zenoh", reason="needs the extra network: skyloop install network")

from skyloop.network import packets
from skyloop.network.admission import Admission
from skyloop.network.connection import Publisher, ServerConnection
from skyloop.network.delivery import ACKNOWLEDGE_AFTER, SLOW_S, STANDS_S, AckPolicy, Pace
from skyloop.network.sealing import PLAIN
from skyloop.network.session import FabricSession
from skyloop.transport.base import EVENTS, FEEDBACK, Peer

PERIOD_S = 1 / 32


class Scene:
    """A publisher, its clock and sent packets; a subscriber that gets them 50 ms later while its path carries them."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.sent: list[tuple[str, int]] = []  # key and number
        self.publisher = Publisher("alpha", "1" * 16, PLAIN, lambda: self.now_s)
        self.publisher.open(cast("FabricSession", SimpleNamespace(publisher=self._declare)), lambda _: "")
        self._subscribers: dict[ServerConnection, tuple[AckPolicy, list[tuple[float, int]]]] = {}
        self.standing: set[ServerConnection] = set()

    def _declare(self, key: str, _priority: str, **_: Any) -> Any:
        def put(_payload: bytes, *, attachment: bytes) -> None:
            number = packets.parse_published(attachment)[1]
            self.sent.append((key, number))
            for _policy, under_way in self._subscribers.values():
                under_way.append((self.now_s + 0.05, number))

        return SimpleNamespace(put=put)

    def subscriber(self, number: int, every_s: float = 0.15, topic: str = FEEDBACK) -> ServerConnection:
        connection = ServerConnection(Peer(number, "app"), "anyone", f"{number:016x}", self.now_s, Admission())
        assert self.publisher.subscribe(connection, packets.Subscribe(topic, on=True))
        self._subscribers[connection] = AckPolicy(every_s), []
        return connection

    def go(self, length_s: float, topic: str = FEEDBACK) -> int:
        """Publish for a while, 32 times a second; return how many were sent."""
        before, end_s = len(self.sent), self.now_s + length_s
        while self.now_s < end_s:
            self.publisher.publish(topic, b"x")
            self.now_s += PERIOD_S
            for connection, (policy, under_way) in self._subscribers.items():
                if connection in self.standing:
                    continue
                while under_way and under_way[0][0] <= self.now_s:
                    number = under_way.pop(0)[1]
                    if policy.count(number, 0, self.now_s):
                        connection.took(topic, number, self.now_s)
        return len(self.sent) - before


def test_on_a_stalled_path_few_packets_are_sent_and_afterwards_all_at_once() -> None:
    scene = Scene()
    pilot = scene.subscriber(1)
    assert scene.go(10.0) == 320
    scene.standing.add(pilot)
    in_silence = scene.go(4.0)
    assert in_silence <= (STANDS_S + 0.25) * 32 + (4.0 - STANDS_S) / SLOW_S + 1, "and not 128"
    assert scene.publisher.held_back == 128 - in_silence
    scene.standing.clear()
    assert scene.go(1.0) >= 31
    assert [number for _, number in scene.sent] == list(range(1, len(scene.sent) + 1)), "none seems lost in transit"


def test_skipped_packets_count_as_missed_by_each_subscriber() -> None:
    scene = Scene()
    scene.standing |= {scene.subscriber(1), scene.subscriber(2)}
    for connection in scene.standing:
        connection.paces[FEEDBACK].sent(1, scene.now_s)
        for number in (2, 3):
            connection.paces[FEEDBACK].sent(number, scene.now_s)
            connection.paces[FEEDBACK].taken(number - 1, scene.now_s)
    scene.publisher._numbers[FEEDBACK] = 3
    scene.now_s += STANDS_S + 0.1
    assert scene.publisher.publish(FEEDBACK, b"x") == 0
    assert scene.publisher.publish(FEEDBACK, b"x") == 2


def test_one_responsive_subscriber_is_enough() -> None:
    scene = Scene()
    scene.subscriber(1)
    scene.standing.add(scene.subscriber(2))
    assert scene.go(5.0) == 160


def test_a_subscriber_that_acknowledges_rarely_as_earlier_versions_do_gets_all() -> None:
    scene = Scene()
    pilot = scene.subscriber(1, every_s=1e9)
    scene.go(10.0)
    scene.standing.add(pilot)
    assert scene.go(4.0) == 128


def test_other_topics_are_not_paced() -> None:
    scene = Scene()
    scene.standing.add(scene.subscriber(1, topic=EVENTS))
    assert scene.go(5.0, EVENTS) == 160


def test_a_paced_subscriber_does_not_count_as_silent() -> None:
    pace, now_s = Pace(), 0.0
    for number in range(1, 20):
        assert pace.may_send(now_s)
        pace.sent(number, now_s)
        pace.taken(number, now_s + 0.05)
        now_s += 5.0  # nothing is in flight meanwhile
    pace.sent(20, now_s)
    assert pace.may_send(now_s + STANDS_S)
    pace.sent(21, now_s + STANDS_S)
    assert not pace.may_send(now_s + STANDS_S + 0.1)
    pace.taken(99, now_s + STANDS_S + 0.1)  # never sent
    assert not pace.may_send(now_s + STANDS_S + 0.1)
    pace.taken(20, now_s + STANDS_S + 0.2)
    assert pace.may_send(now_s + STANDS_S + 0.2)


def test_one_acknowledgement_does_not_show_their_rate() -> None:
    pace = Pace()
    pace.sent(1, 0.0)
    pace.sent(ACKNOWLEDGE_AFTER, 1.0)
    pace.taken(ACKNOWLEDGE_AFTER - 1, 1.0)
    assert pace.may_send(9.0)
