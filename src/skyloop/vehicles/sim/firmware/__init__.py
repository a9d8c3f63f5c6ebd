"""Real flight firmware in the simulated world: ArduCopter, PX4 and Betaflight as processes that fly simulated drones.

Each is a :class:`~skyloop.sim.instruments.Firmware`. Their programs are not part of Skyloop; ``docs/autopilots.md``
lists their sources.
"""

from __future__ import annotations

from enum import StrEnum


class AutopilotKind(StrEnum):
    """Firmware that can fly a simulated drone, by its name in an address."""

    ARDUPILOT = "ardupilot"
    BETAFLIGHT = "betaflight"
    PX4 = "px4"
