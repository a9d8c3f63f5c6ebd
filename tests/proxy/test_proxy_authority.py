"""The authority among several applications at one proxy."""

from __future__ import annotations

from skyloop.messages import (
    AnswerTakeover,
    AuthorityGranted,
    AuthorityQueued,
    Done,
    EventKind,
    FlightState,
    Hover,
    Idle,
    Land,
    Refusal,
    Refused,
    ReleaseAuthority,
    RequestAuthority,
    Role,
    Takeover,
    Velocity,
)
from tests.support.proxy_bench import Bench


def test_two_pilots_and_three_observers(bench: Bench) -> None:
    alice = bench.airborne("alice", 16)
    bob = bench.join("bob")
    observers = [bench.join(f"observer {number}", Role.OBSERVER) for number in range(3)]
    old_lease = alice.lease

    alice.command(Velocity(0.5))
    assert bench.driver.told == [Velocity(0.5)]
    for observer in observers:
        observer.lease = old_lease
        observer.command(Velocity(9.0))
        assert observer.refusals() == [Refusal.OBSERVER]
    bob.lease = old_lease  # the right number from the wrong application
    bob.command(Velocity(9.0))
    assert bob.told(EventKind.COMMAND_REFUSED)[-1].data["reason"] == Refusal.NO_AUTHORITY
    assert bench.driver.told == [Velocity(0.5)]

    bob.take_authority(4)
    assert bench.driver.told == [Velocity(0.5), Hover()]  # with a hover before the new pilot
    assert bob.lease > old_lease
    for app in (alice, *observers):
        (preempted,) = app.told(EventKind.AUTHORITY_PREEMPTED)
        assert preempted.app == "alice"
        assert preempted.data == {"app_id": 1, "lease": 1, "by": "bob", "by_id": 2, "by_priority": 4, "granted": False}
        bench.tick()
        feedback = app.last_feedback()
        assert (feedback.owner, feedback.owner_id, feedback.owner_priority) == ("bob", bob.app_id, 4)
        assert feedback.lease == bob.lease

    alice.command(Velocity(7.0))
    assert Refusal.FOREIGN_LEASE in alice.refusals()
    bob.command(Velocity(left=0.5))
    assert bench.driver.told[2:] == [Velocity(left=0.5)]

    assert bob.ask(ReleaseAuthority()) == Done()
    granted = alice.told(EventKind.AUTHORITY_GRANTED)[-1]  # the pre-empted one was waiting in the queue
    assert granted.data["app_id"] == alice.app_id
    assert bench.driver.told[3:] == [Hover()]
    alice.command(Velocity(7.0), repeat=True)  # under the old lease, not even now
    alice.lease = int(granted.data["lease"])  # type: ignore[arg-type]
    alice.command(Velocity(7.0), repeat=True)  # nor a request from the old lease
    assert bench.driver.told[3:] == [Hover()]
    alice.command(Velocity(0.25))
    assert bench.driver.told[4:] == [Velocity(0.25)]


def test_the_answers_to_requests(bench: Bench) -> None:
    alice, bob, observer = bench.join("alice"), bench.join("bob"), bench.join("eve", Role.OBSERVER)
    assert alice.ask(RequestAuthority(10)) == AuthorityGranted(1)
    assert alice.ask(RequestAuthority(12)) == AuthorityGranted(1)  # its priority changes
    bench.tick()
    assert alice.last_feedback().owner_priority == 12
    assert bob.ask(RequestAuthority(12)) == AuthorityQueued(1, "alice", 12)
    refused = bob.ask(RequestAuthority(12, queue=False))
    assert isinstance(refused, Refused)
    assert refused.code is Refusal.BUSY
    assert "alice" in refused.message
    assert "12" in refused.message
    refused = observer.ask(RequestAuthority(0))
    assert isinstance(refused, Refused)
    assert refused.code is Refusal.OBSERVER


def test_a_silent_holder_loses_the_lease_and_an_idle_one_keeps_it(bench: Bench) -> None:
    alice, bob = bench.pilot("alice"), bench.join("bob")
    bench.run(5.0, lambda: alice.command(Idle(), repeat=True))
    assert alice.told(EventKind.AUTHORITY_LOST) == []
    bob.ask(RequestAuthority(20))
    bench.run(1.98)
    assert bob.told(EventKind.AUTHORITY_LOST) == []
    bench.run(0.04)
    (lost,) = bob.told(EventKind.AUTHORITY_LOST)
    assert (lost.app, lost.data["reason"], lost.data["by"]) == ("alice", "silent", "bob")
    assert bob.last_feedback().owner == "bob"


def test_refused_repeats_after_a_failsafe_keep_the_lease(bench: Bench) -> None:
    alice = bench.airborne()
    alice.command(Velocity(0.5))
    bench.run(0.6)
    bench.run(4.0, lambda: alice.command(Velocity(0.5), repeat=True))
    assert set(alice.refusals()) == {Refusal.NOT_FRESH}
    assert alice.told(EventKind.AUTHORITY_LOST) == []
    assert bench.driver.told == [Velocity(0.5), Hover()]


