"""Run the pilot's application with a callback that takes 200 ms a frame, on its own thread as by default."""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from benchmarks.measuring import ours
from benchmarks.measuring.contract import Received
from benchmarks.measuring.schedule import VIDEO
from skyloop.bench import CAMERA
from skyloop.client import Frame

SLOW_S: Final = 0.2
SLOW_VIDEO: Final = f"{VIDEO}, slow processor"


class Application(ours.Application):
    """The pilot's end with the slow processor."""

    def __init__(self, address: str, received: Received) -> None:
        super().__init__(address, received)

        def slow(frame: Frame) -> None:
            received(SLOW_VIDEO, frame.captured_ns)
            until = time.monotonic() + SLOW_S
            mean = np.zeros(frame.shape, np.float32)
            while time.monotonic() < until:  # like image processing, which works on arrays for long
                mean += 0.1 * (frame - mean)

        self._drone.on_frame(slow, camera=CAMERA)
