"""Bad input over a real connection: refused with a clear error or an event, while the flight continues."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest

import skyloop
from skyloop.errors import ParameterError, UnknownNameError, UsageError
from skyloop.messages import Command, EventKind, FlightState, Velocity, encode
from skyloop.transport.local import dial
from tests.support.processes import Process, eventually

pytestmark = pytest.mark.process


def test_bad_values_are_refused_at_the_call(proxy: Callable[..., Process]) -> None:
    proxy()
    with skyloop.connect("alpha") as drone:
        drone.takeoff()
        for bad in (math.nan, math.inf, -math.inf, "fast", None, [1.0]):
            with pytest.raises(UsageError, match="forward"):
                drone.velocity(forward=bad)  # type: ignore[arg-type]
        with pytest.raises(UnknownNameError, match=r"did you mean 'limits.tilt'"):
            drone.config["limits.tit"] = 0.2
        for bad_tilt in (99.0, -1.0, math.nan, "steep", True):
            with pytest.raises((ParameterError, UsageError), match=r"limits\.tilt"):
                drone.config["limits.tilt"] = bad_tilt
        drone.velocity(forward=1000.0)  # clamped, with an event
        eventually(lambda: any(e.kind is EventKind.COMMAND_CLAMPED for e in drone.recent_events()), "the clamp is told")
        drone.hover()
        assert drone.feedback().state.airborne
        drone.land()


def test_wrong_names_are_answered_with_the_closest_valid_one(proxy: Callable[..., Process]) -> None:
    proxy(name="charlie")
    with pytest.raises(UnknownNameError, match="did you mean 'charlie'"):
        skyloop.connect("charly")
    with pytest.raises(skyloop.UsageError, match="did you mean 'sim'"):
        skyloop.connect("simm://")


def test_garbage_does_not_disturb_the_flight(proxy: Callable[..., Process]) -> None:
    proxy()
    source = random.Random(3)
    with skyloop.connect("alpha") as drone:
        drone.takeoff()
        drone.velocity(forward=0.2)
        drone.wait("flying", timeout_s=30.0)
        whole = encode(Command(1, drone.authority.lease, 10**9, 0, Velocity(forward=3.0)))
        hostile = (
            [source.randbytes(source.randrange(1, 200)) for _ in range(10_000)]
            + [whole[:cut] for cut in range(1, len(whole))]
            + [whole, bytes(60_000)]
        )
        sent = 0
        while sent < len(hostile):
            sent = attack(hostile, sent)
            drone.velocity(forward=0.2)
            assert drone.feedback().state is FlightState.FLYING
        events = drone.recent_events()
        assert any(e.kind is EventKind.PACKET_MALFORMED for e in events)
        assert drone.feedback().owner == drone._state.app
        assert drone.stats["feedback"].lost == 0
        drone.land()


class Deaf:
    def __init__(self) -> None:
        self.reason = ""

    def packet(self, packet: bytes) -> None: ...
    def frame(self, header: object, pixels: object, topic: str = "") -> None: ...
    def closed(self, reason: str) -> None:
        self.reason = reason


def attack(hostile: list[bytes], first: int) -> int:
    """Send from this index on until the proxy ends the connection; returns how far it got."""
    deaf = Deaf()
    end = dial("alpha")(deaf)
    try:
        for index in range(first, len(hostile)):
            while not end.send(hostile[index]):
                if deaf.reason:
                    return max(index, first + 1)
    finally:
        end.close()
    return len(hostile)
