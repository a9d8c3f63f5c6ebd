"""Which pictures of a stream can be decoded."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages.encoded import Chain


def test_a_chain_begins_at_a_key_and_breaks_at_a_gap() -> None:
    chain = Chain()
    came = [(1, False), (2, True), (3, False), (4, False), (6, False), (7, False), (9, True), (10, False)]
    assert [number for number, key in came if chain.follows(number, key=key)] == [2, 3, 4, 9, 10]
    assert not chain.follows(10, key=False)  # a second time
    assert chain.follows(11, key=False)
    chain.restart()
    assert not chain.follows(12, key=False)
    assert chain.follows(13, key=True)
    assert chain.follows(1, key=True)  # whoever counts them began anew


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=40))
def test_whatever_is_lost_each_picture_that_follows_has_all_since_its_key(sent: list[tuple[bool, bool]]) -> None:
    chain = Chain()
    kept = {number for number, (key, lost) in enumerate(sent) if not lost and chain.follows(number, key=key)}
    for number in kept:
        since = number
        while not sent[since][0]:
            since -= 1
            assert since in kept
    assert {number for number, (key, lost) in enumerate(sent) if key and not lost} <= kept
