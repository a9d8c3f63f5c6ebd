"""Skyloop's ends of ``benchmarks.video_path``: a moving camera, and a pilot who watches it in one encoding or none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Final

from benchmarks import over_network
from benchmarks.measuring.contract import Image, Received
from benchmarks.measuring.schedule import VIDEO
from benchmarks.moving_scene import MovingScene
from benchmarks.video_judge import SIZE, Judge
from skyloop.bench import CAMERA
from skyloop.client import Drone, Frame
from skyloop.client.video import VideoOptions
from skyloop.messages import CameraInfo
from skyloop.network import FabricServer
from skyloop.network.config import LEASE_S as DEFAULT_LEASE_S
from skyloop.transport.base import TransportServer

FPS: Final = 30.0
NO_VIDEO: Final = "no video"
FIXED_KBIT_S: Final = 1000
LEASE_S: Final = 10.0
PATIENT: Final = f"H.264, adaptive, lease {LEASE_S:g} s"  #: the pilot waits longer for a silent drone
FORMS: Final[Mapping[str, VideoOptions | None]] = MappingProxyType(
    {
        NO_VIDEO: None,
        "JPEG": VideoOptions(),
        f"H.264, {FIXED_KBIT_S} kbit/s": VideoOptions(encoding="h264", kbit_s=FIXED_KBIT_S),
        "H.264, adaptive": VideoOptions(encoding="h264"),
        PATIENT: VideoOptions(encoding="h264"),
    }
)


def address(form: str, place: str) -> str:
    """Return the address for both ends: the proxy's on the network, and the form of the video."""
    return f"{form}|{over_network.address('alpha', place)}"


def _lease_s(form: str) -> float:
    return LEASE_S if form == PATIENT else DEFAULT_LEASE_S


class Vehicle(over_network.Vehicle):
    """The drone."""

    camera = CameraInfo(CAMERA, SIZE.width, SIZE.height, FPS)

    def __init__(self, address: str, received: Received) -> None:
        form, _, place = address.partition("|")
        self._lease_s = _lease_s(form)
        super().__init__(place, received)
        self._scene = MovingScene(SIZE)

    def _server(self, address: str) -> tuple[str, TransportServer]:
        name, settings = over_network.settings_of(address, serves=True)
        return name, FabricServer(name, replace(settings, lease_s=self._lease_s))

    def frame(self, sent_ns: int, image: Image) -> None:  # noqa: ARG002  (a moving scene instead)
        """Send the camera's view."""
        self._vehicle.show(sent_ns, self._scene.picture(sent_ns))


class Application(over_network.Application):
    """The pilot."""

    def __init__(self, address: str, received: Received) -> None:
        form, _, place = address.partition("|")
        options = FORMS[form]
        self.looks = False
        self._lease_s = _lease_s(form)
        self._judge = Judge(received)
        super().__init__(place, received)
        if options is not None:
            self._watch(self._drone, options, received)

    def _connect(self, address: str) -> Drone:
        return over_network.connect(address, lease_s=self._lease_s)

    def _watch(self, drone: Drone, options: VideoOptions, received: Received) -> None:
        def show(frame: Frame) -> None:
            received(VIDEO, frame.captured_ns)
            self._judge.look(frame, frame.captured_ns)

        drone.on_frame(show, camera=CAMERA, **options)
