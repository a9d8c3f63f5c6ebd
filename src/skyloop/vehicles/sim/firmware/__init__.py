"""Real flight firmware in the simulated world: ArduCopter, PX4 and Betaflight as processes that fly simulated drones.

Each one is a :class:`~skyloop.sim.instruments.Firmware`. The programs are not part of Skyloop; ``docs/autopilots.md``
describes where to get them.
"""

from __future__ import annotations

from enum import StrEnum


class AutopilotKind(StrEnum):
    """Firmware that can fly a simulated drone; values are the names used in addresses."""

    ARDUPILOT = "ardupilot"
    BETAFLIGHT = "betaflight"
    PX4 = "px4"
