"""The firmwares' rate curves and their inverses, from rates and angles to sticks. Pure.

Betaflight has five kinds of rates, plotted in its documentation. Since version 4.5, the tilt in ANGLE mode follows the
same curve; before that, the tilt was proportional to the stick. INAV has one cubic for roll and pitch and one for yaw.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError
from skyloop.vehicles.msp.wire.messages import INAV

Curve = Callable[[float], float]  #: increasing function from a stick (0 to 1) to a rate [degrees/s] or a fraction

_KINDS: Final = ("betaflight", "raceflight", "kiss", "actual", "quick")
_STEPS: Final = 24  #: number of steps in the bisection


@dataclass(frozen=True, slots=True)
class AxisRates:
    """The three numbers for an axis, 0 to 255, as stored by the firmware."""

    centre: int
    expo: int
    most: int


@dataclass(frozen=True, slots=True)
class Rates:
    """Rates for all axes. ``kind`` is one of ``betaflight``, ``raceflight``, ``kiss``, ``actual``, ``quick``."""

    kind: str
    roll: AxisRates
    pitch: AxisRates
    yaw: AxisRates


def betaflight_rates(payload: bytes) -> Rates:
    """Read Betaflight's ``RC_TUNING``, which includes the kind of rates since API 1.43. Raises :class:`DecodeError`."""
    if len(payload) < 14:
        raise DecodeError(f"RC_TUNING of {len(payload)} bytes: at least 14 expected")
    number = payload[22] if len(payload) > 22 else 0
    return Rates(
        _KINDS[number] if number < len(_KINDS) else "unknown",
        roll=AxisRates(payload[0], payload[1], payload[2]),
        pitch=AxisRates(payload[12], payload[13], payload[3]),
        yaw=AxisRates(payload[11], payload[10], payload[4]),
    )


def pack_betaflight_rates(rates: Rates) -> bytes:
    """Return the payload for Betaflight's ``RC_TUNING``, API 1.46."""
    roll, pitch, yaw = rates.roll, rates.pitch, rates.yaw
    made = struct.pack("<BBBBBBBBH", roll.centre, roll.expo, roll.most, pitch.most, yaw.most, 0, 50, 0, 0)
    made += bytes((yaw.expo, yaw.centre, pitch.centre, pitch.expo, 0, 100))
    return made + struct.pack("<HHHB", 1998, 1998, 1998, _KINDS.index(rates.kind))


def rate_curve(kind: str, rates: AxisRates) -> Curve:
    """Return the curve from stick to turn rate [degrees/s]; for an unknown kind, a straight line up to 200."""
    makers = {"betaflight": _betaflight, "raceflight": _raceflight, "kiss": _kiss, "actual": _actual, "quick": _quick}
    return makers[kind](rates) if kind in makers else lambda stick: 200.0 * stick


# The curves and their numbers are those of Betaflight's src/main/fc/rc.c (applyBetaflightRates and so on).


def _bent(stick: float, expo: float, power: int) -> float:
    return stick * (1 - expo) + expo * stick**power


def _super(stick: float, share: float) -> float:
    return 1 / min(1.0, max(0.01, 1 - stick * share))


def _betaflight(rates: AxisRates) -> Curve:
    centre, expo, most = rates.centre / 100, rates.expo / 100, rates.most / 100
    if centre > 2:
        centre += 14.54 * (centre - 2)
    return lambda stick: 200 * centre * _bent(stick, expo, 4) * _super(stick, most)


def _raceflight(rates: AxisRates) -> Curve:
    expo, most = rates.expo / 100, rates.most / 100
    return lambda stick: 10 * rates.centre * _bent(stick, expo, 3) * (1 + stick * most)


def _kiss(rates: AxisRates) -> Curve:
    expo, most = rates.expo / 100, rates.most / 100
    return lambda stick: min(1998.0, 2 * rates.centre * _bent(stick, expo, 3) * _super(stick, most))


def _actual(rates: AxisRates) -> Curve:
    centre, expo = rates.centre * 10, rates.expo / 100
    rest = max(0, rates.most * 10 - centre)
    return lambda stick: stick * centre + rest * stick * _bent(stick, expo, 5)


def _quick(rates: AxisRates) -> Curve:
    centre, expo = max(1, rates.centre * 2), rates.expo / 100
    share = 1 - centre / max(centre, rates.most * 10)
    return lambda stick: min(1998.0, stick * centre * _super(_bent(stick, expo, 3), share))


def inav_curve(expo: int, full: float) -> Curve:
    """Return INAV's curve for an expo (0 to 100) and the value at full stick, in any unit."""
    return lambda stick: full * _bent(stick, expo / 100, 3)


def share_of(curve: Curve) -> Curve:
    """Return the curve as a fraction of its value at full stick."""
    full = curve(1.0)
    return lambda stick: curve(stick) / full if full > 0 else stick


def stick_for(curve: Curve, wanted: float) -> float:
    """Return the stick position, -1 to 1, for a value; full stick if the value can't be reached."""
    size = abs(wanted)
    low, high = 0.0, 1.0
    if curve(1.0) <= size:
        low = 1.0
    else:
        for _ in range(_STEPS):
            middle = (low + high) / 2
            if curve(middle) < size:
                low = middle
            else:
                high = middle
    stick = (low + high) / 2
    return -stick if wanted < 0 else stick


