"""Skyloop's ends of ``benchmarks.video_path``: a camera that moves, and a pilot who watches it in one form or none."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from benchmarks import over_network
from benchmarks.moving_scene import MovingScene
from benchmarks.video_judge import SIZE, Judge
from skyloop.bench.contract import Image, Received
from skyloop.bench.schedule import VIDEO
from skyloop.bench.vehicle import CAMERA
from skyloop.client import Drone, Frame
from skyloop.client.channels import VideoOptions
from skyloop.messages import CameraInfo

FPS: Final = 30.0
NO_VIDEO: Final = "no video"
FIXED_KBIT_S: Final = 1000
FORMS: Final[Mapping[str, VideoOptions | None]] = MappingProxyType(
    {
        NO_VIDEO: None,
        "JPEG": VideoOptions(),
        f"H.264, {FIXED_KBIT_S} kbit/s": VideoOptions(encoding="h264", kbit_s=FIXED_KBIT_S),
        "H.264, adaptive": VideoOptions(encoding="h264"),
    }
)


def address(form: str, place: str) -> str:
    """Return the address for both ends: of the proxy on the network, and the form of the video."""
    return f"{form}|{over_network.address('alpha', place)}"


class Vehicle(over_network.Vehicle):
    """The drone."""

    camera = CameraInfo(CAMERA, SIZE.width, SIZE.height, FPS)

    def __init__(self, address: str, received: Received) -> None:
        super().__init__(address.partition("|")[2], received)
        self._scene = MovingScene(SIZE)

    def frame(self, sent_ns: int, image: Image) -> None:  # noqa: ARG002  (a moving scene instead)
        """Send what the camera sees."""
        self._vehicle.show(sent_ns, self._scene.picture(sent_ns))


class Application(over_network.Application):
    """The pilot."""

    def __init__(self, address: str, received: Received) -> None:
        form, _, place = address.partition("|")
        options = FORMS[form]
        self.looks = False
        self._judge = Judge(received)
        super().__init__(place, received)
        if options is not None:
            self._watch(self._drone, options, received)

    def _watch(self, drone: Drone, options: VideoOptions, received: Received) -> None:
        def show(frame: Frame) -> None:
            received(VIDEO, frame.captured_ns)
            self._judge.look(frame, frame.captured_ns)

        drone.on_frame(show, camera=CAMERA, **options)
