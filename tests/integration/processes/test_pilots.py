"""Pilots that die, and pilots that share a drone."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable

import pytest

import skyloop
from skyloop.errors import AuthorityError
from skyloop.messages import (
    Applied,
    Command,
    Event,
    EventKind,
    Failsafe,
    FlightState,
    Hover,
    Land,
    Velocity,
    encode,
)
from tests.support.processes import PILOTS, Process, eventually

pytestmark = pytest.mark.process


@pytest.mark.daily
def test_a_pilot_killed_in_flight_leaves_a_drone_that_hovers_at_once_and_lands_after_five_seconds(
    proxy: Callable[..., Process], start: Callable[..., Process]
) -> None:
    proxy()
    with skyloop.connect("alpha", access="observe") as observer:
        events: list[Event] = []
        applied: list[Applied] = []
        observer.on_event(events.append)
        observer.on_command(applied.append)
        pilot = start(PILOTS, "fly", "alpha")
        pilot.until("flying")
        eventually(lambda: observer.feedback().state is FlightState.FLYING, "the drone flies")
        assert observer.feedback().owner == "doomed"

        pilot.signal(signal.SIGKILL)
        killed = time.monotonic()
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
        assert time.monotonic() - killed < 2.5
        observer.wait("hovering", timeout_s=30.0)
        assert time.monotonic() - killed < 2.5
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=10.0)
        assert 4.5 < time.monotonic() - killed < 8.0
        observer.wait("landed", timeout_s=30.0)

        kinds = {event.kind for event in events}
        assert {EventKind.APPLICATION_LINK, EventKind.AUTHORITY_LOST, EventKind.FAILSAFE} <= kinds
        told = " | ".join(event.text for event in events if event.kind is EventKind.FAILSAFE)
        assert "doomed" in told or "pilot" in told
        assert observer.feedback().owner is None


@pytest.mark.daily
def test_one_flies_priority_takes_over_and_no_command_of_an_old_lease_is_ever_executed(
    proxy: Callable[..., Process],
) -> None:
    proxy()
    with (
        skyloop.connect("alpha", name="bob", authority=skyloop.Authority(priority=16)) as bob,
        skyloop.connect("alpha", name="eve", access="observe") as eve,
        skyloop.connect("alpha", name="mallory", access="observe") as mallory,
        skyloop.connect("alpha", name="trent", access="observe") as trent,
    ):
        observers = (eve, mallory, trent)
        applied: list[Applied] = []
        eve.on_command(applied.append)
        bob.takeoff()
        bob.velocity(forward=0.2)
        eve.wait("flying", timeout_s=30.0)
        old_lease = bob.authority.lease
        for observer in observers:
            with pytest.raises(AuthorityError, match="observe"):
                observer.velocity(forward=1.0)
        with pytest.raises(AuthorityError, match="bob"):
            skyloop.connect("alpha", name="carol", authority=skyloop.Authority(priority=16))

        with skyloop.connect("alpha", name="alice", authority=skyloop.Authority(priority=0), on_exit="hover") as alice:
            assert alice.authority.state == "held"
            eventually(lambda: bob.authority.state == "preempted", "bob knows that alice took over")
            with pytest.raises(AuthorityError, match="alice"):
                bob.velocity(forward=1.0)
            eventually(lambda: all(o.feedback().owner == "alice" for o in observers), "everyone sees who holds it")
            eventually(
                lambda: any(isinstance(echo.applied, Hover) for echo in applied) or eve.feedback().state == "hovering",
                "the drone is brought to hover in between",
            )
            alice.velocity(left=0.2)
            forge(bob, old_lease, Velocity(forward=3.0))
            refused = eventually_event(eve, "foreign_lease")
            assert refused.app == "bob"
        # alice left while hovering or flying; bob was next in line
        eventually(lambda: bob.authority.state == "held", "bob gets it back")
        assert bob.authority.lease > old_lease
        forge(bob, old_lease, Velocity(forward=3.0))
        eventually(lambda: count_events(eve, "foreign_lease") >= 2, "the old lease is refused again")
        bob.velocity(forward=0.1)
        eventually(
            lambda: any(e.lease == bob.authority.lease and e.applied == Velocity(0.1) for e in applied), "bob flies"
        )
        assert not any(isinstance(e.applied, Velocity) and e.applied.forward > 1.0 for e in applied)
        bob.land()


def test_a_pilot_that_hangs_keeps_its_name_on_a_drone_that_fails_safe_until_another_asks(
    proxy: Callable[..., Process], start: Callable[..., Process]
) -> None:
    proxy()
    with skyloop.connect("alpha", access="observe") as observer:
        pilot = start(PILOTS, "fly", "alpha", "4")
        pilot.until("flying")
        observer.wait("flying", timeout_s=30.0)
        pilot.signal(signal.SIGSTOP)
        kept = observer.wait(lambda feedback: not feedback.lease, timeout_s=30.0)
        assert (kept.owner, kept.owner_priority) == ("doomed", 4)
        assert kept.failsafe is not Failsafe.NONE
        lower = skyloop.Authority(priority=31)
        with skyloop.connect("alpha", name="alice", authority=lower, on_exit="hover") as alice:
            assert alice.authority.state == "held"
            observer.wait(lambda feedback: feedback.owner == "alice", timeout_s=30.0)
            pilot.signal(signal.SIGCONT)  # it requests a new lease automatically, with its higher priority
            observer.wait(lambda feedback: feedback.owner == "doomed", timeout_s=30.0)
            eventually(lambda: alice.authority.holder == "doomed", "alice knows")


def forge(drone: skyloop.Drone, lease: int, action: Velocity | Land) -> None:
    """Send a command under another lease over this application's own connection."""
    pilot = drone._commands
    packet = encode(Command(pilot._seq + 1, lease, pilot.schedule.intent, time.monotonic_ns(), action))
    pilot._seq += 1
    assert drone._connection.transmit(packet)


def count_events(drone: skyloop.Drone, reason: str) -> int:
    return sum(event.data.get("reason") == reason for event in drone.recent_events())


def eventually_event(drone: skyloop.Drone, reason: str) -> Event:
    eventually(lambda: count_events(drone, reason) > 0, f"an event with the reason {reason}")
    return next(event for event in drone.recent_events() if event.data.get("reason") == reason)
