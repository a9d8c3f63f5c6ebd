"""A silent page in control is a silent pilot: hover, then landing, as for any program."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from skyloop.client.actions import CommandSchedule
from skyloop.client.authority import AuthorityTracker
from skyloop.client.commands import CommandSender
from skyloop.client.connection import Scheduler
from skyloop.cockpit.control_session import GONE_S
from skyloop.messages import (
    Attitude,
    Command,
    EmergencyStop,
    FlightState,
    Hover,
    Land,
    RequestAuthority,
    Role,
    Velocity,
    decode,
)
from tests.support.cockpit import Node, until
from tests.support.cockpit_page import page
from tests.support.testclient import TestClient

S = 1_000_000_000


class Flown:
    """A pilot's connection over a link that is always up, with its own clock: what it sends and requests."""

    def __init__(self) -> None:
        self.now_ns = 100 * S
        self.sent: list[Command] = []
        self.asked: list[object] = []
        scheduler = Scheduler()
        scheduler.clock = lambda: self.now_ns
        connection: Any = SimpleNamespace(
            connected=True,
            offset_ns=0,
            transmit=self._transmit,
            poke=lambda: None,
            ask=self._ask,
            why_closed="",
            check_open=lambda: None,
        )
        self.pilot = CommandSender(
            Role.PILOT,
            AuthorityTracker("page"),
            CommandSchedule(),
            connection,
            scheduler,
            emit=lambda *_, **__: None,
            changed=lambda: None,
            granted=lambda _: None,
        )
        self.pilot.flown_by_person()
        self.pilot.connected(3)

    def hold(self, lease: int) -> None:
        self.pilot._authority.asked(RequestAuthority(8))
        self.pilot._authority.granted(lease, self.now_ns)

    def goes_on(self, seconds: float, step_s: float = 0.02) -> list[Command]:
        """Collect everything sent during the block."""
        before = len(self.sent)
        for _ in range(round(seconds / step_s)):
            self.now_ns += round(step_s * S)
            self.pilot.tick(self.now_ns)
        return self.sent[before:]

    def _transmit(self, packet: bytes) -> bool:
        command = decode(packet)
        assert isinstance(command, Command)
        self.sent.append(command)
        return True

    def _ask(self, wish: object, *_: object) -> None:
        self.asked.append(wish)


def test_nothing_is_repeated_for_an_absent_page() -> None:
    flown = Flown()
    flown.hold(5)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    flown.pilot.command(Hover())
    assert len(flown.goes_on(1.9)) > 50, "the lease is kept"
    flown.goes_on(0.2)
    assert flown.goes_on(60.0) == [], "silent: to the proxy, too"


def test_a_returning_page_continues_without_its_earlier_commands() -> None:
    flown = Flown()
    flown.hold(5)
    for _ in range(10):
        flown.pilot.present_until(flown.now_ns + 2 * S)
        assert flown.goes_on(0.15), "pings keep it"
    flown.pilot.command(Velocity(forward=0.5))
    assert flown.goes_on(5.0)[-1].sent_ns <= flown.now_ns - 3 * S
    flown.pilot.present_until(flown.now_ns + 2 * S)
    again = flown.goes_on(0.5)
    assert again
    assert all(type(command.action).__name__ == "Idle" for command in again)


@pytest.mark.parametrize("sticks", [Velocity(forward=0.5), Attitude(pitch=0.1)])
def test_sticks_from_before_a_short_silence_do_not_fly_on_beside_its_signs_of_life(sticks: Velocity | Attitude) -> None:
    """It was too short for the failsafe, and ``Idle`` changes nothing: the vehicle kept flying by those sticks."""
    flown = Flown()
    flown.hold(5)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    for _ in range(42):  # in the last two it is not known to be there
        flown.pilot.command(sticks)
        flown.goes_on(0.05, 0.01)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    assert {(command.action, command.automatic) for command in flown.goes_on(0.5)} == {(Hover(), True)}


@pytest.mark.parametrize("action", [Land(), Hover()])
def test_a_command_that_ended_the_flight_during_a_silence_is_repeated_afterwards(action: Land | Hover) -> None:
    """It was sent once, and dropped with the sticks: where that one packet was lost it flew on by them."""
    flown = Flown()
    flown.hold(5)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    flown.pilot.command(Velocity(forward=0.5))
    flown.goes_on(2.1)
    assert flown.pilot.command(action)
    assert flown.goes_on(0.2) == []
    flown.pilot.present_until(flown.now_ns + 2 * S)
    assert {(command.action, command.automatic) for command in flown.goes_on(0.5)} == {(action, False)}


