"""Real flight firmware in the simulated world, as processes that fly simulated drones.

Each one is a :class:`~skyloop.sim.instruments.Firmware`. The programs are not part of Skyloop; ``docs/autopilots.md``
describes where to get them.
"""

from __future__ import annotations

from enum import StrEnum


class AutopilotKind(StrEnum):
    """Firmware that can fly a simulated drone; values are the names used in addresses."""

    ARDUPILOT = "ardupilot"
    BETAFLIGHT = "betaflight"
    CRAZYFLIE = "crazyflie"
    PX4 = "px4"


REAL_TIME = frozenset({AutopilotKind.BETAFLIGHT, AutopilotKind.CRAZYFLIE})  #: firmware that uses the computer's clock
