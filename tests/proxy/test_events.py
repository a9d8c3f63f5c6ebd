"""Repeated events: the first is published at once, the others as sums, and nothing is kept forever."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.messages import EventKind
from skyloop.proxy.events import EventDraft, RepeatedEvents

S = NS_PER_S
DRAFT = EventDraft(EventKind.COMMAND_REFUSED, "no")


def note(repeats: RepeatedEvents, key: str, now_ns: int) -> bool:
    first = repeats.first(key, lambda: DRAFT)
    if first:
        repeats.begin(key, lambda: DRAFT, now_ns)
    return first


def test_the_first_is_published_and_the_rest_summed() -> None:
    repeats = RepeatedEvents()
    assert note(repeats, "a", 0)
    assert not note(repeats, "a", 1)
    assert not note(repeats, "a", 2)
    assert note(repeats, "b", 2)  # another key has its own count
    assert repeats.due(S - 1) == []
    assert repeats.due(S) == [(DRAFT, 2)]
    assert not note(repeats, "a", S + 1)
    assert repeats.due(2 * S) == [(DRAFT, 1)]
    assert repeats.due(3 * S) == []
    assert note(repeats, "a", 3 * S + 1)


def test_a_sum_has_the_text_of_the_newest() -> None:
    repeats = RepeatedEvents()
    for number, why in enumerate(["not initialised", "gyros inconsistent", "no GPS fix"]):
        draft = EventDraft(EventKind.COMMAND_REFUSED, why)
        if repeats.first("a", lambda draft=draft: draft):  # type: ignore[misc]
            repeats.begin("a", lambda draft=draft: draft, number)  # type: ignore[misc]
    assert [draft.text for draft, _ in repeats.due(S)] == ["no GPS fix"]


def test_ended_repetitions_are_forgotten() -> None:
    repeats = RepeatedEvents()
    for number in range(1000):
        note(repeats, str(number), 0)
    repeats.due(S)
    assert repeats._published == {}
    assert repeats._counts == {}


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, S // 2)), max_size=80))
def test_every_event_is_counted_once(history: list[tuple[str, int]]) -> None:
    repeats = RepeatedEvents()
    now = told = 0
    for key, later in history:
        now += later
        told += sum(count for _, count in repeats.due(now))
        told += note(repeats, key, now)
    told += sum(count for _, count in repeats.due(now + S))
    assert told == len(history)