def test_pings_without_hearing_keep_nothing_within_a_step_of_the_clock() -> None:
    """On Windows, where a step takes 15.6 ms, such a page kept control, and its vehicle hovered instead of landing."""
    flown = Flown()
    flown.hold(5)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    flown.pilot.command(Velocity(forward=0.5))
    flown.goes_on(2.1)
    before = len(flown.sent)
    for _ in range(50):
        flown.now_ns += S // 64
        flown.pilot.present_until(flown.now_ns)
        assert not flown.pilot.is_present(flown.now_ns)
        flown.pilot.tick(flown.now_ns)
    assert len(flown.sent) == before


def test_older_reports_never_override_newer_ones() -> None:
    flown = Flown()
    flown.hold(5)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    flown.pilot.present_until(flown.now_ns - 6 * S)
    assert flown.goes_on(1.5)


def test_an_emergency_stop_is_sent_even_for_a_silent_page() -> None:
    flown = Flown()
    flown.hold(5)
    flown.goes_on(10.0)
    assert flown.pilot.command(EmergencyStop())
    assert flown.sent[-1].action == EmergencyStop()


def test_expired_control_is_not_requested_again_automatically() -> None:
    flown = Flown()
    flown.hold(5)
    flown.pilot.disconnected()
    flown.pilot.connected(4)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    flown.goes_on(1.0)
    assert flown.asked == [], "the connection was lost and is back"
    flown.hold(6)
    flown.pilot._authority._lost(None)
    flown.pilot.present_until(flown.now_ns + 2 * S)
    flown.goes_on(1.0)
    assert flown.asked == [], "the lease ended by silence"
    assert flown.pilot.status.state == "none"


def test_a_program_always_counts_as_present() -> None:
    flown = Flown()
    flown.pilot._authority.renews = True
    flown.pilot._present_until_ns = None
    flown.hold(5)
    assert flown.goes_on(30.0)
    flown.pilot.disconnected()
    flown.pilot.connected(4)
    flown.goes_on(0.1)
    assert flown.asked


def quick(node: Node) -> None:
    """As a lab may set it, and to keep this test quick."""
    with node.connect("lab", on_exit="hover") as lab:
        lab.config["authority.timeout_s"] = 0.3
        lab.config["failsafe.hover_after_s"] = 0.2
        lab.config["failsafe.land_after_s"] = 0.6


def test_a_page_in_control_that_falls_silent_hovers_then_lands(client: TestClient, node: Node) -> None:
    quick(node)
    with page(client) as pilot, node.connect("watcher", access="observe") as watcher:
        pilot.take()
        with pilot.staying():
            pilot.take_off()
            pilot.say("fly", forward=0.3)
            until(lambda: node.flyer.state is FlightState.FLYING)
            until(lambda: node.flyer.state is FlightState.HOVERING)  # no more stick commands arrived
            time.sleep(0.6)  # longer than the proxy waits here
            assert watcher.feedback().lease, "a page that pings keeps control while it hovers"
        silent_s = time.monotonic()
        until(lambda: node.flyer.state in (FlightState.LANDING, FlightState.LANDED), "it lands")
        assert GONE_S + 0.2 < time.monotonic() - silent_s < GONE_S + 2.0
        told = pilot.wait("authority", mine=False)
        assert "received nothing from this page for 2 s" in told["why"]
        pilot.say("ping")
        pilot.say("takeoff")
        assert "take control first" in pilot.wait("refused", do="takeoff")["why"]
        assert not watcher.feedback().lease, "it does not come back by itself"


def test_a_page_that_pings_without_receiving_is_silent_too(client: TestClient, node: Node) -> None:
    quick(node)
    with page(client) as pilot:
        pilot.take().take_off()
        heard_s = time.monotonic()
        while node.flyer.state is not FlightState.LANDED and time.monotonic() - heard_s < GONE_S + 3.0:
            pilot.say("ping", seen_s=heard_s)  # no pong since
            time.sleep(0.05)
        assert node.flyer.state in (FlightState.LANDING, FlightState.LANDED)
