"""How an emulated AR.Drone is made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from skyloop.sim.options import SimOptions
from skyloop.sim.vehicles import AR_DRONE
from skyloop.transport.faults import Faults
from skyloop.wire.ardrone.ports import Ports

REPORTS_HZ: Final = 125.0  #: as often as a world that keeps time reports


def with_ardrones(options: SimOptions | None = None) -> SimOptions:
    """Options of a world whose drones are AR.Drones: its identified response, full navdata as often as there can be.

    Cameras are the firmware's own, whatever the options say.
    """
    return replace(options or SimOptions(), parameters=AR_DRONE, rate_hz=REPORTS_HZ, cameras=())


@dataclass(frozen=True, slots=True)
class Settings:
    """As :class:`skyloop.sim.firmware.ardrone.ArdroneFirmware` takes them."""

    version: int
    bind: str
    ports: Ports
    faults: Faults
    delay_s: float
    header_size: int
    torn_start: bool
