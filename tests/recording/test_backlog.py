"""The backlog: order, bounds, and drops."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.recording.backlog import Backlog, Item, Rank

LIMIT, RESERVE = 1000, 500
CHANNELS = {Rank.KEPT: "commands", Rank.STATE: "feedback", Rank.FRAME: "video.front"}
items = st.tuples(st.sampled_from(list(Rank)), st.integers(1, 300))


def item(rank: Rank, number: int = 0, size: int = 100) -> Item:
    return Item(0, CHANNELS[rank], rank, number, f"{rank.name}-{number}", size)


def numbers(taken: list[Item]) -> list[int]:
    return [one.received_ns for one in taken]


def test_order_of_arrival_regardless_of_rank() -> None:
    backlog = Backlog(LIMIT, RESERVE)
    for number, rank in enumerate((Rank.FRAME, Rank.KEPT, Rank.STATE, Rank.KEPT, Rank.FRAME)):
        backlog.put(item(rank, number))
    assert numbers(backlog.take(250)) == [0, 1, 2]
    assert numbers(backlog.take(10_000)) == [3, 4]
    assert backlog.take(1) == []
    assert backlog.size == 0


def test_frames_go_first_then_feedback_and_commands_never() -> None:
    backlog = Backlog(LIMIT, RESERVE)
    for number in range(5):
        for rank in Rank:
            backlog.put(item(rank, number))
    assert backlog.dropped == {(0, "video.front"): 5}
    for number in range(5, 10):
        backlog.put(item(Rank.KEPT, number))
    assert backlog.dropped == {(0, "video.front"): 5, (0, "feedback"): 5}
    assert {one.rank for one in backlog.take(10_000)} == {Rank.KEPT}


def test_the_oldest_frame_makes_room_for_the_newest() -> None:
    backlog = Backlog(LIMIT, RESERVE)
    for number in range(14):
        backlog.put(item(Rank.FRAME, number))
    assert numbers(backlog.take(10_000)) == list(range(4, 14))


def test_even_essential_items_are_bounded() -> None:
    backlog = Backlog(LIMIT, RESERVE)
    for number in range(20):
        backlog.put(item(Rank.KEPT, number))
    assert backlog.size == LIMIT + RESERVE
    assert backlog.dropped == {(0, "commands"): 5}


def test_unwritten_items_come_first_again() -> None:
    backlog = Backlog(LIMIT, RESERVE)
    for number in range(4):
        backlog.put(item(Rank(number % 3), number))
    taken = backlog.take(200)
    backlog.put(item(Rank.STATE, 4))
    backlog.put_back(taken)
    backlog.put(item(Rank.KEPT, 5))
    assert numbers(backlog.take(10_000)) == [0, 1, 2, 3, 4, 5]


def test_dropped_elsewhere() -> None:
    backlog = Backlog(LIMIT, RESERVE)
    backlog.count(item(Rank.FRAME))
    assert backlog.dropped == {(0, "video.front"): 1}


@given(st.lists(st.one_of(items, st.integers(1, 400), st.just("back")), max_size=60))
def test_nothing_is_lost_uncounted_reordered_or_beyond_the_bound(steps: list[tuple[Rank, int] | int | str]) -> None:
    backlog = Backlog(LIMIT, RESERVE)
    offered: Counter[str] = Counter()
    written: list[int] = []
    taken: list[Item] = []
    for number, step in enumerate(steps):
        if isinstance(step, tuple):
            rank, size = step
            backlog.put(item(rank, number, size))
            offered[CHANNELS[rank]] += 1
        elif isinstance(step, int):
            written += numbers(taken)
            taken = backlog.take(step)
        else:
            backlog.put_back(taken)
            taken = []
        assert backlog.size <= LIMIT + RESERVE
    written += numbers(taken) + numbers(backlog.take(10**9))
    assert written == sorted(set(written))
    assert len(written) + sum(backlog.dropped.values()) == sum(offered.values())


@pytest.mark.parametrize("rank", list(Rank))
def test_an_item_larger_than_everything(rank: Rank) -> None:
    backlog = Backlog(LIMIT, RESERVE)
    backlog.put(item(rank, size=LIMIT + RESERVE + 1))
    assert backlog.take(1) == []
    assert backlog.dropped == {(0, CHANNELS[rank]): 1}
