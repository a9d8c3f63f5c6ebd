"""The fate of packets on a bad path: pure, so it needs neither root nor time."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.hosts.impairments import Impairments, Way
from skyloop.clock import nanoseconds
from skyloop.errors import UsageError

RATES = st.floats(0.0, 1.0)
TIMES_S = st.floats(0.0, 0.1)
IMPAIRMENTS = st.builds(Impairments, RATES, TIMES_S, TIMES_S, RATES, TIMES_S)
PAUSES_NS = st.lists(st.integers(0, 10_000_000), min_size=1, max_size=100)


def arrivals(way: Way, pauses_ns: list[int]) -> dict[int, tuple[int, int]]:
    """When each packet that left went in and when it was due, by its number."""
    now_ns, sent, found = 0, [], {}
    for number, pause_ns in enumerate(pauses_ns):
        now_ns += pause_ns
        sent.append(now_ns)
        way.put(number.to_bytes(2), now_ns)
    while (next_ns := way.next_ns) is not None:
        assert way.get(next_ns - 1) is None
        got = way.get(next_ns)
        assert got is not None
        due_ns, packet = got
        assert due_ns == next_ns
        number = int.from_bytes(packet)
        assert number not in found
        found[number] = (sent[number], due_ns)
    return found


@given(IMPAIRMENTS, PAUSES_NS, st.integers())
def test_each_packet_is_lost_or_arrives_once_within_the_bounds(
    wrong: Impairments, pauses_ns: list[int], seed: int
) -> None:
    way = Way(seed, wrong)
    found = arrivals(way, pauses_ns)
    assert len(found) + way.lost == len(pauses_ns)
    for sent_ns, due_ns in found.values():
        assert nanoseconds(wrong.delay_s) - 1 <= due_ns - sent_ns <= nanoseconds(wrong.longest_s) + 2


@given(IMPAIRMENTS, PAUSES_NS, st.integers())
def test_the_same_seed_does_the_same(wrong: Impairments, pauses_ns: list[int], seed: int) -> None:
    assert arrivals(Way(seed, wrong), pauses_ns) == arrivals(Way(seed, wrong), pauses_ns)


@given(TIMES_S, TIMES_S, PAUSES_NS, st.integers())
def test_jitter_alone_keeps_the_order(delay_s: float, jitter_s: float, pauses_ns: list[int], seed: int) -> None:
    found = arrivals(Way(seed, Impairments(delay_s=delay_s, jitter_s=jitter_s)), pauses_ns)
    assert list(found) == list(range(len(pauses_ns)))


@given(RATES, PAUSES_NS, st.integers())
def test_the_lost_packets_do_not_depend_on_other_impairments(loss: float, pauses_ns: list[int], seed: int) -> None:
    plain = arrivals(Way(seed, Impairments(loss=loss)), pauses_ns)
    late = arrivals(Way(seed, Impairments(loss, delay_s=0.05, jitter_s=0.02, reorder=0.5)), pauses_ns)
    assert set(plain) == set(late)


def test_rates_are_kept_and_those_held_back_are_overtaken() -> None:
    way = Way(3, Impairments(loss=0.3, reorder=0.2, reorder_s=0.01))
    found = arrivals(way, [1_000_000] * 10_000)
    assert 0.27 < way.lost / 10_000 < 0.33
    late = [number for number, (sent, due) in found.items() if due - sent == 10_000_000]
    assert 0.17 < len(late) / len(found) < 0.23
    order = list(found)
    assert order != sorted(order)


def test_changed_rates_apply_to_later_packets() -> None:
    way = Way(0, Impairments(loss=1.0))
    way.put(b"lost", 0)
    way.impairments = Impairments(delay_s=0.001)
    way.put(b"late", 0)
    assert (way.lost, way.get(0), way.get(1_000_000)) == (1, None, (1_000_000, b"late"))


@pytest.mark.parametrize("wrong", [{"loss": 1.1}, {"reorder": -0.1}, {"loss": float("nan")}, {"delay_s": 61.0}])
def test_nonsense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Impairments(**wrong)
