"""The video driver keeps the drivers' contract."""

from __future__ import annotations

from skyloop.drivers.suite import DriverSuite
from tests.recordings import FIXTURES, needs_recordings


@needs_recordings
class TestPaveVideo(DriverSuite):
    uri = f"video://{FIXTURES}/ardrone2/video-8s.pave?loop=1"
