"""Settings of an emulated AR.Drone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from skyloop.faults import Faults
from skyloop.sim.options import SimOptions
from skyloop.sim.vehicles import AR_DRONE
from skyloop.vehicles.ardrone.wire.ports import Ports

REPORTS_HZ: Final = 125.0  #: as often as a world that keeps time reports


def with_ardrones(options: SimOptions | None = None) -> SimOptions:
    """Return options of a world whose drones are AR.Drones: their identified response, navdata as often as possible.

    Cameras are the firmware's own, whatever the options say.
    """
    return replace(options or SimOptions(), parameters=AR_DRONE, rate_hz=REPORTS_HZ, cameras=())


@dataclass(frozen=True, slots=True)
class Settings:
    """The arguments of :class:`skyloop.vehicles.ardrone.emulator.ArdroneFirmware`."""

    version: int
    bind: str
    ports: Ports
    faults: Faults
    delay_s: float
    header_size: int
    torn_start: bool