#: Flags since Betaflight 4.1 (API 1.42), from bit 0; ARM_SWITCH is the last flag in every version.
BETAFLIGHT_FLAGS: Final = (
    *("NOGYRO", "FAILSAFE", "RXLOSS", "NOT_DISARMED", "BOXFAILSAFE", "RUNAWAY", "CRASH", "THROTTLE", "ANGLE"),
    *("BOOTGRACE", "NOPREARM", "LOAD", "CALIB", "CLI", "CMS", "BST", "MSP", "PARALYZE", "GPS", "RESCUE_SW"),
    *("DSHOT_TELEM", "REBOOT_REQD", "DSHOT_BBANG", "NO_ACC_CAL", "MOTOR_PROTO", "FLIP_SWITCH", "ALT_HOLD_SW"),
    "POS_HOLD_SW",
)
ARM_SWITCH: Final = "ARM_SWITCH"
#: INAV's flags by bit.
INAV_FLAGS: Final = {
    6: "GEOZONE",
    7: "FAILSAFE",
    8: "NOT_LEVEL",
    9: "SENSORS_CALIBRATING",
    10: "SYSTEM_OVERLOADED",
    11: "NAVIGATION_UNSAFE",
    12: "COMPASS_NOT_CALIBRATED",
    13: "ACC_NOT_CALIBRATED",
    14: ARM_SWITCH,
    15: "HARDWARE_FAILURE",
    16: "BOXFAILSAFE",
    18: "RC_LINK",
    19: "THROTTLE",
    20: "CLI",
    21: "CMS_MENU",
    22: "OSD_MENU",
    23: "ROLLPITCH_NOT_CENTERED",
    24: "SERVO_AUTOTRIM",
    25: "OOM",
    26: "INVALID_SETTING",
    27: "PWM_OUTPUT_ERROR",
    28: "NO_PREARM",
    29: "DSHOT_BEEPER",
    30: "LANDING_DETECTED",
}
#: Readable meaning and remedy for each flag. Flags that clear with time have no remedy.
MEANINGS: Final = {
    "NOGYRO": "no gyroscope was found",
    "FAILSAFE": "failsafe is active until sticks arrive for half a second",
    "RXLOSS": "no sticks are received",
    "NOT_DISARMED": "the arm switch was on before sticks were received",
    "BOXFAILSAFE": "the failsafe switch is on",
    "RUNAWAY": "a runaway take-off was stopped: check motor order and propellers",
    "CRASH": "a crash was detected: disarm",
    "THROTTLE": "the throttle is not low",
    "ANGLE": "it is not level",
    "BOOTGRACE": "it has just been switched on",
    "NOPREARM": "the prearm switch is off",
    "LOAD": "its processor is overloaded",
    "CALIB": "its sensors are being calibrated: keep it still",
    "CLI": "its command line is open: exit it",
    "CMS": "its menu is open",
    "MSP": "a configurator prevents arming: close it",
    "PARALYZE": "paralyze is active: power-cycle it",
    "GPS": "it has no GPS fix, which GPS rescue needs",
    "RESCUE_SW": "the GPS rescue switch is on",
    "DSHOT_TELEM": "motor controllers send no telemetry",
    "REBOOT_REQD": "settings were changed: restart it",
    "DSHOT_BBANG": "the motor outputs do not work",
    "NO_ACC_CAL": "its accelerometer was never calibrated",
    "MOTOR_PROTO": "no motor protocol is set",
    "FLIP_SWITCH": "the crash flip switch is on",
    "ALT_HOLD_SW": "the altitude hold switch is on",
    "POS_HOLD_SW": "the position hold switch is on",
    ARM_SWITCH: "the arm switch is on though it can't be armed: it will be switched off and on",
    "GEOZONE": "it is in a forbidden zone",
    "NOT_LEVEL": "it is not level",
    "SENSORS_CALIBRATING": "its sensors are being calibrated: keep it still",
    "SYSTEM_OVERLOADED": "its processor is overloaded",
    "NAVIGATION_UNSAFE": "navigation is not safe: it waits for GPS (nav_extra_arming_safety)",
    "COMPASS_NOT_CALIBRATED": "its compass was never calibrated",
    "ACC_NOT_CALIBRATED": "its accelerometer was never calibrated",
    "HARDWARE_FAILURE": "a configured sensor does not work",
    "RC_LINK": "no sticks are received",
    "INVALID_SETTING": "a setting is invalid: its command line's status names it",
    "NO_PREARM": "the prearm switch is off",
}

# Modes are identified by their names in ``BOXNAMES``, because permanent numbers differ between firmwares.
ARM: Final = "ARM"
ANGLE: Final = "ANGLE"
PREARM: Final = "PREARM"
MSP_OVERRIDE: Final = ("MSP OVERRIDE", "MSP RC OVERRIDE")  #: Betaflight's and INAV's names
ARMED_OF_INAV: Final = 1 << 2  #: bit in INAV's status flags that means "armed"


def flag_names(variant: str, flags: int, count: int) -> list[str]:
    """Return the firmware's names for flags that prevent arming. ``count`` is its number of flags, 0 if unknown."""
    names = []
    for bit in range(32):
        if not flags >> bit & 1:
            continue
        if variant == INAV:
            if bit in INAV_FLAGS:
                names.append(INAV_FLAGS[bit])
        elif count and bit == count - 1:
            names.append(ARM_SWITCH)
        else:
            names.append(BETAFLIGHT_FLAGS[bit] if bit < len(BETAFLIGHT_FLAGS) else f"flag {bit}")
    return names


def explained(names: list[str]) -> str:
    """Return flag names with their meanings, as readable text."""
    return "; ".join(f"{name} ({MEANINGS[name]})" if name in MEANINGS else name for name in names)
