"""Authority: tables of what the rules say, and properties over random histories."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.proxy.authority import Authority, Granted, Lost, Preempted, Queued

S = NS_PER_S


def test_the_first_to_ask_gets_lease_one() -> None:
    authority = Authority()
    assert authority.request(7, 16, True, 0) == [Granted(7, 16, 1)]
    assert authority.holder is not None
    assert (authority.holder.app_id, authority.lease) == (7, 1)


def test_leases_grow_for_ever() -> None:
    authority = Authority()
    for lease in range(1, 6):
        assert authority.request(1, 16, True, 0) == [Granted(1, 16, lease)]
        assert authority.release(1, 0) == [Lost(1, lease, "released")]
        assert authority.lease == 0


def test_equal_priority_waits_in_order_of_arrival() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    assert authority.request(2, 16, True, 0) == [Queued(2, 16, 1)]
    assert authority.request(3, 16, True, 0) == [Queued(3, 16, 2)]
    assert authority.request(4, 20, True, 0) == [Queued(4, 20, 3)]
    assert [authority.position(app) for app in (1, 2, 3, 4, 5)] == [0, 1, 2, 3, 0]
    assert authority.release(1, 0) == [Lost(1, 1, "released"), Granted(2, 16, 2)]
    assert authority.gone(2, 0) == [Lost(2, 2, "gone"), Granted(3, 16, 3)]


def test_a_higher_priority_takes_over_at_once_and_the_loser_waits_on() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0)
    assert authority.request(3, 4, True, 5) == [Preempted(1, 1, 3, 4), Granted(3, 4, 2)]
    assert [claim.app_id for claim in authority.waiting] == [1, 2]  # it arrived before the other one of its priority
    assert authority.release(3, 6) == [Lost(3, 2, "released"), Granted(1, 16, 3)]


def test_who_does_not_want_to_wait_is_refused() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    assert authority.request(2, 16, False, 0) == []
    assert authority.position(2) == 0
    assert authority.request(2, 15, False, 0) == [Preempted(1, 1, 2, 15), Granted(2, 15, 2)]


def test_who_waits_and_then_does_not_want_to_leaves_the_line() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0)
    assert authority.request(2, 16, False, 0) == []
    assert authority.waiting == ()


def test_a_holder_that_asks_again_changes_its_priority() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 10, True, 0)  # takes over
    authority.request(2, 5, True, 0)
    assert authority.holder is not None
    assert (authority.holder.priority, authority.lease) == (5, 2)
    assert authority.request(2, 20, True, 0) == [Preempted(2, 2, 1, 16), Granted(1, 16, 3)]
    assert authority.position(2) == 1


def test_who_waits_and_asks_again_with_a_higher_priority_takes_over() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0)
    assert authority.request(2, 3, True, 0) == [Preempted(1, 1, 2, 3), Granted(2, 3, 2)]


def test_leaving_the_line_takes_nothing_from_the_holder() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0)
    assert authority.release(2, 0) == []
    assert authority.release(9, 0) == []
    assert authority.lease == 1


def test_a_silent_holder_loses_the_lease_exactly_at_the_time_out() -> None:
    authority = Authority(timeout_s=2.0)
    authority.request(1, 16, True, 10 * S)
    authority.request(2, 20, True, 10 * S)
    assert authority.tick(12 * S - 1) == []
    authority.heard_ns = 11 * S
    assert authority.tick(13 * S - 1) == []
    assert authority.tick(13 * S) == [Lost(1, 1, "silent"), Granted(2, 20, 2)]
    assert authority.position(1) == 0  # silent ones do not wait on
    assert authority.tick(15 * S - 1) == []  # the grant counts as heard


def test_nobody_is_silent_when_nobody_holds_it() -> None:
    assert Authority().tick(100 * S) == []


steps = st.lists(
    st.tuples(
        st.sampled_from(["request", "request", "request", "ask", "release", "gone", "tick"]),
        st.integers(1, 5),
        st.integers(0, 31),
        st.integers(0, S),
    ),
    max_size=60,
)


@given(steps)
def test_any_history_keeps_the_rules(history: list[tuple[str, int, int, int]]) -> None:
    authority = Authority()
    now, last_lease = 0, 0
    for what, app, priority, later in history:
        now += later
        before = authority.holder
        if what in ("request", "ask"):
            effects = authority.request(app, priority, what == "request", now)
        elif what == "release":
            effects = authority.release(app, now)
        elif what == "gone":
            effects = authority.gone(app, now)
        else:
            effects = authority.tick(now)
        for effect in effects:
            if isinstance(effect, Granted):
                assert effect.lease == last_lease + 1
                last_lease = effect.lease
            if isinstance(effect, Preempted):
                assert before is not None
                assert effect.by_priority < max(before.priority, priority)
        waiting = authority.waiting
        assert list(waiting) == sorted(waiting)
        assert len({claim.app_id for claim in waiting}) == len(waiting)
        if authority.holder is None:
            assert not waiting  # nobody waits while nobody holds it
            assert authority.lease == 0
        else:
            assert authority.holder not in waiting
            assert authority.lease == last_lease
            assert all(claim.priority >= authority.holder.priority for claim in waiting)
        if what == "request" and effects is not None:
            holds = authority.holder is not None and authority.holder.app_id == app
            assert holds or authority.position(app) > 0
