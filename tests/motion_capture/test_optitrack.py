"""The recorded OptiTrack session, through the ``motioncapture`` package and our listening process."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

import skyloop
from skyloop.errors import LinkError, NoAnswerError
from skyloop.motion_capture import BodyPose, MotionCapture, TrackState, mocap
from skyloop.motion_capture.pose import z_up
from skyloop.motion_capture.source import ChildSource
from skyloop.transport.testing import wait_until
from tests.motion_capture import natnet
from tests.support.processes import Process
from tests.support.recordings import recorded

pytest.importorskip("motioncapture", reason="needs the motioncapture package: skyloop install mocap")
pytestmark = pytest.mark.process
ENOUGH = 200


@pytest.fixture
def server() -> Iterator[Process]:
    recorded(natnet.SESSION)
    process = Process("-m", "tests.motion_capture.natnet", "0")
    try:
        process.until("ready")
        yield process
    finally:
        process.end()


def address(server: Process) -> str:
    port = server.text.split("ready ")[1].split()[0]
    return f"optitrack://127.0.0.1?interface=127.0.0.1&port={port}"


def connect(server: Process) -> MotionCapture:
    return mocap(address(server), {"alpha": natnet.BODY})


def test_the_recorded_poses_arrive_in_our_axes(server: Process) -> None:
    bodies = [natnet.rigid_body(frame) for frame in natnet.frames()]
    assert len(bodies) == 518
    expected = {z_up(body.position, body.quaternion) for body in bodies if body.tracked}
    seen: list[BodyPose] = []
    with connect(server) as capture:
        pose = capture.wait("alpha")
        with capture.on_pose(seen.append, inline=True):
            wait_until(lambda: len(seen) >= ENOUGH, "poses came")
        assert capture.state("alpha") is TrackState.TRACKED
        assert capture.unknown == set()
    assert all((pose.position_m, pose.quaternion) in expected for pose in seen)
    assert len({pose.position_m for pose in seen}) > ENOUGH / 2, "the poses differ"
    assert [pose.captured_ns for pose in seen] == sorted({pose.captured_ns for pose in seen})
    assert 1.3 < pose.position_m[2] < 1.6, "it flew at head height: z is up"
    assert pose.transform.rotation.as_matrix().shape == (3, 3)


def test_a_stopped_server_is_reported_and_a_frozen_pose_never_returned(server: Process) -> None:
    with connect(server) as capture:
        capture.wait("alpha")
        told: list[str] = []
        with capture.on_event(lambda event: told.append(event.text)):
            server.signal(signal.SIGSTOP)
            wait_until(lambda: "alpha is no longer tracked" in told, "it was told")
            assert capture.pose("alpha") is None
            assert capture.state("alpha") is TrackState.LOST
            server.signal(signal.SIGCONT)
            wait_until(lambda: "alpha is tracked again" in told, "it was told")
            assert capture.pose("alpha") is not None


def test_the_listening_process_is_replaced_when_it_dies(server: Process) -> None:
    with connect(server) as capture:
        capture.wait("alpha")
        source = capture._source
        assert isinstance(source, ChildSource)
        assert source.pid is not None
        told: list[str] = []
        with capture.on_event(lambda event: told.append(event.text)):
            os.kill(source.pid, signal.SIGKILL)
            wait_until(lambda: any("trying again" in text for text in told), "it was told")
    assert capture.state("alpha") is TrackState.ENDED
    with pytest.raises(skyloop.ClosedError):
        capture.wait("alpha", 0.1)


def test_the_error_about_an_unknown_body_lists_the_visible_ones(server: Process) -> None:
    with mocap(address(server), {"alpha": "RaceQuadd"}) as capture:
        wait_until(lambda: capture.unknown, "it saw another one")
        with pytest.raises(NoAnswerError, match=r"does not track 'RaceQuadd'.*it sees RaceQuad"):
            capture.wait("alpha", 0.2)


def test_a_missing_server_is_a_link_error() -> None:
    with pytest.raises(LinkError, match=r"sent no frame within 0\.3 s"):
        mocap("optitrack://127.0.0.1?interface=127.0.0.1&port=9", {"alpha": "x"}, timeout_s=0.3)
