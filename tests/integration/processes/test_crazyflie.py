"""A Crazyflie with an AI-deck across processes: emulated firmware, proxy and pilot."""

from __future__ import annotations

import math
import re
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import pytest

import skyloop
from skyloop.control.follow import FollowMarker
from skyloop.messages import Failsafe, FlightState, LinkState
from skyloop.vehicles.crazyflie.emulator.deck import CAMERA
from tests.support.processes import PILOTS, Process, eventually

pytestmark = [pytest.mark.process, pytest.mark.timeout(240)]

MARKER = 7
MOST_OFF_M = 0.15
SIDE_M = 1.0
HEIGHT_M = 1.0
WITHIN_S = 40.0

Firmware = Callable[..., tuple[Process, str]]


@pytest.fixture(autouse=True)
def _cache(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "crazyflie"))


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


@pytest.fixture
def firmware(start: Callable[..., Process]) -> Firmware:
    """Start an emulated Crazyflie; returns its address. The same ``port`` can be used again."""

    def begin(*options: str, port: int = 0) -> tuple[Process, str]:
        process = start("-m", "skyloop", "sim", "--firmware", "crazyflie", "--port-base", f"{port}", *options)
        process.until("CRTP udp")
        process.until("\n")
        found = re.search(r"CRTP udp (\d+)", process.text)
        assert found is not None, process.text
        return process, f"crazyflie://udp:127.0.0.1:{found[1]}"

    return begin


class Link:
    """Relays datagrams between one client and a vehicle on this machine while it is ``on``."""

    def __init__(self, vehicle: int) -> None:
        self.on = True
        self._inside, self._outside = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._inside.connect(("127.0.0.1", vehicle))
        self._outside.bind(("127.0.0.1", 0))
        self._client: tuple[str, int] | None = None
        for carry in (self._to_vehicle, self._to_client):
            threading.Thread(target=carry, daemon=True).start()

    @property
    def address(self) -> str:
        return f"crazyflie://udp:127.0.0.1:{self._outside.getsockname()[1]}"

    def _to_vehicle(self) -> None:
        while True:
            data, self._client = self._outside.recvfrom(2048)
            if self.on:
                with suppress(OSError):
                    self._inside.send(data)

    def _to_client(self) -> None:
        while True:
            with suppress(ConnectionError):
                data = self._inside.recv(2048)
                if self.on and self._client is not None:
                    self._outside.sendto(data, self._client)


def ready(drone: skyloop.Drone) -> None:
    eventually(lambda: drone.link.vehicle is LinkState.UP, "its link is up", WITHIN_S)
    eventually(lambda: drone.feedback().state is FlightState.LANDED, "it is on the ground", WITHIN_S)


def place(drone: skyloop.Drone) -> tuple[float, float, float]:
    found = drone.feedback().position_m
    assert found is not None
    return found


def moving(drone: skyloop.Drone) -> tuple[float, float, float]:
    """Fly forward for a moment; return where it then is."""
    begun_s = time.monotonic()
    while time.monotonic() < begun_s + 1.5:
        drone.velocity(forward=0.3)
        time.sleep(0.05)
    return place(drone)


@pytest.mark.alone
def test_the_marker_follower_flies_it_unchanged(firmware: Firmware, proxy: Callable[..., Process]) -> None:
    """The controller of ``skyloop demo`` sees the marker in nearly all of the deck's grey images."""
    port = free_port(socket.SOCK_STREAM)
    _, address = firmware("--world", "room", "--video-port", f"{port}")
    lens = f"fx={CAMERA.fx}&fy={CAMERA.fy}&cx={CAMERA.cx}&cy={CAMERA.cy}"
    proxy(f"{address}?deck=127.0.0.1:{port}&{lens}")
    with skyloop.connect("alpha") as drone:
        ready(drone)
        frame = drone.next_frame(timeout_s=30.0)
        assert frame.shape[:2] == (244, 324)
        assert (frame.max(axis=2) == frame.min(axis=2)).all()  # grey
        drone.takeoff(timeout_s=WITHIN_S)
        follower = FollowMarker(drone, MARKER)
        follower.run(seconds=60.0, until=lambda: follower.score.share_in_view is not None)
        follower.run(seconds=30.0)
        share = follower.score.share_in_view
        print(f"in view in {share or 0.0:.1%} of {follower.score.frames} frames")
        assert share is not None, "the marker was never seen"
        assert share >= 0.9
        assert drone.feedback().state.airborne
        drone.land(timeout_s=WITHIN_S)


