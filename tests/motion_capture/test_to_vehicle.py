"""Motion capture poses sent to the vehicle: an emulated PX4 without GPS flies by them, and only then."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

import skyloop
from skyloop.clock import monotonic_ns
from skyloop.errors import AuthorityError, UsageError
from skyloop.motion_capture import MotionCapture, parse_system
from skyloop.motion_capture.source import RawFrame
from skyloop.transport.testing import wait_until

pytest.importorskip("pymavlink", reason="needs pymavlink: skyloop install mavlink")
pytestmark = pytest.mark.process


class Nothing:
    """A source whose frames the test provides."""

    def start(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


@contextmanager
def seeing(name: str) -> Iterator[MotionCapture]:
    """A body at the origin that trembles by micrometres, seen fifty times a second."""
    capture = MotionCapture(parse_system("vicon://nowhere"), {name: "body"}, lambda *_: Nothing())
    ended = threading.Event()

    def see() -> None:
        for number in itertools.count():
            if ended.wait(0.02):
                return
            capture._take(RawFrame(monotonic_ns(), {"body": ((0.0, 1e-6 * (number % 7), 0.1), (0.0, 0.0, 0.0, 1.0))}))

    thread = threading.Thread(target=see)
    with capture._open():
        thread.start()
        try:
            yield capture
        finally:
            ended.set()
            thread.join()


def test_an_autopilot_without_gps_flies_by_them() -> None:
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions
    from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors

    host = SimHost(with_multirotors(SimOptions(world="empty", seed=4, wind=0.0, speed=3.0)), 1)
    with (
        MavlinkFirmware(host, kind=Kind.PX4, ports=Ports.free(Kind.PX4), boot_s=0.5, gps=False) as it,
        skyloop.connect(f"{it.address}?origin=47.4,8.5,488", timeout_s=20.0) as drone,
        seeing(drone.name) as capture,
    ):
        with capture.link(drone):
            wait_until(lambda: capture.pose(drone.name), "it is seen")
            assert it.autopilot.poses == 0, "logged on the drone, not sent to the vehicle"
        with capture.link(drone, to_vehicle=True):
            wait_until(lambda: it.autopilot.poses > 20, "the autopilot heard them")
            drone.takeoff()
            assert drone.feedback().state.airborne
            drone.land()


def test_who_may_send_poses_and_which() -> None:
    with skyloop.connect("sim://?cameras=none") as drone:
        with pytest.raises(UsageError, match=r"position must have 3 finite numbers \(x, y, z\), got \(0"):
            drone.send_external_pose((0.0, 0.0, float("nan")), (0.0, 0.0, 0.0, 1.0))
        with pytest.raises(UsageError, match=r"attitude_std_rad is -0\.1 and must be 0 or more"):
            drone.send_external_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), attitude_std_rad=-0.1)
        with pytest.raises(UsageError, match=r"quaternion must have 4 finite numbers \(x, y, z, w\), got \(0, 0, 1\)"):
            drone.send_external_pose((0.0, 0.0, 0.0), (0, 0, 1))  # type: ignore[arg-type]
        told: list[str] = []
        with drone.on_event(lambda event: told.append(event.text), inline=True):
            assert drone.send_external_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            wait_until(lambda: any("sim:// does not accept external poses" in text for text in told), "it was told")
        with (
            skyloop.connect(drone.name, access="observe") as onlooker,
            pytest.raises(AuthorityError, match="this application only observes"),
        ):
            onlooker.send_external_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