def test_the_next_in_the_queue_follows_a_dead_holder(bench: Bench) -> None:
    alice, bob = bench.airborne("alice"), bench.join("bob")
    bob.ask(RequestAuthority(20))
    alice.command(Velocity(0.5))
    alice.end.close()
    bob.sync()
    (lost,) = bob.told(EventKind.AUTHORITY_LOST)
    assert lost.data["reason"] == "gone"
    assert bob.told(EventKind.AUTHORITY_GRANTED)[-1].data["app_id"] == bob.app_id
    assert bench.driver.told == [Velocity(0.5), Hover()]
    left = bob.told(EventKind.APPLICATION_LINK)[-1]
    assert (left.app, left.data["state"]) == ("alice", "lost")


def test_a_landing_is_not_aborted_by_a_takeover(bench: Bench) -> None:
    alice, bob = bench.airborne("alice"), bench.join("bob")
    alice.command(Land())
    bob.take_authority(0)
    bench.run(0.2)
    assert bench.driver.told == [Land()]
    bob.command(Hover())
    assert bench.driver.told == [Land(), Hover()]


def test_a_rejected_hover_at_a_takeover_is_retried(bench: Bench) -> None:
    alice, bob = bench.airborne("alice"), bench.join("bob")
    alice.command(Velocity(0.5))
    bench.driver.fail = {"apply"}
    bob.take_authority(0)
    assert bench.driver.told == [Velocity(0.5)]
    assert bob.told(EventKind.DRIVER_ERROR)
    bench.driver.fail = set()
    bench.run(0.3)
    assert bench.driver.told == [Velocity(0.5), Hover()]


def test_a_takeover_on_the_ground_sends_the_vehicle_nothing(bench: Bench) -> None:
    bench.pilot("alice")
    bench.pilot("bob", 0)
    bench.run(1.0)
    assert bench.driver.told == []
    assert bench.proxy.handler._executor.state is FlightState.LANDED


def test_a_silent_holder_stays_listed_while_its_vehicle_fails_safe(bench: Bench) -> None:
    alice, bob = bench.airborne("alice", 4), bench.join("bob")
    alice.command(Velocity(0.5))
    bench.run(2.1)
    (lost,) = bob.told(EventKind.AUTHORITY_LOST)
    assert (lost.app, lost.data["reason"], lost.data["by"]) == ("alice", "silent", "")
    assert "until another application requests it" in lost.text
    feedback = bob.last_feedback()
    assert (feedback.owner, feedback.owner_id, feedback.owner_priority) == ("alice", alice.app_id, 4)
    assert (feedback.lease, feedback.failsafe) == (0, "hover")
    alice.command(Velocity(0.7))
    assert alice.refusals()[-1] == Refusal.FOREIGN_LEASE
    assert bench.driver.told == [Velocity(0.5), Hover()]
    bench.run(3.0)
    assert bench.driver.told == [Velocity(0.5), Hover(), Land()]
    assert bob.last_feedback().owner == "alice"

    assert bob.ask(RequestAuthority(31)) == AuthorityGranted(2)
    bench.tick()
    assert bob.last_feedback().owner == "bob"
    assert bob.told(EventKind.AUTHORITY_PREEMPTED) == []


def test_the_listing_of_a_silent_holder_ends_with_its_connection(bench: Bench) -> None:
    alice, bob = bench.pilot("alice"), bench.join("bob")
    bench.run(2.1)
    assert bob.last_feedback().owner == "alice"
    alice.end.close()
    bob.sync()
    bench.tick()
    assert bob.last_feedback().owner is None


def test_a_queue_of_requests_with_times(bench: Bench) -> None:
    alice, bob, carol = bench.airborne("alice"), bench.join("bob"), bench.join("carol")
    now_ns = bench.clock()
    assert alice.ask(RequestAuthority(for_s=60.0)) == AuthorityGranted(alice.lease, now_ns + 60 * 10**9)
    assert bob.ask(RequestAuthority(for_s=30.0)) == AuthorityQueued(1, "alice", 16, 60.0)
    assert carol.ask(RequestAuthority()) == AuthorityQueued(2, "alice", 16, 90.0)
    queued = carol.told(EventKind.AUTHORITY_QUEUED)[-1]
    assert (queued.app, queued.data["position"], queued.data["wait_s"]) == ("carol", 2, 90.0)
    bench.run(59.9, lambda: alice.command(Idle(), repeat=True))
    assert carol.told(EventKind.AUTHORITY_LOST) == []
    alice.command(Velocity(0.5))
    bench.run(0.2)
    (lost,) = carol.told(EventKind.AUTHORITY_LOST)
    assert (lost.app, lost.data["reason"], lost.data["by"]) == ("alice", "expired", "bob")
    granted = carol.told(EventKind.AUTHORITY_GRANTED)[-1]
    assert (granted.app, granted.data["until_ns"]) == ("bob", bench.clock() + 30 * 10**9 - 100_000_000)
    assert "for 30 s" in granted.text
    assert bench.driver.told == [Velocity(0.5), Hover()]
    moved = carol.told(EventKind.AUTHORITY_QUEUED)[-1]
    assert (moved.app, moved.data["position"], moved.data["wait_s"]) == ("carol", 1, 30.0)


