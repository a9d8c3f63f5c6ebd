"""Vicon and Qualisys through the clients in the ``motioncapture`` package, and VRPN through ours, against small servers
written from public facts."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator

import pytest

from skyloop.errors import LinkError
from skyloop.motion_capture import BodyPose, TrackState, mocap
from skyloop.transport.testing import wait_until
from tests.motion_capture.moving import BODIES, frame_of, pose
from tests.support.processes import Process

pytest.importorskip("motioncapture", reason="needs the motioncapture package: skyloop install mocap")
pytestmark = pytest.mark.process
ENOUGH = 50
QUALISYS_FRAMES_PORT = 6734  #: UDP port of this host where the package receives frames, regardless of the address


def busy(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            one.bind(("", port))
        except OSError:
            return True
    return False


@pytest.fixture(params=["vicon", "qualisys", "vrpn"])
def address(request: pytest.FixtureRequest) -> Iterator[str]:
    """The address of a running server."""
    system = str(request.param)
    if system == "qualisys" and busy(QUALISYS_FRAMES_PORT):
        pytest.skip(f"UDP port {QUALISYS_FRAMES_PORT} of this host, which the package uses, is taken")
    process = Process("-m", f"tests.motion_capture.{system}", "0")
    try:
        process.until("ready")
        yield f"{system}://127.0.0.1:{process.text.split('ready ')[1].split()[0]}"
    finally:
        process.end()


def test_the_servers_poses_arrive(address: str) -> None:
    body, hidden = BODIES
    seen: list[BodyPose] = []
    with mocap(address, {"alpha": body, "beta": hidden}) as capture:
        capture.wait("alpha", 20.0)
        with capture.on_pose(seen.append, inline=True):
            wait_until(lambda: len(seen) >= ENOUGH, "poses came")
        assert capture.state("beta") is TrackState.WAITING, "beta is hidden"
        assert capture.unknown == set()
    assert {one.body for one in seen} == {"alpha"}
    for one in seen:
        place, yaw = pose(frame_of(one.position_m[2]))
        assert one.position_m == pytest.approx(place, abs=1e-6), "metres, z up"
        assert math.remainder(one.yaw_rad - yaw, math.tau) == pytest.approx(0.0, abs=1e-5)
    assert len({one.position_m for one in seen}) > ENOUGH / 2, "the poses differ"


@pytest.fixture
def vicon() -> Iterator[Process]:
    process = Process("-m", "tests.motion_capture.vicon", "0")
    try:
        process.until("ready")
        yield process
    finally:
        process.end()


def test_the_end_of_a_vicon_server_is_reported_and_its_last_pose_dropped(vicon: Process) -> None:
    with mocap(f"vicon://127.0.0.1:{vicon.text.split('ready ')[1].split()[0]}", {"alpha": BODIES[0]}) as capture:
        capture.wait("alpha", 20.0)
        vicon.end()
        wait_until(lambda: capture.state("alpha") is TrackState.LOST, "it was lost")
        assert capture.pose("alpha") is None


@pytest.mark.parametrize("system", ["vicon", "qualisys", "vrpn"])
def test_a_missing_server_is_a_link_error(system: str) -> None:
    with pytest.raises(LinkError, match=r"sent no frame within 0\.3 s"):
        mocap(f"{system}://127.0.0.1:9", {"alpha": "x"}, timeout_s=0.3)
