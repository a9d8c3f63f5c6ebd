"""The drivers' contract, checked with a recording and with a camera over RTSP."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import parse_uri
from tests.support.film import HEIGHT, WIDTH, Film, Projector
from tests.support.recordings import FIXTURES, needs_recordings
from tests.support.rtsp_server import RtspServer


@needs_recordings
class TestPaveVideo(DriverSuite):
    uri = f"video://{FIXTURES}/ardrone2/video-8s.pave?loop=1"


class TestRtspCamera(DriverSuite):
    uri = "video://rtsp://127.0.0.1/live"

    @pytest.fixture(autouse=True)
    def _camera(self) -> Iterator[None]:
        with RtspServer(Film().next().payload) as self.server, Projector(self.server.send):
            yield

    def new_driver(self) -> Driver:
        return self.make(parse_uri(f"video://{self.server.address}?width={WIDTH}&height={HEIGHT}&fps=25"))

    def vehicle_disappears(self) -> None:
        self.server.stop()

    def vehicle_appears(self) -> None:
        self.server.start()
