"""A vehicle that knows its position and sends images."""

from __future__ import annotations

import cv2
import numpy as np

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.messages import CameraInfo, Capabilities, Encoding, Feedback, Intrinsics
from tests.support.fake_vehicle import PERIOD_S, FakeVehicle

INTRINSICS = Intrinsics(30.0, 30.0, 16.0, 12.0)


def picture(captured_ns: int) -> np.ndarray:
    """Return the camera's image at a time, BGR, shape (24, 32, 3), uint8."""
    number = captured_ns // 1_000_000
    image = np.full((24, 32, 3), (number % 256, 128, 255 - number % 256), np.uint8)
    image[: number % 24, : number % 32] = 0
    return image


class Vehicle(FakeVehicle):
    """Knows its position, and sends images in the wanted encoding."""

    def __init__(self, encoding: Encoding = Encoding.BGR8) -> None:
        super().__init__()
        self.encoding = encoding

    def capabilities(self) -> Capabilities:
        able = super().capabilities()
        camera = CameraInfo("front", 32, 24, 1 / PERIOD_S, self.encoding, INTRINSICS)
        return Capabilities(able.vehicle, able.actions, (camera,))

    def shown(self, captured_ns: int) -> bytes:
        image = picture(captured_ns)
        if self.encoding is Encoding.JPEG:
            return cv2.imencode(".jpg", image)[1].tobytes()
        if self.encoding is Encoding.RGB8:
            return image[:, :, ::-1].tobytes()
        return image[:, :, 0].tobytes() if self.encoding is Encoding.MONO8 else image.tobytes()

    def _run(self, sink: Sink) -> None:
        number = 0
        while not self._ended.wait(PERIOD_S):
            number += 1
            now_ns = monotonic_ns()
            place = (number * 0.01, 0.0, 1.0)
            sink.feedback(
                Feedback(
                    captured_ns=now_ns, state=self.state, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.1, position_m=place
                )
            )
            if sink.wants("front"):
                pixels = np.frombuffer(self.shown(now_ns), np.uint8)
                sink.frame("front", pixels, now_ns, width=32, height=24, encoding=self.encoding, intrinsics=INTRINSICS)