def test_it_flies_a_square(firmware: Firmware, proxy: Callable[..., Process]) -> None:
    _, address = firmware("--world", "empty", "--option", "wind=0")
    proxy(address)
    with skyloop.connect("alpha") as drone:
        ready(drone)
        drone.takeoff(timeout_s=WITHIN_S)
        off = []
        for x, y in ((1, 0), (1, 1), (0, 1), (0, 0)):
            drone.go_to(x=x * SIDE_M, y=y * SIDE_M, z=HEIGHT_M, timeout_s=WITHIN_S)
            time.sleep(1.0)  # it comes to rest
            off.append(math.dist(place(drone), (x * SIDE_M, y * SIDE_M, HEIGHT_M)))
        print("corners off by", [round(each, 3) for each in off])
        assert max(off) < MOST_OFF_M, off
        drone.land(timeout_s=WITHIN_S)


def test_a_killed_pilot_leaves_it_hovering_and_then_landing(
    firmware: Firmware, proxy: Callable[..., Process], start: Callable[..., Process]
) -> None:
    _, address = firmware("--world", "empty", "--lose", "0.1")
    proxy(address)
    with skyloop.connect("alpha", access="observe") as observer:
        ready(observer)
        pilot = start(PILOTS, "fly", "alpha")
        pilot.until("flying", WITHIN_S)
        observer.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.2, timeout_s=30.0)
        pilot.signal(signal.SIGKILL)
        begun_s = time.monotonic()
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
        hover_s = time.monotonic() - begun_s
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=30.0)
        land_s = time.monotonic() - begun_s
        observer.wait("landed", timeout_s=30.0)
        landed_s = time.monotonic() - begun_s
        print(f"pilot killed: hover {hover_s:.2f} s, land {land_s:.2f} s, landed {landed_s:.2f} s")
        assert landed_s - land_s > 2.0, "it fell"


def test_without_its_proxy_it_hovers_until_the_next_lands_it(firmware: Firmware, proxy: Callable[..., Process]) -> None:
    """A velocity is being flown when the proxy dies: it comes to rest by itself, in the air."""
    _, address = firmware("--world", "empty", "--option", "wind=0")
    first = proxy(address)
    with skyloop.connect("alpha") as drone:
        ready(drone)
        drone.takeoff(timeout_s=WITHIN_S)
        before = moving(drone)
        first.signal(signal.SIGKILL)
        first.wait()
        drone.close()
    time.sleep(4.0)  # more than after which set-points that end would make it fall
    proxy(address, "beta")
    with skyloop.connect("beta") as drone:
        eventually(lambda: drone.feedback().state.airborne, "it is found in the air", WITHIN_S)
        after = place(drone)
        print(f"proxy killed: moved {math.dist(after, before):.2f} m, to a height of {after[2]:.2f} m")
        assert math.dist(after, before) < 0.7
        assert after[2] > HEIGHT_M / 2
        drone.land(timeout_s=WITHIN_S)


def test_without_its_link_it_hovers(firmware: Firmware, proxy: Callable[..., Process]) -> None:
    _, address = firmware("--world", "empty", "--option", "wind=0")
    link = Link(int(address.rpartition(":")[2]))
    proxy(link.address)
    with skyloop.connect("alpha") as drone:
        ready(drone)
        drone.takeoff(timeout_s=WITHIN_S)
        for cut_s in (1.0, 3.0):
            before = moving(drone)
            link.on = False
            time.sleep(cut_s)
            seen = drone.link.vehicle
            link.on = True
            found_s = eventually(lambda: drone.link.vehicle is LinkState.UP, "it is found again", WITHIN_S)
            moved = math.dist(place(drone), before)
            print(f"link cut for {cut_s} s: {seen.value}, found after {found_s:.2f} s, moved {moved:.2f} m")
            assert seen is (LinkState.DEGRADED if cut_s < 1.5 else LinkState.LOST)
            assert drone.feedback().state.airborne
            assert moved < 0.7
            assert place(drone)[2] > HEIGHT_M / 2
        drone.land(timeout_s=WITHIN_S)


def test_firmware_that_is_killed_in_flight_is_found_again(firmware: Firmware, proxy: Callable[..., Process]) -> None:
    port = free_port(socket.SOCK_DGRAM)
    first, address = firmware("--world", "empty", port=port)
    proxy(address)
    with skyloop.connect("alpha") as drone:
        ready(drone)
        drone.takeoff(timeout_s=WITHIN_S)
        first.signal(signal.SIGKILL)
        begun_s = time.monotonic()
        first.wait()
        eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is reported", WITHIN_S)
        lost_s = time.monotonic() - begun_s
        firmware("--world", "empty", port=port)
        started_s = time.monotonic()
        ready(drone)
        print(f"firmware killed: lost after {lost_s:.2f} s, ready {time.monotonic() - started_s:.2f} s after its start")
        time.sleep(1.0)
        assert drone.feedback().state is FlightState.LANDED, "nothing flies it without a new take-off"
        drone.takeoff(timeout_s=WITHIN_S)
        drone.land(timeout_s=WITHIN_S)
