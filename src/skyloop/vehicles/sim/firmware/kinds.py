"""The names of the firmware that can fly a simulated drone."""

from __future__ import annotations

from enum import StrEnum


class AutopilotKind(StrEnum):
    """Firmware that can fly a simulated drone, by its name in an address."""

    ARDUPILOT = "ardupilot"
    BETAFLIGHT = "betaflight"
    PX4 = "px4"
