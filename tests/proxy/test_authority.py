"""The authority: tables of the rules, and properties over random histories."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.proxy.core.authority import (
    Asked,
    Authority,
    Declined,
    Effect,
    Expired,
    Granted,
    Lost,
    Preempted,
    Queued,
    Withdrawn,
)

S = NS_PER_S


def test_the_first_request_gets_lease_one() -> None:
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
    moved_up = [Queued(3, 16, 1), Queued(4, 20, 2)]
    assert authority.release(1, 0) == [Lost(1, 1, "released"), Granted(2, 16, 2), *moved_up]
    assert authority.gone(2, 0) == [Lost(2, 2, "gone"), Granted(3, 16, 3), Queued(4, 20, 1)]


def test_a_higher_priority_takes_over_at_once_and_the_loser_waits_on() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0)
    in_line = [Queued(1, 16, 1), Queued(2, 16, 2)]
    assert authority.request(3, 4, True, 5) == [Preempted(1, 1, 3, 4), Granted(3, 4, 2), *in_line]
    assert [claim.app_id for claim in authority.waiting] == [1, 2]  # it arrived before the other one of its priority
    assert authority.release(3, 6) == [Lost(3, 2, "released"), Granted(1, 16, 3), Queued(2, 16, 1)]


def test_a_request_that_does_not_wait_is_refused() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    assert authority.request(2, 16, False, 0) == []
    assert authority.position(2) == 0
    assert authority.request(2, 15, False, 0) == [Preempted(1, 1, 2, 15), Granted(2, 15, 2), Queued(1, 16, 1)]


def test_a_waiting_application_that_no_longer_waits_leaves_the_queue() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0)
    assert authority.request(2, 16, False, 0) == []
    assert authority.waiting == ()


def test_another_request_of_the_holder_changes_its_priority() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 10, True, 0)  # takes over
    authority.request(2, 5, True, 0)
    assert authority.holder is not None
    assert (authority.holder.priority, authority.lease) == (5, 2)
    assert authority.request(2, 20, True, 0) == [Preempted(2, 2, 1, 16), Granted(1, 16, 3), Queued(2, 20, 1)]
    assert authority.position(2) == 1


def test_a_waiting_application_takes_over_with_a_higher_priority() -> None:
    authority = Authority()
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0)
    assert authority.request(2, 3, True, 0) == [Preempted(1, 1, 2, 3), Granted(2, 3, 2), Queued(1, 16, 1)]


def test_leaving_the_queue_takes_nothing_from_the_holder() -> None:
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
    assert authority.update(12 * S - 1) == []
    authority.last_command_ns = 11 * S
    assert authority.update(13 * S - 1) == []
    assert authority.update(13 * S) == [Lost(1, 1, "silent"), Granted(2, 20, 2)]
    assert authority.position(1) == 0  # silent ones do not stay in the queue
    assert authority.update(15 * S - 1) == []  # the grant counts as a sign of life


def test_without_a_holder_no_one_is_silent() -> None:
    assert Authority().update(100 * S) == []


def test_a_silent_holder_stays_listed_until_the_next_request() -> None:
    authority = Authority(timeout_s=2.0)
    authority.request(1, 4, True, 0)
    assert authority.update(2 * S) == [Lost(1, 1, "silent")]
    assert authority.holder is None
    assert authority.lease == 0
    assert authority.owner is not None
    assert (authority.owner.app_id, authority.owner.priority) == (1, 4)
    assert authority.update(9 * S) == []
    assert authority.request(2, 31, False, 9 * S) == [Granted(2, 31, 2)]  # of any priority
    assert authority.owner is authority.holder
    assert authority.position(1) == 0


def test_a_silent_holder_that_is_back_must_request_again() -> None:
    authority = Authority(timeout_s=2.0)
    authority.request(1, 4, True, 0)
    authority.update(2 * S)
    assert authority.request(1, 4, True, 3 * S) == [Granted(1, 4, 2)]
    assert authority.silent is None


def test_a_silent_holder_that_releases_or_is_gone_is_not_listed() -> None:
    for end in (Authority.release, Authority.gone):
        authority = Authority(timeout_s=2.0)
        authority.request(1, 4, True, 0)
        authority.update(2 * S)
        assert end(authority, 1, 3 * S) == []
        assert authority.owner is None


def test_the_first_in_the_queue_follows_a_silent_holder_at_once() -> None:
    authority = Authority(timeout_s=2.0)
    authority.request(1, 4, True, 0)
    authority.request(2, 9, True, 0)
    assert authority.update(2 * S) == [Lost(1, 1, "silent"), Granted(2, 9, 2)]
    assert authority.silent is None


# For a time ------------------------------------------------------------------------------------------------------


def test_a_holder_whose_time_is_over_is_notified_once_and_keeps_it_while_no_one_waits() -> None:
    authority = Authority(timeout_s=1000.0)
    assert authority.request(1, 16, True, 0, term_ns=60 * S) == [Granted(1, 16, 1, 60 * S)]
    assert authority.update(60 * S - 1) == []
    assert authority.update(60 * S) == [Expired(1, 1)]
    assert authority.update(61 * S) == []
    assert authority.request(2, 31, True, 70 * S) == [Lost(1, 1, "expired"), Granted(2, 31, 2)]
    assert authority.position(1) == 0


def test_the_first_in_the_queue_follows_when_the_holders_time_is_over_whatever_the_priorities() -> None:
    authority = Authority(timeout_s=1000.0)
    authority.request(1, 0, True, 0, term_ns=60 * S)
    assert authority.request(2, 16, True, 10 * S) == [Queued(2, 16, 1, 50 * S)]
    assert authority.update(60 * S) == [Lost(1, 1, "expired"), Granted(2, 16, 2)]


def test_a_higher_priority_takes_over_within_the_time_and_the_rest_of_it_stays() -> None:
    authority = Authority(timeout_s=1000.0)
    authority.request(1, 16, True, 0, term_ns=60 * S)
    assert authority.request(2, 4, True, 20 * S) == [Preempted(1, 1, 2, 4), Granted(2, 4, 2), Queued(1, 16, 1)]
    assert authority.release(2, 30 * S) == [Lost(2, 2, "released"), Granted(1, 16, 3, 70 * S)]


def test_a_holder_can_extend_its_time_only_while_no_one_waits() -> None:
    authority = Authority(timeout_s=1000.0)
    authority.request(1, 16, True, 0, term_ns=60 * S)
    authority.request(1, 16, True, 10 * S, term_ns=100 * S)
    assert authority.until_ns == 110 * S
    authority.request(1, 12, True, 11 * S)  # without a time
    assert authority.until_ns == 110 * S
    authority.request(2, 16, True, 20 * S)
    authority.request(1, 16, True, 30 * S, term_ns=100 * S)
    assert authority.until_ns == 110 * S
    authority.request(1, 16, True, 30 * S, term_ns=10 * S)
    assert authority.update(40 * S) == [Lost(1, 1, "expired"), Granted(2, 16, 2)]


def test_an_extended_time_is_reported_again_when_it_is_over() -> None:
    authority = Authority(timeout_s=1000.0)
    authority.request(1, 16, True, 0, term_ns=10 * S)
    assert authority.update(10 * S) == [Expired(1, 1)]
    authority.request(1, 16, True, 11 * S, term_ns=10 * S)
    assert authority.update(21 * S) == [Expired(1, 1)]


def test_the_expected_wait_follows_from_the_requested_times() -> None:
    authority = Authority(timeout_s=1000.0)
    assert authority.wait_ns(1, 0) is None
    authority.request(1, 16, True, 0, term_ns=60 * S)
    assert authority.request(2, 16, True, 20 * S, term_ns=30 * S) == [Queued(2, 16, 1, 40 * S)]
    assert authority.request(3, 16, True, 20 * S) == [Queued(3, 16, 2, 70 * S)]
    assert authority.request(4, 16, True, 20 * S) == [Queued(4, 16, 3)]  # the one before it gave no time
    assert authority.wait_ns(9, 20 * S) is None
    assert authority.release(2, 25 * S) == [Queued(3, 16, 1, 35 * S), Queued(4, 16, 2)]
    authority.release(1, 25 * S)
    assert authority.wait_ns(4, 25 * S) is None  # the holder gave no time


# Asking first ----------------------------------------------------------------------------------------------------


def test_a_holder_that_does_not_answer_keeps_it_until_the_time_to_ask_is_over() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    asked = Asked(1, 1, 2, 4, 15 * S, 60 * S)
    assert authority.request(2, 4, True, 5 * S, term_ns=60 * S, ask=True) == [Queued(2, 4, 1, 10 * S), asked]
    assert authority.asking(2, 5 * S)
    assert authority.update(15 * S - 1) == []
    took_over = [Preempted(1, 1, 2, 4), Granted(2, 4, 2, 75 * S), Queued(1, 16, 1, 60 * S)]
    assert authority.update(15 * S) == took_over
    assert not authority.asking(2, 15 * S)


def test_asking_twice_is_asking_once() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    authority.request(2, 4, True, 5 * S, ask=True)
    assert authority.request(2, 4, True, 6 * S, ask=True) == [Queued(2, 4, 1, 9 * S)]
    assert authority.update(15 * S)[0] == Preempted(1, 1, 2, 4)


def test_a_request_that_stops_asking_takes_over() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    authority.request(2, 4, True, 0, ask=True)
    assert authority.request(2, 4, True, 1 * S)[:2] == [Preempted(1, 1, 2, 4), Granted(2, 4, 2)]


def test_a_holder_grants_and_waits_to_get_it_back() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    authority.request(2, 4, True, 0, ask=True)
    handed_over = [Preempted(1, 1, 2, 4, granted=True), Granted(2, 4, 2), Queued(1, 16, 1)]
    assert authority.answer(1, 1, 2, True, "", 3 * S) == handed_over
    assert authority.release(2, 5 * S) == [Lost(2, 2, "released"), Granted(1, 16, 3)]


def test_a_holder_that_grants_to_a_lower_priority_does_not_take_it_back_at_once() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 4, True, 0)
    assert authority.request(2, 16, True, 0, ask=True) == [Queued(2, 16, 1), Asked(1, 1, 2, 16, 10 * S)]
    granted = authority.answer(1, 1, 2, True, "", 3 * S)
    assert granted == [Preempted(1, 1, 2, 16, granted=True), Granted(2, 16, 2), Queued(1, 16, 1)]
    assert authority.update(4 * S) == []


def test_an_equal_or_lower_priority_may_ask_and_waits_without_an_answer() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    authority.request(2, 16, True, 0, ask=True)
    assert authority.update(10 * S) == []
    assert authority.position(2) == 1
    assert authority.request(2, 16, True, 11 * S, ask=True)[-1] == Asked(1, 1, 2, 16, 21 * S)  # asked again


def test_a_holder_declines_and_the_higher_priority_still_wins() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    authority.request(2, 4, True, 0, ask=True)
    assert authority.answer(1, 1, 2, False, "landing", 1 * S) == [Declined(2, 1, "landing")]
    assert authority.update(10 * S - 1) == []
    assert authority.update(10 * S)[0] == Preempted(1, 1, 2, 4)


def test_outdated_answers_change_nothing() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    assert authority.answer(1, 0, 2, True, "", 0) == []
    authority.request(1, 16, True, 0)
    authority.request(2, 4, True, 0, ask=True)
    authority.request(3, 31, True, 0)
    assert authority.answer(3, 1, 2, True, "", 0) == []  # not the holder
    assert authority.answer(1, 9, 2, True, "", 0) == []  # under another lease
    assert authority.answer(1, 1, 3, True, "", 0) == []  # has not asked
    assert authority.answer(1, 1, 7, True, "", 0) == []  # unknown
    assert authority.lease == 1


def test_the_holder_is_notified_when_a_request_ends() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    for leave in (authority.release, authority.gone):
        authority.request(2, 4, True, 0, ask=True)
        assert leave(2, 1 * S) == [Withdrawn(1, 1, 2)]
    authority.request(2, 16, True, 0, ask=True)
    assert authority.request(2, 16, True, 1 * S) == [Queued(2, 16, 1), Withdrawn(1, 1, 2)]  # waits without asking
    assert authority.release(2, 2 * S) == []
    authority.request(2, 16, True, 2 * S, ask=True)
    assert authority.release(2, 12 * S) == []  # its time to answer the request has passed


def test_granting_to_a_non_asking_application_hands_over_to_the_first_in_the_queue() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    authority.request(2, 2, True, 0, ask=True)
    effects = authority.request(3, 4, True, 1 * S)
    assert effects[:2] == [Preempted(1, 1, 2, 2), Granted(2, 2, 2)]
    assert [claim.app_id for claim in authority.waiting] == [3, 1]


def test_a_takeover_without_queueing_leaves_nothing_in_the_queue() -> None:
    authority = Authority(timeout_s=1000.0, ask_s=10.0)
    authority.request(1, 16, True, 0)
    authority.request(2, 2, True, 0, ask=True)
    effects = authority.request(3, 4, False, 1 * S)
    assert effects == [Preempted(1, 1, 2, 2), Granted(2, 2, 2), Queued(1, 16, 1)]
    assert authority.position(3) == 0


def test_a_holder_whose_time_is_over_waits_like_all_others() -> None:
    authority = Authority(timeout_s=1000.0)
    authority.request(1, 16, True, 0, term_ns=S)
    authority.request(2, 16, True, 0)
    assert authority.request(1, 16, True, 2 * S) == [Lost(1, 1, "expired"), Granted(2, 16, 2), Queued(1, 16, 1)]


# Any history -----------------------------------------------------------------------------------------------------

TERMS = st.sampled_from([None, None, S // 2, 2 * S, 5 * S])
steps = st.lists(
    st.tuples(
        st.sampled_from(
            ["request", "request", "polite", "try", "release", "gone", "tick", "tick", "heard", "grant", "decline"]
        ),
        st.integers(1, 5),
        st.integers(0, 31),
        st.integers(0, S),
        TERMS,
    ),
    max_size=80,
)


def step(authority: Authority, what: str, app: int, priority: int, now: int, term: int | None) -> list[Effect]:
    if what in ("request", "polite", "try"):
        return authority.request(app, priority, what != "try", now, term_ns=term, ask=what == "polite")
    if what == "release":
        return authority.release(app, now)
    if what == "gone":
        return authority.gone(app, now)
    if what in ("grant", "decline"):
        holder = authority.holder.app_id if authority.holder is not None else 0
        return authority.answer(holder, authority.lease, app, what == "grant", "", now)
    if what == "heard":
        authority.last_command_ns = now
        return []
    return authority.update(now)


@given(steps)
def test_any_history_keeps_the_rules(history: list[tuple[str, int, int, int, int | None]]) -> None:
    authority = Authority(timeout_s=2.0, ask_s=1.5)
    now, last_lease, in_force = 0, 0, 0
    places: dict[int, int] = {}
    for what, app, priority, later, term in history:
        now += later
        held_before = authority.holder is not None and authority.holder.app_id == app
        effects = step(authority, what, app, priority, now, term)
        for effect in effects:
            if isinstance(effect, Granted):
                assert in_force == 0, "two holders at once"
                assert effect.lease == last_lease + 1, "a lease was skipped or used twice"
                last_lease = in_force = effect.lease
                places.pop(effect.app_id, None)
            if isinstance(effect, Lost | Preempted):
                assert effect.lease == in_force
                in_force = 0
            if isinstance(effect, Preempted) and not effect.granted:
                assert effect.by_id != effect.app_id
            if isinstance(effect, Queued):
                places[effect.app_id] = effect.position
                assert effect.wait_ns is None or effect.wait_ns >= 0
        waiting = authority.waiting
        assert list(waiting) == sorted(waiting)
        assert len({claim.app_id for claim in waiting}) == len(waiting)
        assert authority.lease == in_force
        told = {app_id: place for app_id, place in places.items() if authority.position(app_id)}
        assert told == {claim.app_id: place for place, claim in enumerate(waiting, 1)}, "a position was not reported"
        holder = authority.holder
        if holder is None:
            assert not waiting, "someone waits although there is no holder"
        else:
            assert authority.silent is None
            assert holder.app_id not in {claim.app_id for claim in waiting}
            higher = [claim for claim in waiting if claim.priority < holder.priority]
            if what in ("request", "polite", "try", "release", "gone", "tick"):
                assert all(claim.asks(now) for claim in higher), "a higher priority waits without asking"
                assert authority.until_ns is None or authority.until_ns > now or not waiting, (
                    "its time is over, and others wait"
                )
        if what in ("request", "polite"):
            holds = holder is not None and holder.app_id == app
            assert holds or authority.position(app) > 0
        if what == "try" and not held_before:
            assert authority.position(app) == 0


@given(steps, st.integers(0, 31))
def test_each_waiting_application_gets_it_when_all_others_are_gone(
    history: list[tuple[str, int, int, int, int | None]], priority: int
) -> None:
    authority = Authority(timeout_s=2.0, ask_s=1.5)
    now = 0
    for what, app, other_priority, later, term in history:
        now += later
        step(authority, what, app, other_priority, now, term)
    authority.request(9, priority, True, now)
    for app in range(1, 6):
        authority.gone(app, now)
    assert authority.holder is not None
    assert authority.holder.app_id == 9
