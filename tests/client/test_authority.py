"""The authority, as known to an application."""

from __future__ import annotations

import pytest

from skyloop.client.authority import AuthorityTracker, EndedSessions
from skyloop.messages import Event, EventKind, Feedback, RequestAuthority, Value

NOW = 10_000_000_000
LATER = NOW + 2_000_000_000


def event(kind: EventKind, **data: Value) -> Event:
    return Event(kind, "", 0, data=data)


def owned(owner_id: int = 0, lease: int = 0, owner: str | None = None) -> Feedback:
    return Feedback(captured_ns=0, owner_id=owner_id, lease=lease, owner=owner)


@pytest.fixture
def authority() -> AuthorityTracker:
    authority = AuthorityTracker("me")
    authority.connected(3)
    authority.asked(RequestAuthority(16))
    return authority


@pytest.fixture
def held(authority: AuthorityTracker) -> AuthorityTracker:
    assert authority.granted(5, NOW)
    return authority


def test_granted_by_reply_event_or_feedback() -> None:
    for way in ("reply", "event", "feedback"):
        authority = AuthorityTracker("me")
        authority.connected(3)
        authority.asked(RequestAuthority(7))
        assert authority.pending
        changed = {
            "reply": lambda a=authority: a.granted(5, NOW),
            "event": lambda a=authority: a.event(event(EventKind.AUTHORITY_GRANTED, app_id=3, lease=5), NOW),
            "feedback": lambda a=authority: a.feedback(owned(3, 5, "me"), NOW),
        }[way]()
        assert changed
        assert not authority.pending
        status = authority.status
        assert (status.state, status.lease, status.priority, status.holder) == ("held", 5, 7, "me")
        assert not authority.granted(5, NOW), "a repeated grant changes nothing"


def test_an_unwanted_authority_is_not_taken_from_feedback() -> None:
    authority = AuthorityTracker("me")
    authority.connected(3)
    assert not authority.feedback(owned(3, 5, "me"), NOW)
    assert authority.status.state == "none"


def test_queue(authority: AuthorityTracker) -> None:
    assert authority.queued(2, "other")
    assert (authority.status.state, authority.status.holder, authority.status.position) == ("queued", "other", 2)
    assert authority.event(event(EventKind.AUTHORITY_QUEUED, app_id=3, position=1), NOW)
    assert authority.status.position == 1
    assert authority.feedback(owned(9, 6, "third"), NOW)
    assert authority.status.holder == "third"
    assert authority.event(event(EventKind.AUTHORITY_GRANTED, app_id=3, lease=7), NOW)
    assert authority.held


def test_others_events_do_not_matter(held: AuthorityTracker) -> None:
    assert not held.event(event(EventKind.AUTHORITY_LOST, app_id=4, lease=5, reason="gone"), NOW)
    assert not held.event(event(EventKind.AUTHORITY_GRANTED, app_id=4, lease=9), NOW)
    assert not held.event(event(EventKind.STATE_CHANGED, app_id=3), NOW)
    assert held.held


def test_pre_emption_by_event_and_by_feedback(held: AuthorityTracker) -> None:
    assert held.event(event(EventKind.AUTHORITY_PREEMPTED, app_id=3, lease=5, by="boss"), NOW)
    assert (held.status.state, held.status.holder, held.status.lease) == ("preempted", "boss", 0)
    assert held.granted(7, NOW)
    assert held.feedback(owned(9, 8, "boss"), NOW)
    assert held.status.state == "preempted"
    assert held.queued(1, "boss")
    assert held.status.state == "preempted", "still pre-empted, not just queued"


def test_a_late_report_of_an_old_lease_changes_nothing(held: AuthorityTracker) -> None:
    assert not held.event(event(EventKind.AUTHORITY_PREEMPTED, app_id=3, lease=4, by="boss"), NOW)
    held.event(event(EventKind.AUTHORITY_PREEMPTED, app_id=3, lease=5, by="boss"), NOW)
    assert not held.event(event(EventKind.AUTHORITY_GRANTED, app_id=3, lease=5), NOW)
    assert not held.feedback(owned(3, 5, "me"), NOW), "feedback from before the pre-emption"
    assert held.status.state == "preempted"


def test_feedback_from_before_the_grant_does_not_end_it(held: AuthorityTracker) -> None:
    assert not held.feedback(owned(), NOW + 1)
    assert not held.feedback(owned(9, 4, "before"), NOW + 1)
    assert held.held


def test_lost_by_silence(held: AuthorityTracker) -> None:
    assert held.feedback(owned(), LATER)
    assert held.status.state == "none"
    assert held.wanted, "it will be requested again"
    held.granted(6, LATER)
    assert held.event(event(EventKind.AUTHORITY_LOST, app_id=3, lease=6, reason="silent"), LATER)
    assert held.status.state == "none"


def test_loss_by_silence_with_the_event_lost_too(held: AuthorityTracker) -> None:
    kept = owned(3, 0, "me")  # the name stays on the vehicle, without a lease
    assert not held.feedback(kept, NOW + 1), "it may be from before the grant"
    assert held.feedback(kept, LATER)
    assert (held.status.state, held.wanted) == ("none", True)


def test_the_requested_time_and_the_expected_wait(authority: AuthorityTracker) -> None:
    assert authority.queued(2, "other", 40.0)
    assert authority.status.expected_wait_s == 40.0
    assert authority.event(event(EventKind.AUTHORITY_QUEUED, app_id=3, position=1, wait_s=10.0), NOW)
    assert (authority.status.position, authority.status.expected_wait_s) == (1, 10.0)
    assert authority.event(event(EventKind.AUTHORITY_GRANTED, app_id=3, lease=7, until_ns=99), NOW)
    assert authority.status.until_ns == 99
    assert not authority.granted(7, NOW), "a repeated grant without the time"
    assert authority.status.until_ns == 99


