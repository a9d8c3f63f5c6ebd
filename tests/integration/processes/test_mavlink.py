"""A MAVLink vehicle across processes (emulated autopilot, proxy and pilot), and the failures between them."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable

import pytest

import skyloop
from skyloop.control.follow import FollowMarker
from skyloop.messages import EventKind, Failsafe, FlightState, LinkState
from skyloop.vehicles.mavlink.emulator import CAMERA
from tests.integration.processes.firmware import ADDRESS, KINDS, wait_until_ready
from tests.support.processes import PILOTS, Process, eventually

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]

MARKER = 7

Firmware = Callable[..., tuple[Process, str]]


@pytest.fixture
def firmware(start: Callable[..., Process]) -> Firmware:
    """Start an emulated autopilot on free ports; returns the address to fly it by."""

    def begin(kind: str, *options: str) -> tuple[Process, str]:
        process = start("-m", "skyloop", "sim", "--firmware", kind, "--port-base", "0", *options)
        process.until("ready")
        process.until("\n")
        found = ADDRESS.search(process.text)
        assert found is not None, process.text
        return process, found[0]

    return begin


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


@pytest.mark.parametrize("lost", [0.0, 0.1])
@pytest.mark.parametrize("kind", KINDS)
def test_the_marker_follower_flies_it_unchanged_with_and_without_loss(
    firmware: Firmware, proxy: Callable[..., Process], kind: str, lost: float
) -> None:
    port = free_port()
    _, address = firmware(kind, "--world", "room", "--lose", f"{lost}", "--fault-seed", "3", "--video-port", f"{port}")
    lens = ",".join(map(str, CAMERA.distortion))
    camera = f"camera=udp://127.0.0.1:{port}&camera_width={CAMERA.width}&camera_height={CAMERA.height}"
    proxy(f"{address}?{camera}&fx={CAMERA.fx}&cx={CAMERA.cx}&cy={CAMERA.cy}&distortion={lens}&takeoff_altitude=1.0")
    with skyloop.connect("alpha") as drone:
        wait_until_ready(drone)
        assert drone.next_frame(timeout_s=30.0).shape == (CAMERA.height, CAMERA.width, 3)
        drone.takeoff()
        follower = FollowMarker(drone, MARKER)
        follower.run(seconds=40.0, until=lambda: follower.score.share_in_view is not None)
        follower.run(seconds=8.0)
        share = follower.score.share_in_view
        assert share is not None, "the marker was never seen"
        assert share > 0.5  # nearly all on an idle machine; a busy one loses pictures and shows them late
        assert drone.feedback().state.airborne
        drone.land()
        eventually(lambda: drone.feedback().state is FlightState.LANDED, "it stands again")


@pytest.mark.parametrize("kind", KINDS)
def test_a_killed_pilot_leaves_it_hovering_and_then_landing(
    firmware: Firmware, proxy: Callable[..., Process], start: Callable[..., Process], kind: str
) -> None:
    _, address = firmware(kind, "--lose", "0.1", "--world", "empty")
    proxy(address)
    with skyloop.connect("alpha", access="observe") as observer:
        wait_until_ready(observer)
        pilot = start(PILOTS, "fly", "alpha")
        pilot.until("flying", 40.0)
        observer.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.2, timeout_s=30.0)
        pilot.signal(signal.SIGKILL)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
        observer.wait("hovering", timeout_s=30.0)
        own_mode = {"arducopter": "BRAKE", "px4": "AUTO.LOITER"}[kind]
        observer.wait(lambda feedback: (feedback.native or {}).get("mavlink.mode") == own_mode, timeout_s=30.0)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=10.0)
        observer.wait("landed", timeout_s=30.0)


@pytest.mark.parametrize("kind", KINDS)
def test_an_autopilot_that_goes_silent_in_flight_is_found_again_and_executes_no_old_command(
    firmware: Firmware, proxy: Callable[..., Process], kind: str
) -> None:
    process, address = firmware(kind, "--world", "empty", "--lose", "0.1")
    proxy(address)
    with skyloop.connect("alpha") as drone:
        wait_until_ready(drone)
        drone.takeoff(timeout_s=30.0)
        begun = time.monotonic()
        while (drone.feedback().velocity_m_s or (0.0,))[0] < 0.3:
            assert time.monotonic() - begun < 15.0
            drone.velocity(forward=0.5)
            time.sleep(0.05)
        process.signal(signal.SIGSTOP)
        eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is told")
        process.signal(signal.SIGCONT)
        eventually(lambda: drone.link.vehicle in (LinkState.UP, LinkState.DEGRADED), "it is found again")
        eventually(lambda: drone.feedback().state is FlightState.HOVERING, "it stopped")
        assert any(event.kind is EventKind.VEHICLE_LINK for event in drone.recent_events())
        drone.velocity(left=0.5)
        begun = time.monotonic()
        while (drone.feedback().velocity_m_s or (0.0, 0.0))[1] < 0.3:
            told = [event.text for event in drone.recent_events()][-14:]
            assert time.monotonic() - begun < 15.0, f"a fresh command flies it again: {drone.feedback()}; {told}"
            drone.velocity(left=0.5)
            time.sleep(0.05)
        drone.land(timeout_s=30.0)
