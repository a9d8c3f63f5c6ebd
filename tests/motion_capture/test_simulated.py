"""The simulator's truth as motion capture: a flight by it, recorded and shown in the cockpit."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import skyloop
from skyloop.cockpit.telemetry import mocap_values
from skyloop.control import FollowPath, Polyline
from skyloop.errors import ClosedError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages import LogEntry
from skyloop.motion_capture import BodyPose, TrackState
from skyloop.transport.testing import wait_until
from tests.support import recording_files as files
from tests.support.processes import Process

pytestmark = pytest.mark.process
TRUE = "sim://?world=empty&cameras=none&wind=0&truth=1"
Proxy = Callable[..., Process]


def test_a_path_is_flown_by_motion_capture_recorded_and_the_truth(proxy: Proxy, tmp_path: Path) -> None:
    proxy(TRUE)
    path = tmp_path / "flight.mcap"
    with skyloop.connect("alpha") as drone, skyloop.mocap("sim://", {"alpha": "alpha"}) as capture:
        assert capture.wait("alpha").position_m[2] < 0.2
        found = capture.calibrate(drone, seconds=1.0)
        assert found.spread_m < 0.001
        assert found.poses >= 20
        with skyloop.record(drone, path), capture.link(drone):
            drone.takeoff()
            follow = FollowPath(drone, Polyline([(0, 0, 1), (0.6, 0.0, 1.0)]), source=capture.source(drone))
            summary = follow.run(seconds=20)
            assert follow.done, summary
            pose = capture.wait("alpha")
            assert math.dist(pose.position_m, (0.6, 0.0, 1.0)) < 0.3
            wait_until(lambda: capture.wait("alpha").velocity_m_s is not None, "two poses in a row tell its velocity")
            with pytest.raises(UsageError, match="alpha is flying"):
                capture.calibrate(drone)
            drone.land()
    told = files.decoded(path, "/alpha/mocap")
    assert len(told) > 50
    assert max(message.pose.position.z for message in told) > 0.8
    with pytest.raises(UnknownNameError, match="no body named 'alfa'; did you mean 'alpha'"):
        capture.pose("alfa")
    assert capture.state("alpha") is TrackState.ENDED


def test_poses_are_logged_on_the_drone_at_a_limited_rate(proxy: Proxy) -> None:
    proxy(TRUE)
    entries: list[LogEntry] = []
    poses: list[BodyPose] = []
    with (
        skyloop.connect("alpha", access="observe") as drone,
        skyloop.mocap("sim://", {"alpha": "alpha"}) as capture,
        drone.on_log(entries.append, inline=True),
    ):
        with capture.on_pose(poses.append, inline=True), capture.link(drone, max_hz=10.0) as linked:
            wait_until(lambda: len(entries) >= 5, "poses were told")
            linked.close()
            linked.close()
        times = [entry.at_ns for entry in entries if entry.values is not None]
        assert min(np.diff(times)) > 70_000_000
        values = entries[-1].values
        assert values is not None
        assert values[:7] == pytest.approx([*poses[-1].position_m, *poses[-1].quaternion], abs=0.05)
        shown = mocap_values(values)
        assert shown is not None
        assert shown["yaw"] == pytest.approx(poses[-1].yaw_rad, abs=0.01)
        for wrong in (0.0, math.nan):
            with pytest.raises(UsageError, match="max_hz"):
                capture.link(drone, max_hz=wrong)


def test_the_end_of_a_proxy_is_a_loss_of_tracking(proxy: Proxy) -> None:
    process = proxy(TRUE)
    with skyloop.mocap("sim://", {"alpha": "alpha"}) as capture:
        capture.wait("alpha")
        told: list[str] = []
        with capture.on_event(lambda event: told.append(event.text)):
            process.end()
            wait_until(lambda: "alpha is no longer tracked" in told, "it was told")
        assert capture.pose("alpha") is None


def test_a_vehicle_without_truth_says_how_to_get_it(proxy: Proxy) -> None:
    proxy("sim://?world=empty&cameras=none&truth=0")
    with pytest.raises(UnsupportedError, match=r"truth=1"):
        skyloop.mocap("sim://", {"alpha": "alpha"})
    with pytest.raises(UnknownNameError, match="no proxy named 'bravo'"):
        skyloop.mocap("sim://", {"bravo": "bravo"})


@pytest.mark.parametrize("bodies", [{}, {"alpha": ""}, {"alpha": 3}, {"alpha": "x", "bravo": "x"}])
def test_bodies_must_be_names(bodies: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="bodies"):
        skyloop.mocap("sim://", bodies)


def test_a_callback_must_be_a_function_and_a_failing_one_affects_no_other(
    proxy: Proxy, caplog: pytest.LogCaptureFixture
) -> None:
    proxy(TRUE)
    with skyloop.mocap("sim://", {"alpha": "alpha"}) as capture:
        with pytest.raises(UsageError, match="can't be called"), capture.on_pose(3):  # type: ignore[arg-type]
            pass
        seen: list[BodyPose] = []

        def fail(_: BodyPose) -> None:
            raise RuntimeError("on purpose")

        with capture.on_pose(fail), capture.on_pose(seen.append):
            wait_until(lambda: seen, "the other one was called")

        others: list[BodyPose] = []
        listener = capture.on_pose(others.append)  # without a block
        wait_until(lambda: others, "it is called from then on")
        listener.cancel()
        listener.cancel()
        assert (listener.delivered, listener.errors) == (len(others), 0)
        count, before = len(others), len(seen)
        with capture.on_pose(seen.append):
            wait_until(lambda: len(seen) > before + 1, "others go on")
        assert len(others) == count
        blocked, freed = threading.Event(), threading.Event()

        def slow(_: BodyPose) -> None:
            blocked.set()
            freed.wait(10.0)

        with capture.on_pose(slow) as waiting:
            wait_until(blocked.is_set, "it is called")
            before = len(seen)
            with capture.on_pose(seen.append):
                wait_until(lambda: waiting.dropped > 3 and len(seen) > before, "it delays nobody and its drops count")
            freed.set()
        with pytest.raises(UsageError, match="depth is 0"):
            capture.on_pose(print, depth=0)
    told = "motion capture's pose callback raised RuntimeError('on purpose')"
    wait_until(lambda: told in caplog.text, "its own thread logs it")
    with pytest.raises(ClosedError):
        capture.on_pose(print)
