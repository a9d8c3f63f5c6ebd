"""Mode names, with ArduCopter's numbers and PX4's main and sub modes.

Sources: ArduCopter's ``mode.h`` and PX4's ``px4_custom_mode.h``.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Final


class Autopilot(IntEnum):
    """The supported ``MAV_AUTOPILOT`` values."""

    ARDUPILOT = 3
    PX4 = 12


class ModeFlag(IntFlag):
    """Flags in a heartbeat's ``base_mode``."""

    CUSTOM = 1
    ARMED = 128


class SystemState(IntEnum):
    """Those values of a heartbeat's ``system_status`` that are used here."""

    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5  #: a failsafe is active
    EMERGENCY = 6
    TERMINATION = 8


class Landed(IntEnum):
    """Values of ``landed_state`` in ``EXTENDED_SYS_STATE``."""

    UNKNOWN = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKING_OFF = 3
    LANDING = 4


COPTER_MODES: Final = {
    0: "STABILIZE",
    1: "ACRO",
    2: "ALT_HOLD",
    3: "AUTO",
    4: "GUIDED",
    5: "LOITER",
    6: "RTL",
    7: "CIRCLE",
    9: "LAND",
    11: "DRIFT",
    13: "SPORT",
    14: "FLIP",
    15: "AUTOTUNE",
    16: "POSHOLD",
    17: "BRAKE",
    18: "THROW",
    19: "AVOID_ADSB",
    20: "GUIDED_NOGPS",
    21: "SMART_RTL",
    22: "FLOWHOLD",
    23: "FOLLOW",
    24: "ZIGZAG",
    25: "SYSTEMID",
    26: "AUTOROTATE",
    27: "AUTO_RTL",
    28: "TURTLE",
}
COPTER_NUMBERS: Final = {name: number for number, name in COPTER_MODES.items()}

#: Main mode and sub mode by name.
PX4_MODES: Final = {
    (1, 0): "MANUAL",
    (2, 0): "ALTCTL",
    (3, 0): "POSCTL",
    (4, 1): "AUTO.READY",
    (4, 2): "AUTO.TAKEOFF",
    (4, 3): "AUTO.LOITER",
    (4, 4): "AUTO.MISSION",
    (4, 5): "AUTO.RTL",
    (4, 6): "AUTO.LAND",
    (4, 8): "AUTO.FOLLOW",
    (4, 9): "AUTO.PRECLAND",
    (5, 0): "ACRO",
    (6, 0): "OFFBOARD",
    (7, 0): "STABILIZED",
}
PX4_NUMBERS: Final = {name: numbers for numbers, name in PX4_MODES.items()}


def copter_mode(custom_mode: int) -> str:
    """Return the name of a heartbeat's ``custom_mode``."""
    return COPTER_MODES.get(custom_mode, f"MODE_{custom_mode}")


def px4_mode(custom_mode: int) -> str:
    """Return the name of a heartbeat's ``custom_mode``."""
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    return PX4_MODES.get((main, sub)) or PX4_MODES.get((main, 0)) or f"MODE_{main}.{sub}"


def px4_custom(name: str) -> int:
    """Return the ``custom_mode`` for a mode name."""
    main, sub = PX4_NUMBERS[name]
    return main << 16 | sub << 24
