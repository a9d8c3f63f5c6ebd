"""Numbered packets of the fabric transport arrive exactly once and in order; queued items take turns."""

from __future__ import annotations

import random
import threading

import pytest

from skyloop.network.delivery import (
    AGAIN_AT_MOST_S,
    AGAIN_S,
    DEPTH,
    MAX_BYTES,
    ON_THE_WAY,
    ON_THE_WAY_BYTES,
    Incoming,
    Outgoing,
)
from skyloop.network.registry import IN_A_ROW, STALLED_S, HandlerQueue


@pytest.mark.parametrize("seed", range(8))
def test_packets_arrive_once_in_order_despite_loss_repeats_and_reordering(seed: int) -> None:
    rng = random.Random(seed)
    sent = [rng.randbytes(rng.choice((1, 40, 60_000))) for _ in range(150)]
    outgoing, incoming = Outgoing(), Incoming()
    waiting, arrived = list(sent), list[bytes]()
    now = 0.0
    while len(arrived) < len(sent) or outgoing.under_way:
        now += 0.05
        assert now < 600.0, "it takes too long"
        while waiting and outgoing.put(waiting[0]):
            waiting.pop(0)
        flying = [(number, packet) for number, packet, _ in outgoing.due(now) for _ in range(rng.choice((0, 1, 1, 2)))]
        rng.shuffle(flying)
        for number, packet in flying:
            arrived += incoming.take(number, packet)
        if rng.random() < 0.6:
            outgoing.taken(incoming.taken, now)
    assert arrived == sent
    assert outgoing.due(now + 10.0) == []


def test_few_are_in_flight_and_unacknowledged_ones_are_resent_ever_later() -> None:
    outgoing = Outgoing()
    for number in range(ON_THE_WAY + 5):
        assert outgoing.put(bytes([number]), "way")
    assert [number for number, _, _ in outgoing.due(0.0)] == list(range(1, ON_THE_WAY + 1))
    assert outgoing.due(AGAIN_S / 2) == []
    again: list[float] = []
    now = 0.0
    while len(again) < 6:
        now += 0.01
        if due := outgoing.due(now):
            assert [number for number, _, _ in due] == list(range(1, ON_THE_WAY + 1))
            again.append(now)
    gaps = [after - before for before, after in zip([0.0, *again], again, strict=False)]
    assert gaps == pytest.approx([AGAIN_S, 2 * AGAIN_S] + 4 * [AGAIN_AT_MOST_S], abs=0.02)
    assert outgoing.stalled_s(now) == pytest.approx(now)
    outgoing.taken(3, now)
    assert outgoing.stalled_s(now) == 0.0
    assert outgoing.due(now) == [(ON_THE_WAY + n, bytes([ON_THE_WAY + n - 1]), "way") for n in (1, 2, 3)]
    outgoing.taken(10**6, now)  # never sent: no effect
    assert outgoing.under_way
    outgoing.taken(ON_THE_WAY + 3, now)
    outgoing.due(now)
    outgoing.taken(ON_THE_WAY + 5, now)
    assert not outgoing.under_way
    assert outgoing.stalled_s(now + 100.0) == 0.0


def test_a_packet_is_sent_seven_times_before_its_reader_is_dropped() -> None:
    """Hence an application stays on a path that loses a third of the packets each way: each try arrives and is
    acknowledged with a probability of 4 / 9.
    """
    outgoing = Outgoing()
    outgoing.put(b"x")
    tries = [step for step in range(int(1000 * STALLED_S)) if outgoing.due(step / 1000.0)]
    assert len(tries) == 7


def test_kept_packets_are_limited_in_number_and_bytes() -> None:
    outgoing = Outgoing()
    assert sum(outgoing.put(b"x") for _ in range(2 * DEPTH)) == DEPTH
    outgoing = Outgoing()
    size = ON_THE_WAY_BYTES // 4
    assert sum(outgoing.put(bytes(size)) for _ in range(2 * DEPTH)) == MAX_BYTES // size
    assert len(outgoing.due(0.0)) == 4


def test_the_transports_own_packets_have_reserved_room() -> None:
    outgoing = Outgoing()
    while outgoing.put(b"x"):
        pass
    assert sum(outgoing.put(b"own", own=True) for _ in range(2 * DEPTH)) == DEPTH
    outgoing = Outgoing(most_bytes=10)
    assert outgoing.put(bytes(10))
    assert not outgoing.put(b"x")
    assert outgoing.put(b"own", own=True)


def test_a_packet_far_too_early_is_not_kept() -> None:
    incoming = Incoming()
    for number in range(2, 10_000):
        assert incoming.take(number, b"early") == []
    assert incoming.take(1, b"first") == [b"first", *(ON_THE_WAY - 1) * [b"early"]]
    assert incoming.take(1, b"first") == []


def test_commands_come_before_requests_and_connections_take_turns() -> None:
    queue: HandlerQueue[str] = HandlerQueue()
    for n in range(3):
        queue.put("a", f"a{n}")
    for n in range(2):
        queue.put("b", f"b{n}")
    queue.put("b", "command", urgent=True)
    assert [queue.get(0.0) for _ in range(7)] == ["command", "a0", "b0", "a1", "b1", "a2", None]


def test_endless_commands_do_not_block_other_packets() -> None:
    queue: HandlerQueue[int] = HandlerQueue()
    for _ in range(3 * IN_A_ROW):
        queue.put("a", 1, urgent=True)
    queue.put("b", 2)
    assert [queue.get(0.0) for _ in range(IN_A_ROW + 2)] == [*IN_A_ROW * [1], 2, 1]


def test_the_queue_of_one_connection_is_limited() -> None:
    queue: HandlerQueue[int] = HandlerQueue()
    assert [queue.put("a", 1, at_most=2) for _ in range(4)] == [True, True, False, False]
    assert queue.put("b", 1, at_most=2)
    assert queue.put("a", 1, urgent=True, at_most=2)
    assert queue.waiting("a") == 2


def test_a_closed_queue_still_returns_its_items() -> None:
    queue: HandlerQueue[int] = HandlerQueue()
    got: list[int | None] = []
    thread = threading.Thread(target=lambda: got.append(queue.get(60.0)))
    thread.start()
    queue.put("a", 1)
    thread.join()
    queue.put("a", 2)
    queue.close()
    assert not queue.over
    assert (got, queue.get(60.0), queue.get(60.0), queue.over) == ([1], 2, None, True)