def test_after_its_time_is_over_it_is_not_requested_again(held: AuthorityTracker) -> None:
    assert held.event(event(EventKind.AUTHORITY_LOST, app_id=3, lease=5, reason="expired", by="other"), NOW)
    assert (held.status.state, held.wanted) == ("none", False)


def test_feedback_may_overtake_the_event_of_expiry(held: AuthorityTracker) -> None:
    """Shown as pre-empted, it would wait forever in a queue that it is not in."""
    assert held.feedback(owned(9, 6, "next"), NOW)
    assert held.status.state == "preempted"
    assert held.event(event(EventKind.AUTHORITY_LOST, app_id=3, lease=5, reason="expired", by="next"), NOW)
    assert (held.status.state, held.wanted) == ("none", False)


def test_feedback_may_overtake_the_event_of_silence(held: AuthorityTracker) -> None:
    assert held.feedback(owned(9, 6, "next"), NOW)
    assert held.event(event(EventKind.AUTHORITY_LOST, app_id=3, lease=5, reason="silent"), NOW)
    assert (held.status.state, held.wanted) == ("none", True), "it will be requested again"


def test_the_event_of_expiry_may_be_lost(authority: AuthorityTracker) -> None:
    authority.asked(RequestAuthority(for_s=1.0))
    authority.granted(7, NOW, until_ns=500)
    assert authority.feedback(Feedback(captured_ns=501, owner_id=9, lease=8, owner="next"), NOW)
    assert (authority.status.state, authority.wanted) == ("none", False)


def test_a_refusal_by_the_holder_is_remembered_until_the_next_request(authority: AuthorityTracker) -> None:
    assert not authority.event(Event(EventKind.AUTHORITY_DECLINED, "not yet", 0, data={"app_id": 4}), NOW)
    assert authority.declined == ""
    assert not authority.event(Event(EventKind.AUTHORITY_DECLINED, "not yet", 0, data={"app_id": 3}), NOW)
    assert authority.declined == "not yet"
    authority.asked(RequestAuthority())
    assert authority.declined == ""


def test_released_and_refused(held: AuthorityTracker) -> None:
    assert held.given_back()
    assert (held.status.state, held.wanted) == ("none", False)
    assert not held.given_back()


def test_a_new_connection_starts_over(held: AuthorityTracker) -> None:
    assert held.disconnected()
    assert (held.status.state, held.wanted, held.status.priority) == ("none", True, 16)
    held.connected(1)
    assert held.granted(1, LATER), "a restarted proxy counts its leases from 1"


def test_a_lost_link_is_not_an_answer(authority: AuthorityTracker) -> None:
    assert not authority.answered
    authority.disconnected()
    assert not authority.answered
    authority.connected(4)
    authority.asked(RequestAuthority(16))
    assert authority.granted(6, NOW)
    assert authority.answered


def test_an_earlier_session_is_recognised_by_its_number_in_the_same_run() -> None:
    ended = EndedSessions()
    earlier, authority = AuthorityTracker("me", ended), AuthorityTracker("me", ended)
    earlier.connected(3, run_id=70)
    earlier.disconnected()
    authority.connected(4, run_id=70)
    authority.asked(RequestAuthority(16))
    authority.queued(1, "me")
    assert not authority.settled  # whose it is, is still unknown
    assert not authority.behind_itself
    assert authority.feedback(owned(3, 5, "me"), NOW)
    assert authority.behind_itself
    assert not authority.settled
    assert authority.feedback(owned(9, 6, "me"), NOW), "another application of the same name"
    assert not authority.behind_itself
    assert authority.settled
    authority.disconnected()
    authority.connected(1, run_id=71)  # the proxy restarted, with new numbers
    authority.asked(RequestAuthority(16))
    authority.queued(1, "other")
    authority.feedback(owned(3, 1, "other"), NOW)
    assert not authority.behind_itself
    assert authority.settled


def test_the_oldest_ended_session_is_forgotten() -> None:
    ended = EndedSessions()
    for app_id in range(EndedSessions.MOST + 1):
        ended.add(7, app_id)
    assert (7, 0) not in ended
    assert (7, 1) in ended
    assert (7, EndedSessions.MOST) in ended
    assert (8, 1) not in ended


@pytest.mark.parametrize(
    ("reason", "state", "wanted"), [("expired", "none", False), ("silent", "none", True), ("gone", "none", True)]
)
def test_feedback_before_the_event_of_a_loss_does_not_make_it_a_takeover(
    held: AuthorityTracker, reason: str, state: str, wanted: bool
) -> None:
    """It showed "preempted" forever, and requested nothing any more."""
    assert held.feedback(owned(9, 6, "other"), NOW)
    assert held.status.state == "preempted"
    assert held.event(event(EventKind.AUTHORITY_LOST, app_id=3, lease=5, reason=reason, by="other"), LATER)
    assert (held.status.state, held.wanted) == (state, wanted)


def test_a_loss_of_an_older_lease_changes_no_takeover(held: AuthorityTracker) -> None:
    assert held.feedback(owned(9, 6, "other"), NOW)
    assert not held.event(event(EventKind.AUTHORITY_LOST, app_id=3, lease=4, reason="silent"), LATER)
    assert held.status.state == "preempted"
