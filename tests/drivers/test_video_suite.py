"""The video driver keeps the drivers' contract."""

from __future__ import annotations

from pathlib import Path

from skyloop.drivers.suite import DriverSuite

DATA = Path(__file__).parents[1] / "data" / "ardrone2"


class TestPaveVideo(DriverSuite):
    uri = f"video://{DATA / 'video-8s.pave'}?loop=1"
