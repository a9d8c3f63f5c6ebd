"""The receiver on the emulated drones' video."""

from __future__ import annotations

import time

import numpy as np
import pytest

from skyloop.clock import seconds
from skyloop.drivers.live_video import VideoEvent
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports, with_ardrones
from skyloop.vehicles.ardrone.video import VideoReceiver
from tests.vehicles.ardrone.video_ports import HOST, Viewer


@pytest.mark.parametrize(
    ("version", "header_size", "size", "fps"),
    [(1, 68, (320, 240), 15), (2, 64, (640, 360), 30), (2, 68, (640, 360), 30)],
)
def test_pictures_arrive_in_time_also_after_a_restart(
    version: int, header_size: int, size: tuple[int, int], fps: int
) -> None:
    host = SimHost(with_ardrones(SimOptions(world="room", seed=1)))
    viewer = Viewer()
    with ArdroneFirmware(host, version=version, ports=Ports.free(), header_size=header_size) as firmware:
        receiver = VideoReceiver(
            HOST, firmware.ports.video, version=version, show=viewer.show, on_event=viewer.on_event
        )
        receiver.start()
        viewer.wait(lambda: len(viewer.seen) >= 15, "15 pictures")
        now_ns = time.monotonic_ns()
        assert seconds(now_ns - viewer.seen[-1][1]) < 1.0
        firmware.stop()
        if version == 2:
            viewer.wait(lambda: viewer.texts(VideoEvent.LOST), "the loss")
        before = len(viewer.seen)
        firmware.start()
        viewer.wait(lambda: len(viewer.seen) >= before + 15, "pictures after the restart")

        def period_s() -> float:  # of the last 15; a busy machine draws fewer
            return float(np.median(np.diff([taken_ns for _, taken_ns, _ in viewer.seen[before:][-15:]]) / 1e9))

        viewer.wait(lambda: period_s() < 6 / fps, "at their rate")
        receiver.stop()
    assert viewer.sizes == {size}
    assert receiver.counters.damaged <= 2  # the one in flight at the switch-off, and a stale first frame
    periods_s = np.diff([taken_ns for _, taken_ns, _ in viewer.seen[before:]]) / 1e9
    assert 0.7 / fps < np.median(periods_s)
