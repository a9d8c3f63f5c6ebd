"""Flies an AR.Drone with pyardrone alone, without Skyloop: ``python fly_pyardrone.py HOST``.

Writes its observations as one line of JSON. Runs with the Python of an environment that has pyardrone 0.6.1 and OpenCV.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import cv2  # noqa: F401  without it pyardrone has no video
from pyardrone import ARDrone, at

PATIENCE_S = 30.0
LANDED, FLYING, HOVERING = 2, 3, 4  # major numbers of ctrl_state
REPEAT_S = 0.03


class Saw:
    """The data and pictures received from the drone."""

    def __init__(self, drone: Any) -> None:
        self.drone = drone
        self.navdata = 0
        self.pictures = 0
        self.sizes: set[tuple[int, ...]] = set()
        self.contrast = 0.0
        take_navdata = drone.navdata_client.navdata_received

        def navdata_received(data: bytes) -> None:
            take_navdata(data)
            self.navdata += 1

        drone.navdata_client.navdata_received = navdata_received
        drone.video_client.frame_recieved = self.picture  # pyardrone's spelling

    def picture(self, image: Any) -> None:
        if image is not None:
            self.pictures += 1
            self.sizes.add(image.shape)
            self.contrast = float(image.std())

    @property
    def demo(self) -> Any:
        return getattr(getattr(self.drone.navdata_client, "navdata", None), "demo", None)

    @property
    def state(self) -> int | None:
        return self.demo.ctrl_state >> 16 if self.demo else None


def repeat_until(send: Callable[[], object], done: Callable[[], bool], what: str) -> None:
    """Repeat a command, as the drone requires, until navdata shows its effect."""
    deadline = time.monotonic() + PATIENCE_S
    while not done():
        if time.monotonic() > deadline:
            raise SystemExit(f"waited {PATIENCE_S} s without success: {what}")
        send()
        time.sleep(REPEAT_S)


def main(host: str) -> None:
    drone = ARDrone(host=host)
    saw = Saw(drone)
    try:
        repeat_until(
            lambda: (drone.send(at.CONFIG("general:navdata_demo", "TRUE")), drone.send(at.CTRL(5))),
            lambda: saw.demo is not None,
            "navdata with the demo option",
        )
        battery = saw.demo.vbat_flying_percentage
        repeat_until(drone.takeoff, lambda: saw.state in (FLYING, HOVERING), "take-off")
        repeat_until(drone.hover, lambda: saw.demo.altitude > 500, "altitude")
        begin_s = time.monotonic()
        speeds: list[float] = []

        def forward() -> None:
            drone.move(forward=0.3)
            speeds.append(saw.demo.vx)

        repeat_until(forward, lambda: time.monotonic() - begin_s > 1.5, "flight forward")
        state = drone.state
        repeat_until(drone.hover, lambda: saw.pictures >= 10, "ten decoded pictures")
        repeat_until(drone.land, lambda: saw.state == LANDED, "landing")
        print(
            json.dumps(
                {
                    "navdata": saw.navdata,
                    "battery": battery,
                    "flew": bool(state.fly_mask),
                    "fastest_mm_s": max(speeds),
                    "pictures": saw.pictures,
                    "sizes": sorted(saw.sizes),
                    "contrast": saw.contrast,
                }
            ),
            flush=True,
        )
    finally:
        for client in (drone.at_client, drone.navdata_client):
            client.close()
        assert not [t for t in threading.enumerate() if t is not threading.main_thread() and not t.daemon]


if __name__ == "__main__":
    main(sys.argv[1])
    sys.stdout.flush()
    os._exit(0)  # its threads may still be in OpenCV, which crashes on the interpreter's normal exit