def test_a_holder_whose_time_is_over_is_notified_and_continues(bench: Bench) -> None:
    alice = bench.pilot("alice")
    alice.ask(RequestAuthority(for_s=1.0))
    bench.run(1.5, lambda: alice.command(Idle(), repeat=True))
    (expired,) = alice.told(EventKind.AUTHORITY_EXPIRED)
    assert expired.data == {"app_id": alice.app_id, "lease": alice.lease}
    assert alice.last_feedback().lease == alice.lease


def test_a_holder_is_asked_and_hands_over(bench: Bench) -> None:
    alice, bob = bench.airborne("alice"), bench.join("bob")
    alice.command(Velocity(0.5))
    request = RequestAuthority(4, for_s=20.0, takeover=Takeover.ASK)
    assert bob.ask(request) == AuthorityQueued(1, "alice", 16, 10.0, True)
    (asked,) = alice.told(EventKind.AUTHORITY_ASKED)
    assert asked.data == {
        "app_id": alice.app_id,
        "lease": alice.lease,
        "by": "bob",
        "by_id": bob.app_id,
        "by_priority": 4,
        "within_s": 10.0,
        "for_s": 20.0,
    }
    assert bench.driver.told == [Velocity(0.5)]
    assert alice.ask(AnswerTakeover(alice.lease, bob.app_id, False, "landing")) == Done()
    (declined,) = bob.told(EventKind.AUTHORITY_DECLINED)
    assert (declined.app, declined.data["by"], declined.data["reason"]) == ("bob", "alice", "landing")
    assert "landing" in declined.text
    assert alice.ask(AnswerTakeover(alice.lease, bob.app_id, True)) == Done()
    (handed,) = bob.told(EventKind.AUTHORITY_PREEMPTED)
    assert (handed.app, handed.data["by"], handed.data["granted"]) == ("alice", "bob", True)
    assert bench.driver.told == [Velocity(0.5), Hover()]
    bench.tick()
    assert (bob.last_feedback().owner, bob.last_feedback().next_owner) == ("bob", "alice")
    assert bob.told(EventKind.AUTHORITY_GRANTED)[-1].data["identity"] == "this process"
    assert alice.told(EventKind.AUTHORITY_QUEUED)[-1].data["position"] == 1


def test_feedback_says_who_is_next_until_that_one_leaves_the_queue(bench: Bench) -> None:
    alice, bob, carl = bench.pilot("alice"), bench.join("bob"), bench.join("carl")
    bench.tick()
    assert alice.last_feedback().next_owner is None
    bob.ask(RequestAuthority(16, queue=True))
    carl.ask(RequestAuthority(20, queue=True))
    bench.tick()
    assert alice.last_feedback().next_owner == "bob"
    bob.ask(ReleaseAuthority())  # which causes no event
    bench.tick()
    assert alice.last_feedback().next_owner == "carl"


def test_a_holder_that_does_not_answer_is_pre_empted_after_the_time_to_ask(bench: Bench) -> None:
    alice, bob = bench.pilot("alice"), bench.join("bob")
    bob.ask(RequestAuthority(4, takeover=Takeover.ASK))
    bench.run(9.9, lambda: alice.command(Idle(), repeat=True))
    assert bob.told(EventKind.AUTHORITY_PREEMPTED) == []
    bench.run(0.2, lambda: alice.command(Idle(), repeat=True))
    (preempted,) = bob.told(EventKind.AUTHORITY_PREEMPTED)
    assert preempted.data["granted"] is False


def test_a_holder_is_notified_when_a_request_leaves_the_queue(bench: Bench) -> None:
    alice, bob = bench.pilot("alice"), bench.join("bob")
    bob.ask(RequestAuthority(4, takeover=Takeover.ASK))
    bob.ask(ReleaseAuthority())
    (withdrawn,) = alice.told(EventKind.AUTHORITY_WITHDRAWN)
    assert withdrawn.data == {"app_id": alice.app_id, "lease": alice.lease, "by": "bob", "by_id": bob.app_id}
    assert withdrawn.text == "bob no longer asks alice to hand over the authority"


def test_a_request_that_does_not_wait_can_not_ask_first(bench: Bench) -> None:
    bench.pilot("alice")
    bob = bench.join("bob")
    refused = bob.ask(RequestAuthority(4, queue=False, takeover=Takeover.ASK))
    assert isinstance(refused, Refused)
    assert refused.code is Refusal.BUSY
    assert bob.told(EventKind.AUTHORITY_ASKED) == []


def test_only_the_holder_answers(bench: Bench) -> None:
    alice, bob, carol = bench.pilot("alice"), bench.join("bob"), bench.join("carol")
    bob.ask(RequestAuthority(4, takeover=Takeover.ASK))
    refused = carol.ask(AnswerTakeover(alice.lease, bob.app_id, True))
    assert isinstance(refused, Refused)
    assert refused.code is Refusal.FOREIGN_LEASE
    assert bob.told(EventKind.AUTHORITY_PREEMPTED) == []
