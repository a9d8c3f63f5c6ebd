"""Several applications share one drone: client, transport and proxy in one process."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skyloop import aio
from skyloop.client import Authority, AuthorityStatus, Drone
from skyloop.client.authority import TakeoverRequest, authority_request
from skyloop.client.commands import _busy
from skyloop.client.drone import open_drone
from skyloop.errors import AuthorityError, UsageError
from skyloop.messages import Event, EventKind
from skyloop.proxy.proxy import Proxy
from skyloop.transport.memory import MemoryServer
from skyloop.transport.testing import wait_until
from tests.support.fake_vehicle import FakeVehicle

WAIT_S = 10.0


class Shared:
    def __init__(self) -> None:
        self.server = MemoryServer("alpha")
        self.proxy = Proxy(FakeVehicle(), self.server, name="alpha")

    @contextmanager
    def joined(self, app: str, *, priority: int = 16, **options: Any) -> Iterator[Drone]:
        """A pilot or an observer; at the end it releases everything without landing."""
        access = options.pop("access", "pilot")
        authority = Authority(priority=priority, **options)
        drone = open_drone(self.server.dial, app=app, access=access, authority=authority)
        try:
            yield drone
        finally:
            drone.close()


@pytest.fixture
def shared() -> Iterator[Shared]:
    shared = Shared()
    shared.proxy.start()
    yield shared
    shared.proxy.end()


def held(drone: Drone) -> None:
    wait_until(lambda: drone.authority.state == "held", "it has the authority")


def test_a_holder_that_grants_a_request_hands_over_and_gets_it_back_later(shared: Shared) -> None:
    asked: list[TakeoverRequest] = []

    def grant(request: TakeoverRequest) -> bool:
        asked.append(request)
        return True

    with shared.joined("alice") as alice:
        alice.on_takeover(grant)
        before = alice.authority.lease
        with shared.joined("bob", priority=4, takeover="ask", for_s=20.0, wait_s=WAIT_S) as bob:
            assert bob.authority.state == "held"
            assert bob.authority.until_ns is not None
            [request] = asked
            assert (request.by, request.priority, request.for_s) == ("bob", 4, 20.0)
            assert 9.0 < request.within_s <= 10.0
            wait_until(lambda: alice.authority.state == "preempted", "alice knows")
            with pytest.raises(AuthorityError, match="bob"):
                alice.hover()
        held(alice)
        assert alice.authority.lease > before


def test_a_holder_that_declines_keeps_it_and_the_requester_gets_the_reason(shared: Shared) -> None:
    with shared.joined("alice") as alice, shared.joined("bob", stay=True) as bob:
        assert (bob.authority.state, bob.authority.holder, bob.authority.position) == ("queued", "alice", 1)
        alice.on_takeover(lambda _: "landing")
        bob.request_authority(takeover="ask", stay=True)
        known = bob._commands._authority
        wait_until(lambda: known.declined.endswith("declines to hand the authority over to bob now: landing"), "no")
        assert alice.authority.state == "held"
        assert bob.authority.state == "queued"
    assert "within 3 s; alice: no: wait longer" in _busy(AuthorityStatus("queued", holder="alice"), 3.0, "alice: no")


def test_a_holder_that_does_not_answer_loses_it_after_the_time_to_answer(shared: Shared) -> None:
    with shared.joined("alice") as alice:
        alice.on_takeover(lambda _: None)
        alice.config["authority.ask_s"] = 0.2
        with shared.joined("bob", priority=4, takeover="ask", wait_s=WAIT_S) as bob:
            assert bob.authority.state == "held"
            wait_until(lambda: alice.authority.holder == "bob", "alice knows")


def test_a_callback_that_raises_is_reported_and_does_not_answer(shared: Shared) -> None:
    heard: list[Event] = []

    def fail(request: TakeoverRequest) -> bool:
        raise ValueError(request.by)

    with shared.joined("alice") as alice:
        alice.on_event(heard.append)
        alice.on_takeover(fail)
        with shared.joined("bob", stay=True, takeover="ask") as bob:
            wait_until(lambda: any(e.kind is EventKind.CALLBACK_ERROR for e in heard), "it is told")
            assert bob.authority.state == "queued"
        with pytest.raises(UsageError, match="can't be called"):
            alice.on_takeover("grant")  # type: ignore[arg-type]


def test_a_queue_with_expected_waits_moves_up(shared: Shared) -> None:
    with (
        shared.joined("alice", for_s=60.0) as alice,
        shared.joined("bob", stay=True, for_s=30.0) as bob,
        shared.joined("carol", stay=True, for_s=10.0) as carol,
    ):
        assert bob.authority.expected_wait_s == pytest.approx(60.0, abs=10.0)
        assert carol.authority.expected_wait_s == pytest.approx(90.0, abs=10.0)
        assert carol.authority.position == 2
        alice.release_authority()
        held(bob)
        wait_until(lambda: carol.authority.position == 1, "carol moved up")
        assert carol.authority.expected_wait_s == pytest.approx(30.0, abs=10.0)
        line = r"bob holds the authority \(number 2 in the queue, expected wait \d+ s\)"
        with pytest.raises(AuthorityError, match=line):
            open_drone(shared.server.dial, app="dave")


def test_a_holder_whose_time_is_over_is_relieved_and_does_not_ask_again(shared: Shared) -> None:
    heard: list[Event] = []
    with shared.joined("alice", priority=4, for_s=0.3) as alice:
        alice.on_event(heard.append)
        wait_until(lambda: any(e.kind is EventKind.AUTHORITY_EXPIRED for e in heard), "it is told")
        assert alice.authority.state == "held"  # there is no other request
        with shared.joined("bob", priority=16) as bob:
            wait_until(lambda: alice.authority.state == "none", "alice knows")
            assert bob.authority.state == "held"
            with pytest.raises(AuthorityError, match="request_authority"):
                alice.hover()
            alice.request_authority()  # explicitly, with its higher priority
            held(alice)


def test_a_silent_pilot_finds_its_name_kept_and_gets_a_new_lease(shared: Shared) -> None:
    with shared.joined("alice") as alice, shared.joined("eve", access="observe") as eve:
        lease = alice.authority.lease
        transmit = alice._connection.transmit
        alice._connection.transmit = lambda packet: True  # nothing it sends gets out from now on
        kept = eve.wait(lambda feedback: not feedback.lease, WAIT_S)
        assert kept.owner == "alice"
        alice._connection.transmit = transmit
        held(alice)
        wait_until(lambda: alice.authority.lease > lease, "a new lease")
        assert alice.hover()


def test_with_asyncio(shared: Shared) -> None:
    async def fly() -> None:
        alice = aio.Drone(open_drone(shared.server.dial, app="alice"))
        asked: list[str] = []

        async def answer(request: TakeoverRequest) -> bool:
            await asyncio.sleep(0)
            asked.append(request.by)
            return True

        alice.on_takeover(answer)
        bob = aio.Drone(open_drone(shared.server.dial, app="bob", authority=Authority(stay=True)))
        await bob.request_authority(4, takeover="ask", wait_s=WAIT_S)
        assert bob.authority.state == "held"
        assert asked == ["bob"]
        await bob.close()
        await alice.close()

    asyncio.run(fly())


@pytest.mark.parametrize(
    "wish",
    [
        {"priority": 32},
        {"priority": "high"},
        {"priority": 3, "for_s": 0.0},
        {"priority": 3, "for_s": math.nan},
        {"priority": 3, "for_s": 90_000.0},
        {"priority": 3, "for_s": "long"},
        {"priority": 3, "takeover": "grab"},
    ],
    ids=str,
)
def test_invalid_requests_are_refused(wish: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="must be"):
        authority_request(**wish)
