"""Skyloop's own ends over the portable side of the local transport."""

from __future__ import annotations

import os

from benchmarks.measuring.ours import Application
from benchmarks.measuring.ours import Vehicle as NearVehicle
from skyloop.transport.base import TransportServer
from skyloop.transport.local.system import PORTABLE, TRANSPORT_VARIABLE

__all__ = ["Application", "Vehicle"]


class Vehicle(NearVehicle):
    """The vehicle's end."""

    def _server(self, folder: str) -> tuple[str, TransportServer]:
        os.environ[TRANSPORT_VARIABLE] = PORTABLE
        return super()._server(folder)
