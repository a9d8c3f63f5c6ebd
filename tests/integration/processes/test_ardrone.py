"""An AR.Drone across processes (emulated firmware, proxy and pilot), and the failures between them."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.control.follow import FollowMarker
from skyloop.messages import EventKind, Failsafe, FlightState, LinkState
from skyloop.vehicles.ardrone.emulator.video import FRONT_1
from tests.support.processes import PILOTS, Process, eventually

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]

MARKER = 7
LINE = re.compile(r"at udp (\d+), navdata udp (\d+), video \w+ (\d+), control tcp (\d+)")

Firmware = Callable[..., tuple[Process, str]]


@pytest.fixture
def firmware(start: Callable[..., Process]) -> Firmware:
    """Start an emulated AR.Drone on free ports, or on those of an earlier one; returns the address to fly it by."""

    def begin(version: int = 2, *options: str) -> tuple[Process, str]:
        arguments = ["sim", "--firmware", f"ardrone{version}", "--port-base", "0", *options]
        process = start("-m", "skyloop", *arguments)
        process.until("control tcp")
        process.until("\n")
        ports = LINE.search(process.text)
        assert ports is not None, process.text
        at, navdata, video, control = ports.groups()
        address = f"ardrone://127.0.0.1?at_port={at}&navdata_port={navdata}&video_port={video}&control_port={control}"
        return process, address

    return begin


def ends_in_view(drone: skyloop.Drone, follower: FollowMarker, seconds: float) -> None:
    """Find the marker, follow it for this long, and check that it was in view nearly always."""
    follower.run(seconds=40.0, until=lambda: follower.score.share_in_view is not None)
    follower.run(seconds=seconds)
    share = follower.score.share_in_view
    assert share is not None, "the marker was never seen"
    assert share > 0.5, "the share is 1 unless the machine is overloaded"
    assert drone.feedback().state is FlightState.FLYING


@pytest.mark.parametrize(("version", "lost"), [(2, 0.0), (2, 0.1), (1, 0.0)])
def test_the_marker_follower_flies_it_unchanged_with_and_without_loss(
    firmware: Firmware, proxy: Callable[..., Process], version: int, lost: float
) -> None:
    _, address = firmware(version, "--lose", f"{lost}", "--fault-seed", "3")
    if version == 1:  # its camera is unknown, so the address describes the emulated one
        address += f"&fx={FRONT_1.fx}&cx={FRONT_1.cx}&cy={FRONT_1.cy}"
    proxy(address)
    with skyloop.connect("alpha") as drone:
        frame = drone.next_frame(timeout_s=30.0)
        assert frame.shape == ((360, 640, 3) if version == 2 else (240, 320, 3))
        drone.takeoff()
        ends_in_view(drone, FollowMarker(drone, MARKER), 8.0)
        drone.land()
        eventually(lambda: drone.feedback().state is FlightState.LANDED, "it stands again")


@pytest.mark.daily
def test_a_killed_pilot_leaves_it_hovering_and_then_landing(
    firmware: Firmware, proxy: Callable[..., Process], start: Callable[..., Process]
) -> None:
    _, address = firmware(2, "--lose", "0.1", "--world", "empty")
    proxy(address)
    with skyloop.connect("alpha", access="observe") as observer:
        pilot = start(PILOTS, "fly", "alpha")
        pilot.until("flying")
        observer.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.2, timeout_s=30.0)
        pilot.signal(signal.SIGKILL)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
        observer.wait("hovering", timeout_s=30.0)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=10.0)
        observer.wait("landed", timeout_s=30.0)


def test_firmware_that_restarts_in_flight_is_found_again_without_the_applications_help(
    firmware: Firmware, proxy: Callable[..., Process], start: Callable[..., Process]
) -> None:
    first, address = firmware(2)
    proxy(address)
    with skyloop.connect("alpha") as drone:
        drone.next_frame(timeout_s=30.0)
        drone.takeoff()
        ends_in_view(drone, FollowMarker(drone, MARKER), 4.0)
        first.signal(signal.SIGKILL)
        first.wait()
        eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is told")

        base = {name: re.search(rf"{name}_port=(\d+)", address) for name in ("at", "navdata", "video", "control")}
        ports = {name: found[1] for name, found in base.items() if found is not None}
        again = start(str(Path(__file__).with_name("ardrone_again.py")), *(ports[n] for n in base))
        again.until("ready")
        eventually(lambda: drone.link.vehicle is LinkState.UP, "it is found again")
        eventually(lambda: drone.feedback().state is FlightState.LANDED, "a drone just switched on stands")
        assert any(event.kind is EventKind.VEHICLE_LINK for event in drone.recent_events())
        eventually(lambda: drone.next_frame(timeout_s=30.0).age_s < 0.5, "its pictures come again")
        drone.takeoff()
        ends_in_view(drone, FollowMarker(drone, MARKER), 6.0)
        drone.land()
