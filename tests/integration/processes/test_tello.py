"""A Tello across processes (emulated firmware, proxy and pilot), and the failures between them."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

import skyloop
from skyloop.control.follow import FollowMarker
from skyloop.messages import EventKind, Failsafe, FlightState, LinkState
from tests.support.processes import PILOTS, Process, eventually
from tests.support.tello_addresses import Addresses

pytestmark = [pytest.mark.process, pytest.mark.timeout(240)]
pytest.importorskip("av")

MARKER = 7
SIGHTINGS = 40

Firmware = Callable[..., Process]


@pytest.fixture
def addresses() -> Addresses:
    """The drone's address and the pilot's address, private to this test."""
    return Addresses.free()


@pytest.fixture
def firmware(start: Callable[..., Process], addresses: Addresses) -> Firmware:
    """Start an emulated Tello."""

    def begin(*options: str) -> Process:
        process = start("-m", "skyloop", "sim", "--firmware", "tello", "--bind", addresses.drone, *options)
        process.until("commands udp")
        return process

    return begin


def found(follower: FollowMarker, seconds: float) -> float:
    """Find the marker and follow it for this long; returns the share of later pictures that showed it."""
    follower.run(seconds=60.0, until=lambda: follower.score.share_in_view is not None)
    follower.run(seconds=seconds)
    share = follower.score.share_in_view
    assert share is not None, "the marker was never seen"
    return share


def test_the_marker_follower_flies_it_unchanged(
    firmware: Firmware, proxy: Callable[..., Process], addresses: Addresses
) -> None:
    firmware()
    proxy(addresses.uri())
    with skyloop.connect("alpha") as drone:
        assert drone.next_frame(timeout_s=30.0).shape == (720, 960, 3)
        drone.takeoff()
        assert found(FollowMarker(drone, MARKER), 8.0) > 0.5
        assert drone.feedback().state is FlightState.FLYING
        drone.land()
        eventually(lambda: drone.feedback().state is FlightState.LANDED, "it stands again")


def test_it_finds_and_follows_the_marker_with_a_tenth_of_the_datagrams_lost(
    firmware: Firmware, proxy: Callable[..., Process], addresses: Addresses
) -> None:
    """Pictures then arrive in bursts, each starting with an intact key picture: it takes longer, and stays near."""
    firmware("--lose", "0.1", "--fault-seed", "3")
    proxy(addresses.uri())
    with skyloop.connect("alpha") as drone:
        drone.next_frame(timeout_s=30.0)
        drone.takeoff()
        follower = FollowMarker(drone, MARKER)
        follower.run(seconds=100.0, until=lambda: follower.score.in_view >= SIGHTINGS)
        assert follower.score.in_view >= SIGHTINGS
        assert abs(follower.score.ranges[-1][1]) < 0.8
        assert drone.feedback().state.airborne
        drone.land()
        eventually(lambda: drone.feedback().state is FlightState.LANDED, "it stands again")


def test_a_killed_pilot_leaves_it_hovering_and_then_landing(
    firmware: Firmware, proxy: Callable[..., Process], start: Callable[..., Process], addresses: Addresses
) -> None:
    firmware("--lose", "0.1", "--world", "empty")
    proxy(addresses.uri(video=0))
    with skyloop.connect("alpha", access="observe") as observer:
        pilot = start(PILOTS, "fly", "alpha")
        pilot.until("flying", 40.0)
        observer.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.2, timeout_s=30.0)
        pilot.signal(signal.SIGKILL)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
        observer.wait("hovering", timeout_s=30.0)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=10.0)
        observer.wait("landed", timeout_s=30.0)


def test_a_proxy_that_replaces_a_killed_one_finds_it_in_the_air(
    firmware: Firmware, proxy: Callable[..., Process], start: Callable[..., Process], addresses: Addresses
) -> None:
    firmware("--world", "empty")
    first = proxy(addresses.uri(video=0))
    with skyloop.connect("alpha") as drone:
        drone.takeoff()
        drone.wait("hovering", timeout_s=30.0)
        first.signal(signal.SIGKILL)
        first.wait()
        drone.close()  # the block's end could wait for a landing proxy longer than a Tello stays up without commands
    proxy(addresses.uri(video=0), "beta")
    with skyloop.connect("beta", access="observe") as observer:
        observer.wait("hovering", timeout_s=30.0)


def test_firmware_that_restarts_in_flight_is_found_again_without_the_applications_help(
    firmware: Firmware, proxy: Callable[..., Process], addresses: Addresses
) -> None:
    first = firmware()
    proxy(addresses.uri())
    with skyloop.connect("alpha") as drone:
        drone.next_frame(timeout_s=30.0)
        drone.takeoff()
        assert found(FollowMarker(drone, MARKER), 4.0) > 0.5
        first.signal(signal.SIGKILL)
        first.wait()
        eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is told")
        firmware()
        eventually(lambda: drone.link.vehicle is LinkState.UP, "it is found again")
        eventually(lambda: drone.feedback().state is FlightState.LANDED, "a drone just switched on stands")
        assert any(event.kind is EventKind.VEHICLE_LINK for event in drone.recent_events())
        eventually(lambda: drone.next_frame(timeout_s=30.0).age_s < 0.5, "its pictures come again")
        drone.takeoff()
        assert found(FollowMarker(drone, MARKER), 6.0) > 0.5
        drone.land()
